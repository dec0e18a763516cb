"""Pre-training leaves a curve, and whatever stops it loses nothing."""

import csv
import fcntl
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from debug_agent import SETTINGS, recorded, same, weights
from gymnasium.spaces import Discrete
from gymnasium.wrappers import TransformAction
from stable_baselines3.common.callbacks import CheckpointCallback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_env import DotEnv

from wpt_agents.agents.r3m import R3M
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import read_model
from wpt_agents.training import logs, pretraining
from wpt_agents.training.learner import Learner
from wpt_agents.training.signals import StopSignals

DATA = [recorded(seed=seed) for seed in range(4)]
STEP = "time/pretrain_steps"
LOSS = "train/reconstruction_loss"


class Terminated(Exception):
    """What SIGTERM raises in a test."""


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Write a row of every two updates, and a model of every four."""
    monkeypatch.setattr(logs, "LOG_EVERY", 2)
    monkeypatch.setattr(pretraining, "SAVE_EVERY", 4)


@pytest.fixture(autouse=True)
def attended():
    """Let Ctrl-C interrupt: a shell lets its background jobs ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def pretrain(run_dir=None, steps=7, **changes):
    return WPT.pretrain(DATA, steps=steps, run_dir=run_dir, **SETTINGS | changes)


def test_the_number_of_updates_may_be_a_whole_float(tmp_path):
    assert pretrain(steps=2.0, run_dir=tmp_path).pretrain_steps == 2
    assert R3M.pretrain(DATA, steps=1e0, channels=2, clips=2).pretrain_steps == 1


def test_a_callback_of_sb3_is_refused_before_the_first_update(tmp_path):
    with pytest.raises(ValueError, match="a CheckpointCallback cannot be: pass a function"):
        pretrain(tmp_path, callback=CheckpointCallback(1, str(tmp_path)))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [WPT, R3M])
def test_an_environment_that_does_not_suit_is_refused_before_anything_is_trained(kind, tmp_path):
    settings = SETTINGS if kind is WPT else {"channels": 2, "clips": 2}
    with pytest.raises(ValueError, match="the environment takes Discrete"):
        kind.pretrain(
            DATA, TransformAction(DotEnv(), int, Discrete(2)), 1, run_dir=tmp_path, **settings
        )
    assert not list(tmp_path.iterdir())


def test_the_run_folder_of_another_agent_is_refused_by_its_name(tmp_path):
    R3M.pretrain(DATA, steps=1, channels=2, clips=2, run_dir=tmp_path)
    with pytest.raises(ValueError, match=r"is of R3M: read it with R3M\.load"):
        pretrain(run_dir=tmp_path)
    with pytest.raises(ValueError, match=r"is of R3M: read it with R3M\.load"):
        WPT(**SETTINGS).set_parameters(tmp_path / "model.zip")


def rows(folder):
    with open(folder / "progress.csv") as file:
        return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]


def curve(folder):
    """The steps and values of the loss that TensorBoard shows of a folder."""
    events = EventAccumulator(str(folder))
    events.Reload()
    return [(event.step, pytest.approx(event.value, rel=1e-5)) for event in events.Scalars(LOSS)]


def kill_in_update(number, monkeypatch, received):
    """Send a signal to this process in the middle of an update."""
    update, made = Learner.update_world_model, []

    def killed(*args, **kwargs):
        made.append(0)
        if len(made) == number:
            os.kill(os.getpid(), received)
        return update(*args, **kwargs)

    monkeypatch.setattr(Learner, "update_world_model", killed)


def test_the_curve_holds_the_means_between_its_rows(tmp_path):
    losses = []
    pretrain(tmp_path / "run", callback=lambda _, metrics: losses.append(metrics[LOSS]))
    expected = [np.mean(losses[:2]), np.mean(losses[2:4]), np.mean(losses[4:6]), losses[6]]
    table = rows(tmp_path / "run")
    assert [row[STEP] for row in table] == [2, 4, 6, 7]  # the last row is of a single update
    assert [row[LOSS] for row in table] == pytest.approx(expected, rel=1e-5)
    assert curve(tmp_path / "run") == list(zip([2, 4, 6, 7], expected, strict=True))


def test_tensorboard_log_has_a_folder_for_each_pretraining(tmp_path):
    for number in (1, 2):
        pretrain(tensorboard_log=str(tmp_path), steps=3)
        assert [step for step, _ in curve(tmp_path / f"pretrain_{number}")] == [2, 3]
    assert len(list(tmp_path.iterdir())) == 2


def test_verbose_prints_the_curve_and_the_keywords(capsys):
    pretrain(steps=2, verbose=1)
    said = capsys.readouterr().out
    assert "reconstruction_loss" in said and "pretrain_steps" in said and "size='debug'" in said


def test_nothing_is_written_or_printed_unasked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    pretrain(steps=2)
    assert not list(tmp_path.iterdir()) and not capsys.readouterr().out


@pytest.mark.parametrize("number", [1, 3, 5])
def test_ctrl_c_saves_the_update_that_it_falls_into(tmp_path, monkeypatch, number):
    with monkeypatch.context() as patch:
        kill_in_update(number, patch, signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            pretrain(tmp_path / "run")
    counters = read_model(tmp_path / "run" / "model.zip")[0]["counters"]
    assert counters["pretrain_steps"] == number
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    seen = []
    model = pretrain(tmp_path / "run", callback=lambda step, _: seen.append(step))
    assert seen == list(range(number + 1, 8))
    assert same(weights(model), weights(pretrain(tmp_path / "whole")))
    steps = [row[STEP] for row in rows(tmp_path / "run")]
    assert steps == sorted({2, 4, 6, 7, number})  # none twice; one of the updates before the stop
    assert [step for step, _ in curve(tmp_path / "run")] == steps


def test_sigterm_saves_and_then_does_what_it_would_have_done(tmp_path, monkeypatch):
    def end(*_):
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        kill_in_update(3, monkeypatch, signal.SIGTERM)
        with pytest.raises(Terminated):
            pretrain(tmp_path)
        assert signal.getsignal(signal.SIGTERM) is end
    finally:
        signal.signal(signal.SIGTERM, before)
    assert WPT.load(tmp_path / "model.zip").pretrain_steps == 3


def test_a_process_that_goes_on_after_sigterm_is_saved_and_trained_to_its_end(
    tmp_path, monkeypatch
):
    received = []
    before = signal.signal(signal.SIGTERM, lambda *_: received.append(0))
    try:
        kill_in_update(3, monkeypatch, signal.SIGTERM)
        model = pretrain(tmp_path)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert received == [0] and model.pretrain_steps == 7
    assert [row[STEP] for row in rows(tmp_path)] == [2, 3, 4, 6, 7]


def test_a_callback_that_stops_pretraining_loses_no_update(tmp_path):
    def stop(step, _):
        if step == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        pretrain(tmp_path, callback=stop)
    assert WPT.load(tmp_path / "model.zip").pretrain_steps == 3
    assert [row[STEP] for row in rows(tmp_path)] == [2, 3]


def test_after_kill_9_each_row_is_there_once(tmp_path):
    """The model is of update 4 when the process dies in update 7, in the middle of a row."""
    kept = tmp_path / "kept"
    kept.mkdir()

    def keep(step, _):
        if step == 5:
            shutil.copy(tmp_path / "run" / "model.zip", kept)

    whole = pretrain(tmp_path / "run", callback=keep)
    expected = rows(tmp_path / "run")
    shutil.copy(kept / "model.zip", tmp_path / "run")
    with open(tmp_path / "run" / "progress.csv", "a") as file:
        file.write("8,0.")
    model = pretrain(tmp_path / "run")
    assert same(weights(model), weights(whole))
    assert rows(tmp_path / "run") == expected
    assert curve(tmp_path / "run") == [(row[STEP], row[LOSS]) for row in expected]


def test_a_table_of_version_0_1_goes_on(tmp_path):
    path = tmp_path / "progress.csv"
    path.write_text("train/kl\n1.5\n2.5\n3.5\n")  # of updates 2, 4 and 6
    table = logs.ContinuedCSV(path)
    table.keep(4)
    table.write({"train/kl": 4.5, STEP: 6}, {"train/kl": (), STEP: ()}, 6)
    table.close()
    assert path.read_text() == f"train/kl,{STEP}\n1.5,\n2.5,\n4.5,6\n"


def test_a_folder_in_which_another_process_trains_is_refused(tmp_path):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with pytest.raises(ValueError, match="Another process trains in run_dir="):
        pretrain(tmp_path)
    assert not list(tmp_path.iterdir())
    os.close(descriptor)
    assert pretrain(tmp_path, steps=2).pretrain_steps == 2
    assert pretrain(tmp_path, steps=4).pretrain_steps == 4  # the first one released its lock


def test_a_folder_that_has_all_updates_already_says_so(tmp_path):
    pretrain(tmp_path, steps=3)
    message = r"holds a model of 3 updates already, so that steps=2 makes none: .* steps above 3"
    with pytest.warns(UserWarning, match=message):
        pretrain(tmp_path, steps=2)
    assert pretrain(tmp_path, steps=4).pretrain_steps == 4  # the remedy


def test_without_tensorboard_the_table_is_written_and_tensorboard_log_is_refused(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(logs, "SummaryWriter", None)
    pretrain(tmp_path, steps=2)
    assert {path.name for path in tmp_path.iterdir()} == {"model.zip", "progress.csv"}
    with pytest.raises(ImportError, match="pip install tensorboard"):
        pretrain(tensorboard_log=str(tmp_path), steps=2)


def test_r3m_leaves_a_curve_and_loses_nothing_either(tmp_path, monkeypatch):
    def train(**keywords):
        settings = {"channels": 2, "clips": 2, "seed": 0, "device": "cpu", "steps": 5}
        return R3M.pretrain([recorded(length=12, seed=s) for s in range(4)], **settings, **keywords)

    def stop(step, _):
        if step == 3:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt):
        train(run_dir=tmp_path, callback=stop)
    resumed = train(run_dir=tmp_path, tensorboard_log=str(tmp_path / "tb"))
    assert same(weights(resumed), weights(train()))
    assert [row[STEP] for row in rows(tmp_path)] == [2, 3, 4, 5]
    assert all(row["pretrain/r3m_loss"] > 0 for row in rows(tmp_path))


def test_a_second_signal_takes_effect_at_once():
    with pytest.raises(KeyboardInterrupt), StopSignals() as signals:
        signal.raise_signal(signal.SIGINT)
        assert signals.received == signal.SIGINT
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_signal_after_the_last_update_is_not_lost():
    with pytest.raises(KeyboardInterrupt), StopSignals():
        signal.raise_signal(signal.SIGINT)


def test_a_message_that_nobody_reads_stops_nothing(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    before = os.dup(2)
    os.dup2(writer, 2)
    noted = 0
    try:
        with os.fdopen(writer, "w") as gone:
            monkeypatch.setattr(sys, "stderr", gone)
            with pytest.raises(KeyboardInterrupt), StopSignals("stopping") as signals:
                signal.raise_signal(signal.SIGINT)
                noted = signals.received  # not reached if the handler raises an error
    finally:
        monkeypatch.undo()
        os.dup2(before, 2)
        os.close(before)
    assert noted == signal.SIGINT


def test_a_message_is_where_the_standard_error_goes(tmp_path, monkeypatch):
    with open(tmp_path / "log.txt", "w") as log:
        monkeypatch.setattr(sys, "stderr", log)
        with pytest.raises(KeyboardInterrupt), StopSignals("stopping"):
            signal.raise_signal(signal.SIGINT)
    assert (tmp_path / "log.txt").read_text() == "\nstopping\n"


def test_ignored_signals_stay_ignored_and_threads_are_left_alone():
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        with StopSignals() as signals:
            signal.raise_signal(signal.SIGTERM)
            assert not signals.received
    finally:
        signal.signal(signal.SIGTERM, before)
    failed = []

    def elsewhere():
        try:
            with StopSignals():
                pass
        except ValueError as error:  # of `signal.signal` outside of the main thread
            failed.append(error)

    thread = threading.Thread(target=elsewhere)
    thread.start()
    thread.join()
    assert not failed


SCRIPT = """
import os, signal, sys
sys.path[:0] = {helpers!r}
from debug_agent import SETTINGS, recorded
from wpt_agents.agents.wpt import WPT
from wpt_agents.training.learner import Learner

rank, folder = int(os.environ["RANK"]), sys.argv[1]
step, made = Learner.take_step, []

def killed(self, *args):
    made.append(0)
    if rank == 1 and len(made) == 3:
        os.kill(os.getpid(), signal.SIGTERM)
    return step(self, *args)

Learner.take_step = killed
data = [recorded(seed=seed) for seed in range(4)]
settings = SETTINGS | {{"tensorboard_log": None}}
WPT.pretrain(data, steps=7, run_dir=folder, **settings)
print("finished", rank)
"""


@pytest.mark.slow
def test_sigterm_to_one_of_torchruns_processes_stops_all_and_loses_nothing(tmp_path):
    root = Path(__file__).parents[2]
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(helpers=[str(root / "tests" / "helpers")]))
    path = os.pathsep.join([str(root), str(root / "envs"), os.environ.get("PYTHONPATH", "")])
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    done = subprocess.run(
        [*launch, str(script), str(tmp_path / "run")],
        env=os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode and "finished" not in done.stdout, done.stderr[-2000:]
    assert read_model(tmp_path / "run" / "model.zip")[0]["counters"]["pretrain_steps"] == 3
    assert [row[STEP] for row in rows(tmp_path / "run")] == [3]
    model = pretrain(tmp_path / "run")
    whole = weights(pretrain(tmp_path / "whole"))
    for name, weight in weights(model).items():  # as test_distributed has it: equal to rounding
        assert (weight - whole[name]).abs().float().mean() < 2e-5, name
