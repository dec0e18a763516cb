"""Model files under faults: killed writers, full and read-only disks, odd paths, poisoned files."""

import base64
import errno
import json
import os
import pickle
import random
import shutil
import subprocess
import sys
import zipfile
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, agent, noise, pretrained, recorded, same, weights
from faults import (
    done,
    kill_at_change,
    killed,
    mount,
    mounts_of_its_own,
    small_disk,
    started,
)
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files import archive

pytestmark = pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")


# ------------------------------------------------------------------------------ nothing is lost


def save_until_killed(path, number):
    model = agent(seed=1)
    kill_at_change(number, every=20)
    model.save(path)


@pytest.mark.slow
def test_killed_at_any_write_a_save_leaves_one_model_whole_and_the_next_save_tidies_up(tmp_path):
    old = agent()
    new = agent(seed=1)
    path = tmp_path / "model.zip"
    left = set()
    for number in count():
        old.save(path)
        over = not killed(save_until_killed, path, number)
        loaded = weights(WPT.load(path))
        assert same(loaded, weights(old)) or same(loaded, weights(new)), number
        left |= set(os.listdir(tmp_path)) - {"model.zip"}
        agent(seed=1).save(path)
        assert os.listdir(tmp_path) == ["model.zip"], number
        if over:
            break
    assert number > 5 and left  # some were killed while the new file stood beside the old one


def test_what_a_living_process_is_writing_is_left_alone_and_a_dead_ones_is_removed(tmp_path):
    gone = started(os.getpid)
    gone.join()
    with archive.replacing(tmp_path / "file") as temporary:
        temporary.write_text("ours")
        here = str(temporary).removesuffix(str(os.getpid()))
    living, dead, foreign = (Path(here + name) for name in (str(os.getppid()), str(gone.pid), "x"))
    for path in (living, dead, foreign):
        path.write_text("somebody else's")
    with archive.replacing(tmp_path / "file") as temporary:
        temporary.write_text("new")
    assert {*tmp_path.iterdir()} == {tmp_path / "file", living, foreign}


def save_on_a_small_disk(path):
    small_disk(path, b"4m")
    old = agent()
    old.save(path / "model.zip")
    before = (path / "model.zip").read_bytes()
    disk = os.statvfs(path)
    (path / "ballast").write_bytes(bytes(disk.f_bavail * disk.f_frsize - len(before) // 2))
    with pytest.raises(OSError, match="No space left") as error:
        agent(seed=1).save(path / "model.zip")
    assert error.value.errno == errno.ENOSPC
    assert "model.zip" in str(error.value)  # names the file
    assert (path / "model.zip").read_bytes() == before
    assert sorted(os.listdir(path)) == ["ballast", "model.zip"]
    (path / "ballast").unlink()
    agent(seed=1).save(path / "model.zip")
    assert same(weights(WPT.load(path / "model.zip")), weights(agent(seed=1)))


def test_a_full_disk_keeps_the_old_model_and_names_the_file(tmp_path):
    done(started(save_on_a_small_disk, tmp_path))


def save_where_nothing_may_be_written(path):
    mounts_of_its_own()
    where, bind, read_only = os.fsencode(path), 0x1000, 0x1000 | 0x20 | 0x1
    mount(where, where, None, bind)
    mount(None, where, None, read_only)
    assert WPT.load(path / "model.zip").predict(noise())[0].shape == (4,)
    for file in ("model.zip", "new.zip", "folder/new.zip"):
        with pytest.raises(OSError, match=r"Read-only file system.*(zip|folder)"):
            agent().save(path / file)


def test_a_read_only_folder_is_loaded_from_and_named_when_it_is_saved_to(tmp_path):
    agent().save(tmp_path / "model.zip")
    done(started(save_where_nothing_may_be_written, tmp_path))


@pytest.mark.parametrize("name", ["a folder/with spaces.zip", "Würfel/方块.zip", "deep/er/model"])
def test_paths_may_have_spaces_any_script_no_suffix_and_parents_that_are_not_there(tmp_path, name):
    model = agent(ClockEnv()).learn(14)
    model.save(tmp_path / name)
    model.save_replay_buffer(str(tmp_path / name) + "replay")
    loaded = WPT.load(str(tmp_path / name), env=ClockEnv())
    loaded.load_replay_buffer(str(tmp_path / name) + "replay")
    assert same(weights(loaded), weights(model)) and len(loaded.replay_buffer) == 14


# ------------------------------------------------------------------------------ what comes back


def acts(model, steps=25, n=4):
    """What a model does over 100 random observations, with states and episodes that begin."""
    rng = np.random.default_rng(0)
    state, actions = None, []
    for step in range(steps):
        start = rng.random(n) < 0.2 if step else np.ones(n, bool)
        action, state = model.predict(noise(n, seed=step), state, start, deterministic=True)
        actions.append(action)
    return np.stack(actions)


def test_a_loaded_model_acts_alike_on_100_observations_and_with_other_threads(tmp_path):
    model = agent(ClockEnv()).learn(28)
    model.save(tmp_path / "model")
    expected = acts(model)
    np.testing.assert_array_equal(acts(WPT.load(tmp_path / "model")), expected)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(threads + 1)
        np.testing.assert_allclose(acts(WPT.load(tmp_path / "model")), expected, atol=1e-5)
    finally:
        torch.set_num_threads(threads)


LOAD = """
import sys
import numpy as np
from wpt_agents import WPT
model = WPT.load(sys.argv[1])
print(model.predict(np.zeros((64, 64, 3), np.uint8), deterministic=True)[0].tolist())
"""


def test_a_model_loads_in_a_process_that_has_no_dataset(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend(recorded(seed=i) for i in range(4))
    model = pretrained(tmp_path / "data", env=ClockEnv()).learn(28)
    model.save(tmp_path / "model.zip")
    expected = model.predict(np.zeros((64, 64, 3), np.uint8), deterministic=True)[0].tolist()
    shutil.rmtree(tmp_path / "data")
    words = [sys.executable, "-c", LOAD, str(tmp_path / "model.zip")]
    root = Path(__file__).parents[2]
    process = subprocess.run(words, capture_output=True, text=True, cwd=root)
    assert process.stdout.strip() == str(expected), process.stderr


def test_a_model_goes_on_in_each_phase_on_other_widths_and_more_environments(tmp_path):
    data = [recorded(seed=i) for i in range(4)]
    first = pretrained(data)
    first.save(tmp_path / "1")
    midway = WPT.load(tmp_path / "1", env=ClockEnv(), dataset=data).learn(28)
    midway.save(tmp_path / "2")
    more = WPT.load(tmp_path / "2", env=DummyVecEnv([ClockEnv] * 4), dataset=data)
    assert more.learn(28, reset_num_timesteps=False).num_timesteps == 56
    assert all(torch.isfinite(w).all() for w in weights(more).values())
    more.save(tmp_path / "3")
    wider = WPT.load(tmp_path / "3", env=ClockEnv(actions=3), offline_ratio=0, guidance=0)
    wider.learn(14)
    assert wider.predict(noise())[0].shape == (3,)
    kept, now = (weights(m, "world_model.encoder") for m in (more, wider))
    assert kept.keys() == now.keys()


# ------------------------------------------------------------------------------ what is refused


class Trap:
    def __reduce__(self):
        return os.mkdir, (os.environ["TRAP"],)


@pytest.mark.parametrize("member", ["data", "policy.pth"])
def test_a_poisoned_file_of_sb3_is_refused_and_not_run(tmp_path, monkeypatch, member):
    monkeypatch.setenv("TRAP", str(tmp_path / "sprung"))
    trap = pickle.dumps(Trap())
    serialized = {":type:": "dict", ":serialized:": base64.b64encode(trap).decode()}
    poison = {"data": json.dumps({"policy_kwargs": serialized}), "policy.pth": trap}[member]
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=1).save(tmp_path / "sac.zip")
    with zipfile.ZipFile(tmp_path / "sac.zip") as file:
        content = {name: file.read(name) for name in file.namelist()}
    with zipfile.ZipFile(tmp_path / "sac.zip", "w") as file:
        for name, data in (content | {member: poison}).items():
            file.writestr(name, data)
    with pytest.raises(ValueError, match="not a model of wpt_agents"):
        WPT.load(tmp_path / "sac.zip")
    assert not (tmp_path / "sprung").exists()
    if member == "data":  # which springs where it is loaded by SB3 itself
        with pytest.raises((KeyError, TypeError, ValueError)):
            SAC.load(tmp_path / "sac.zip")
        assert (tmp_path / "sprung").exists()


# ------------------------------------------------------------------------------ the same numbers

LEARN = """
import hashlib, sys
sys.path[:0] = sys.argv[1:]
from debug_agent import agent, pretrained, recorded, weights
from toy_env import DotEnv
import warnings
warnings.simplefilter("ignore")
model = pretrained([recorded(seed=i) for i in range(4)], env=DotEnv()).learn(50)
sha = hashlib.sha256()
for name, weight in weights(model).items():
    sha.update(name.encode() + weight.numpy().tobytes())
print(sha.hexdigest())
"""


@pytest.mark.slow
def test_the_order_of_pythons_hashes_changes_no_weight():
    root = Path(__file__).parents[2]
    helpers = root / "tests" / "helpers"
    printed = set()
    for seed in random.Random(0).sample(range(1000), 2):
        environment = os.environ | {"PYTHONHASHSEED": str(seed), "OMP_NUM_THREADS": "1"}
        words = [sys.executable, "-c", LEARN, str(helpers), str(root)]
        process = subprocess.run(words, capture_output=True, text=True, cwd=root, env=environment)
        assert process.returncode == 0, process.stderr
        printed.add(process.stdout)
    assert len(printed) == 1
