"""A run that is killed goes on where it stood, and ends as if nothing had happened."""

import fcntl
import json
import os
import shutil
import signal
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
from debug_agent import pretrained, recorded, same, weights
from dot_runs import DOT, dot, job  # noqa: F401  (dot registers the task for each test)
from stable_baselines3.common.logger import configure
from toy_env import LENGTH

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.files.model_file import read_model
from wpt_agents.training.learner import Learner
from wpt_agents.zoo import locks
from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.provenance import commit
from wpt_agents.zoo.run import checkpoints, engines, learning, runner
from wpt_agents.zoo.run.checkpoints import last_checkpoint
from wpt_agents.zoo.run.evaluating import file_hash
from wpt_agents.zoo.run.progress import LearningBar
from wpt_agents.zoo.run.runner import run
from wpt_agents.zoo.run.shared import collect_data, pretrain
from wpt_agents.zoo.vec_envs import EpisodeSeeds, make_vec_env

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

CHANGES = {
    "learn": {"frames": 150, "checkpoint_every": 25},
    "evaluate": {"episodes": 2, "every": 25, "during_episodes": 2, "keep_best": True},
}

METHODS = [
    *("wpt", "scratch", "drq-v2", "jsrl-bc", "uds", "explore", "rlpd", "r3m", "packnet", "mrq"),
    "dreamer-v3",
]


class Killed(BaseException):
    """What a SIGKILL is to the process, for one that the test has to outlive."""


class KillAt(LearningBar):
    def __init__(self, step):
        super().__init__(frames_a_step=1)
        self.step = step

    def _on_step(self):
        if self.num_timesteps == self.step:
            raise Killed
        return super()._on_step()


def killed_at(step, monkeypatch, one):
    """Does the run until `step`, and no more."""
    with monkeypatch.context() as patch:
        patch.setattr(learning, "LearningBar", lambda _: KillAt(step))
        with pytest.raises(Killed):
            run(one)


def left(folder):
    """All that a run leaves, clocks apart."""
    _, tensors = read_model(folder / "model.zip")
    flat = {f"{g}/{k}": v.numpy() for g, group in tensors.items() for k, v in group.items()}
    rows = np.genfromtxt(folder / "progress.csv", delimiter=",", names=True)
    flat |= {n: rows[n] for n in rows.dtype.names if n != "timefps"}
    monitor = np.genfromtxt(folder / "0.monitor.csv", delimiter=",", skip_header=1, names=True)
    flat |= {"returns": monitor["r"], "lengths": monitor["l"]}
    with np.load(folder / "evaluations.npz") as arrays:
        flat |= {n: arrays[n] for n in arrays.files}
    scores = json.loads((folder / "result.json").read_text())["scores"]
    return flat | {name: np.array(score["returns"]) for name, score in scores.items()}


def assert_equal(one, other):
    assert one.keys() == other.keys()
    for name, array in one.items():
        np.testing.assert_array_equal(array, other[name], err_msg=name)


def data_of(method, folder):
    """A dataset whose rewards are known, which `rlpd` needs; None for the run's own data."""
    if method != "rlpd":
        return None
    with TrajectoryDataset.create(folder / "rewards") as data:
        for seed in range(3):
            episode = recorded(25, seed, embodiment="dot")
            data.append(replace(episode, reward=episode.action[:, 0]))
    return folder / "rewards"


@pytest.mark.parametrize("method", METHODS)
def test_a_run_killed_thrice_equals_an_undisturbed_one(method, tmp_path, monkeypatch, capsys):
    data = data_of(method, tmp_path)
    whole, broken = (
        job(folder, method, data=data, **CHANGES) for folder in (tmp_path / "whole", tmp_path)
    )
    run(whole)
    for step in (40, 76, 149):
        killed_at(step, monkeypatch, broken)
    run(broken)
    assert "continued at 125 of" in capsys.readouterr().out
    assert_equal(left(broken.folder), left(whole.folder))
    assert not (broken.folder / "replay").exists()


def test_a_killed_run_goes_on_elsewhere_without_the_pretrained_model(tmp_path, monkeypatch):
    whole, broken = (job(tmp_path / name, **CHANGES) for name in ("whole", "broken"))
    killed_at(76, monkeypatch, broken)
    assert not engines.needs_model(broken)
    began_with = file_hash(broken.shared.model_path / "model.zip")
    shutil.rmtree(broken.shared.model_path)
    with monkeypatch.context() as patch:
        patch.setattr(runner, "pretrain", None)
        finished = run(broken)
    assert finished.pretrained == began_with and "pretrain" in finished.seconds
    run(whole)
    assert engines.needs_model(whole) and not engines.needs_model(job(tmp_path, "scratch"))
    assert_equal(left(broken.folder), left(whole.folder))


class SignalAt(LearningBar):
    """Send this process a signal at some steps."""

    def __init__(self, number, *steps):
        super().__init__(frames_a_step=1)
        self.number = number
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps in self.steps:
            os.kill(os.getpid(), self.number)
        return super()._on_step()


class UnreadSignalAt(SignalAt):
    """Ctrl-C also ends the program that reads the output."""

    def _on_step(self):
        if self.num_timesteps in self.steps:
            self.bar.mininterval = 0  # draw it every time
            self.bar.sp = self.broken_pipe
        return super()._on_step()

    def broken_pipe(self, _):
        raise BrokenPipeError


def interrupted_at(monkeypatch, one, number, *steps, bar=SignalAt):
    """Do the run until the signals at these steps end it, as the signal's own handler does."""
    with monkeypatch.context() as patch:
        patch.setattr(learning, "LearningBar", lambda _: bar(number, *steps))
        before = signal.signal(number, signal.default_int_handler)
        try:
            with pytest.raises(KeyboardInterrupt):
                run(one)
        finally:
            assert signal.signal(number, before) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_completes_its_episode_and_continues_from_there(
    number, tmp_path, monkeypatch, capfd
):
    changes = CHANGES | {"learn": {"frames": 150, "checkpoint_every": 1000}}
    whole, broken = (job(folder, **changes) for folder in (tmp_path / "whole", tmp_path))
    run(whole)
    interrupted_at(monkeypatch, broken, number, 40)
    assert capfd.readouterr().err.count("Press Ctrl-C again") == 1
    (written,) = (broken.folder / "checkpoints").iterdir()
    assert written.name == "step-000000050"
    run(broken)
    assert "continued at 50 of" in capfd.readouterr().out
    assert_equal(left(broken.folder), left(whole.folder))


def test_an_interrupted_run_has_a_checkpoint_also_if_its_output_was_piped(tmp_path, monkeypatch):
    one = job(tmp_path, "scratch", learn={"frames": 150, "checkpoint_every": 1000})
    interrupted_at(monkeypatch, one, signal.SIGINT, 40, bar=UnreadSignalAt)
    assert last_checkpoint(one.folder).folder.name == "step-000000050"


def test_a_second_signal_stops_a_run_at_once(tmp_path, monkeypatch):
    one = job(tmp_path, learn={"frames": 150, "checkpoint_every": 1000})
    interrupted_at(monkeypatch, one, signal.SIGINT, 40, 42)
    assert last_checkpoint(one.folder) is None


def test_a_signal_before_the_first_episode_takes_effect_at_once(tmp_path, monkeypatch):
    one = job(tmp_path, "scratch", **CHANGES)
    went_on = []

    def clone(*_):
        os.kill(os.getpid(), signal.SIGINT)
        went_on.append(True)

    monkeypatch.setattr(WPT, "clone", clone)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            run(one)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not went_on
    assert not (one.folder / "0.monitor.csv").read_text().count("\n") > 2


def test_a_slow_run_has_a_checkpoint_every_ten_minutes(tmp_path, monkeypatch):
    one = job(tmp_path, "scratch", learn={"frames": 150, "checkpoint_every": 1000})
    clock = iter(range(0, 10**6, 400))  # two episodes take more than ten minutes
    monkeypatch.setattr(
        checkpoints, "time", SimpleNamespace(**vars(time) | {"monotonic": lambda: next(clock)})
    )
    killed_at(110, monkeypatch, one)
    names = sorted(path.name for path in (one.folder / "checkpoints").iterdir())
    assert names == ["step-000000050", "step-000000100"]


def test_a_run_that_goes_on_counts_what_is_done_in_frames(tmp_path, monkeypatch, capsys):
    changes = {"env": {"action_repeat": 2}, "learn": {"frames": 150, "checkpoint_every": 50}}
    one = job(tmp_path, "scratch", **changes)
    killed_at(60, monkeypatch, one)
    run(one)
    assert "continued at 100 of 150 frames, 75 steps" in capsys.readouterr().out


def test_a_resumed_run_names_the_commits_the_model_and_the_time_of_all_its_processes(
    tmp_path, monkeypatch
):
    one = job(tmp_path, **CHANGES)
    monkeypatch.setattr(runner, "commit", lambda: "aaa")
    killed_at(60, monkeypatch, one)
    model = pretrain(one.shared, collect_data(one.shared))
    began_with = file_hash(model)
    model.write_bytes(b"trained again by another command")
    state = one.folder / "checkpoints" / "step-000000050" / "state.json"
    stored = json.loads(state.read_text())
    assert {"collect", "pretrain", "index"} <= stored["origin"]["seconds"].keys()
    stored["origin"]["seconds"]["index"] = 5.0
    state.write_text(json.dumps(stored))
    monkeypatch.setattr(runner, "commit", lambda: "bbb")
    killed_at(90, monkeypatch, one)
    done = run(one)
    assert (done.commit, done.pretrained) == ("aaa, bbb", began_with)
    assert done.seconds["index"] == 5.0  # it is not made again


def test_a_checkpoint_of_an_earlier_version_has_no_origin(tmp_path, monkeypatch):
    one = job(tmp_path, "scratch", **CHANGES)
    killed_at(60, monkeypatch, one)
    state = one.folder / "checkpoints" / "step-000000050" / "state.json"
    stored = json.loads(state.read_text())
    del stored["origin"]
    state.write_text(json.dumps(stored))
    assert run(one).commit == commit()


def test_a_run_killed_after_learning_learns_no_more(tmp_path, monkeypatch):
    one = job(tmp_path, **CHANGES)
    with monkeypatch.context() as patch:
        patch.setattr(runner, "evaluate_policies", lambda *_: (_ for _ in ()).throw(Killed))
        with pytest.raises(Killed):
            run(one)
    before = weights(WPT.load(one.folder / "model.zip"))
    monkeypatch.setattr("wpt_agents.agents.wpt.WPT.update", lambda *_: pytest.fail("learns again"))
    run(one)
    assert same(weights(WPT.load(one.folder / "model.zip")), before)


def test_the_last_two_checkpoints_are_kept_and_a_damaged_one_is_passed_over(tmp_path, monkeypatch):
    one = job(tmp_path, **CHANGES)
    killed_at(110, monkeypatch, one)
    names = sorted(path.name for path in (one.folder / "checkpoints").iterdir())
    assert names == ["step-000000075", "step-000000100"]
    damaged = one.folder / "checkpoints" / names[1] / "model.zip"
    damaged.write_bytes(damaged.read_bytes()[:-1] + b"?")
    with pytest.warns(UserWarning, match="step-000000100 is damaged"):
        assert last_checkpoint(one.folder).folder.name == names[0]


def test_what_came_after_the_checkpoint_is_forgotten(tmp_path, monkeypatch):
    one = job(tmp_path, **CHANGES)
    killed_at(110, monkeypatch, one)
    shutil.rmtree(one.folder / "checkpoints" / "step-000000100")
    checkpoint = last_checkpoint(one.folder)
    checkpoint.restore_logs(one.folder)
    assert (one.folder / "0.monitor.csv").read_text().count("\n") == 2 + 3
    with np.load(one.folder / "evaluations.npz") as arrays:
        assert arrays["timesteps"].tolist() == [25, 50, 75]
    model = WPT.load(checkpoint.model)
    model.set_logger(configure(str(tmp_path / "log"), []))
    assert len(list((one.folder / "replay").iterdir())) == 4
    checkpoint.restore(model, one.folder)
    assert (
        len(list((one.folder / "replay").iterdir())) == len(model.replay_buffer.trajectories) == 3
    )


def test_a_run_that_another_process_works_on_is_refused(tmp_path):
    one = job(tmp_path)
    one.folder.mkdir(parents=True)
    with locked(one.folder / "lock"), pytest.raises(ValueError, match="by another process"):
        run(one)


def test_who_only_looks_whether_a_run_is_locked_does_not_keep_it_from_starting(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(locks, "PATIENCE", 10)
    with open(tmp_path / "lock", "w") as looking:
        fcntl.flock(looking, fcntl.LOCK_SH)
        threading.Timer(0.1, fcntl.flock, (looking, fcntl.LOCK_UN)).start()
        with locked(tmp_path / "lock"):
            pass


def test_force_does_not_walk_into_a_run_that_another_process_works_on(tmp_path, monkeypatch):
    one = job(tmp_path, **CHANGES)
    killed_at(60, monkeypatch, one)
    before = sorted(one.folder.rglob("*"))
    with locked(one.folder / "lock"), pytest.raises(ValueError, match="by another process"):
        run(one, force=True)
    assert sorted(one.folder.rglob("*")) == before


def test_leftovers_of_checkpoints_that_cannot_be_used_make_way(tmp_path, monkeypatch):
    one = job(tmp_path, **CHANGES)
    killed_at(110, monkeypatch, one)
    (one.folder / "replay" / "episode-000000.zip").unlink()
    with pytest.warns(UserWarning, match="damaged and was skipped"):
        killed_at(30, monkeypatch, one)
    assert [p.name for p in (one.folder / "checkpoints").iterdir()] == ["step-000000025"]
    assert len(list((one.folder / "replay").iterdir())) == 1


def test_the_checkpoint_at_the_end_is_not_written_twice(tmp_path, monkeypatch):
    one, written = job(tmp_path, learn={"frames": 150, "checkpoint_every": 0}), []
    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(runner, "evaluate_policies", lambda *_: (_ for _ in ()).throw(Killed))
            with pytest.raises(Killed):
                run(one)
        (state,) = one.folder.glob("checkpoints/*/state.json")
        written.append((state.stat().st_ino, state.stat().st_mtime_ns))
    assert written[0] == written[1]


def test_training_and_evaluation_share_no_episode(tmp_path):
    for seed in range(20):
        one = job(tmp_path, seed=seed)
        training = EpisodeSeeds(gym.make(DOT.id, action_repeat=1, rendering="fast"))
        training.reset(seed=seed)
        seeds = {seed} | {training.next_seed() for _ in range(200)}
        final = {one.evaluation_seed + i for i in range(100)}
        assert not seeds & final


def test_a_wait_for_another_process_pretraining_ends_in_its_model(tmp_path, monkeypatch):
    shared = job(tmp_path).shared
    dataset, folder = collect_data(shared), shared.model_path

    def other():
        with locked(folder / "lock"):
            begun.set()
            time.sleep(0.3)
            (folder / "done.json").write_text("{}")

    begun, thread = threading.Event(), threading.Thread(target=other)
    thread.start()
    begun.wait()
    monkeypatch.setattr(WPT, "pretrain", lambda *_, **__: pytest.fail("pre-trained twice"))
    assert pretrain(shared, dataset) == folder / "model.zip"
    thread.join()


def test_the_log_of_a_pretraining_that_goes_on_has_each_row_once(tmp_path, monkeypatch):
    monkeypatch.setattr("wpt_agents.training.pretraining.SAVE_EVERY", 100)
    shared, update = job(tmp_path, pretrain={"steps": 300}).shared, Learner.update_world_model
    dataset, taken = collect_data(shared), []

    def dying(*args):
        taken.append(0)
        if len(taken) == 180:
            raise Killed
        return update(*args)

    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update_world_model", dying)
        with pytest.raises(Killed):
            pretrain(shared, dataset)
    assert (shared.model_path / "progress.csv").read_text().count("\n") == 1 + 3
    pretrain(shared, dataset)
    assert (shared.model_path / "progress.csv").read_text().count("\n") == 1 + 6


def test_an_unfinished_run_of_other_settings_is_refused(tmp_path, monkeypatch):
    killed_at(60, monkeypatch, job(tmp_path, **CHANGES))
    with pytest.raises(ValueError, match=r"other settings.*wpt"):
        run(job(tmp_path, wpt={"gamma": 0.9}, **CHANGES))


def test_an_episode_depends_on_its_number_and_on_none_before_it():
    settings = {"action_repeat": 1, "rendering": "fast"}
    one, other = (make_vec_env(DOT.id, settings, seed=3) for _ in range(2))
    images = [one.reset() for _ in range(4)]
    assert len({image.tobytes() for image in images}) == 4
    other.env_method("go_to_episode", 2)
    np.testing.assert_array_equal(other.reset(), images[2])
    np.testing.assert_array_equal(other.reset(), images[3])


def test_a_run_that_retrieved_by_several_images_goes_on_with_the_episode_that_was_next(tmp_path):
    data = [recorded(seed=seed) for seed in range(4)]
    settings = {"action_repeat": 1, "rendering": "fast"}
    one, other = (make_vec_env(DOT.id, settings, seed=3) for _ in range(2))
    model = pretrained(data, env=one, retrieval_images=3).learn(2 * LENGTH)
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", env=other, dataset=data)
    nothing = SimpleNamespace(restore=lambda agent, folder: None)
    learning.resume(job(tmp_path), loaded, nothing)
    for goes_on in (model, loaded):
        goes_on.learn(LENGTH, reset_num_timesteps=False)
    images = [agent.replay_buffer.trajectories[-1].image[0] for agent in (model, loaded)]
    np.testing.assert_array_equal(*images)
