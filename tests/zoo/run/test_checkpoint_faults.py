"""Checkpoints of a run under faults: killed at every write, a full disk, clocks that jump."""

import os
import random
import shutil
from itertools import count

import numpy as np
import pytest
from debug_agent import ClockEnv, agent, on_time, same, weights
from faults import done, failing, kill_at_change, killed, no_space, small_disk, started
from stable_baselines3.common.logger import configure

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.run.checkpoints import KEEP, last_checkpoint, write_checkpoint

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
EPISODE = 7  # steps of the clock


def learning(folder, episodes):
    """An agent that has learnt for some episodes, with a checkpoint after each."""
    model = agent(ClockEnv())
    model.set_logger(configure(str(folder / "log"), []))
    for _ in range(episodes):
        learn_on(model, folder)
    return model


def learn_on(model, folder):
    model.learn(EPISODE, reset_num_timesteps=False)
    (folder / "progress.csv").write_text(f"steps\n{model.num_timesteps}\n")
    write_checkpoint(model, folder)


def restored(folder):
    """What the last checkpoint brings back, which must be whole."""
    checkpoint = last_checkpoint(folder)
    model = WPT.load(checkpoint.model, env=ClockEnv())
    model.set_logger(configure(str(folder / "log"), []))
    checkpoint.restore(model, folder)
    checkpoint.restore_logs(folder)
    assert len(model.replay_buffer.trajectories) == model.episodes == checkpoint.state.replay
    assert all(on_time(t) for t in model.replay_buffer.trajectories)
    assert (folder / "progress.csv").read_text() == f"steps\n{model.num_timesteps}\n"
    return model


def write_until_killed(model, folder, number):
    kill_at_change(number, every=20)
    write_checkpoint(model, folder)


def leftovers(folder):
    return [path.name for path in folder.rglob("*") if ".tmp" in path.name]


@pytest.mark.slow
def test_killed_at_any_write_of_a_checkpoint_the_run_goes_on_exactly(tmp_path):
    start = tmp_path / "start"
    start.mkdir()
    model = learning(start, episodes=3)
    before = weights(model)
    model.learn(EPISODE, reset_num_timesteps=False)
    after = weights(model)
    stood = set()
    for number in count():
        folder = tmp_path / "killed"
        shutil.copytree(start, folder)
        (folder / "progress.csv").write_text(f"steps\n{model.num_timesteps}\n")
        over = not killed(write_until_killed, model, folder, number)
        back = restored(folder)
        assert same(weights(back), before if back.episodes == 3 else after), number
        again = back.episodes not in stood  # once, as it takes a while
        stood.add(back.episodes)
        if again and back.episodes == 3:
            assert same(weights(back.learn(EPISODE, reset_num_timesteps=False)), after)
        (folder / "progress.csv").write_text(f"steps\n{model.num_timesteps}\n")
        write_checkpoint(model, folder)
        assert leftovers(folder) == [], number
        assert len(list((folder / "checkpoints").iterdir())) == KEEP
        assert restored(folder).episodes == 4
        shutil.rmtree(folder)
        if over:
            break
    assert number > 20 and stood == {3, 4}


@pytest.mark.parametrize("part", ["episode", "model"])
def test_a_disk_that_is_full_at_a_checkpoint_keeps_the_earlier_one(tmp_path, part):
    model = learning(tmp_path, episodes=2)
    model.learn(EPISODE, reset_num_timesteps=False)
    call = {"episode": 0, "model": 2}[part]  # an episode's file and its name are forced out first
    with pytest.raises(OSError, match="No space"), failing(call, no_space, random.Random(0)):
        write_checkpoint(model, tmp_path)
    assert len(model.replay_buffer.trajectories) == 3  # in memory nothing is lost
    before = restored(tmp_path)
    assert before.episodes == 2
    write_checkpoint(model, tmp_path)  # there is room again
    assert same(weights(WPT.load(last_checkpoint(tmp_path).model)), weights(model))
    assert leftovers(tmp_path) == []


def learn_on_a_small_disk(path):
    small_disk(path, b"8m")
    model = learning(path, episodes=1)
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    disk = os.statvfs(path)
    (path / "ballast").write_bytes(bytes(disk.f_bavail * disk.f_frsize - size // 3))
    model.learn(EPISODE, reset_num_timesteps=False)
    with pytest.raises(OSError, match="No space"):
        write_checkpoint(model, path)
    (path / "progress.csv").unlink()
    assert restored(path).episodes == 1
    (path / "ballast").unlink()
    write_checkpoint(model, path)
    assert last_checkpoint(path).state.replay == 2


def test_a_real_disk_that_is_full_keeps_the_earlier_checkpoint(tmp_path):
    done(started(learn_on_a_small_disk, tmp_path))


def test_the_last_checkpoint_is_that_of_the_latest_step_whatever_the_clock_says(tmp_path):
    learning(tmp_path, episodes=2)
    older, newer = sorted((tmp_path / "checkpoints").iterdir())
    os.utime(newer, (0, 0))
    for path in newer.iterdir():
        os.utime(path, (0, 0))
    assert last_checkpoint(tmp_path).folder == newer
    os.utime(older, (np.iinfo(np.int32).max,) * 2)
    assert last_checkpoint(tmp_path).folder == newer
