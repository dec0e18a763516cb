"""A sequence of tasks: what is kept from task to task, and that a killed one ends alike."""

import json
from dataclasses import replace
from itertools import count

import gymnasium as gym
import numpy as np
import pytest
import yaml
from dot_runs import DOT, SECTIONS, dot, job, make_dot  # noqa: F401
from test_resume import KillAt, Killed
from wpt_envs.tasks import TASKS
from zoo_command import call

from wpt_agents.agents.packnet import PackNet
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import read_model
from wpt_agents.zoo.plan.presets import load_preset, preset_names
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.sequences import SequenceRun, find_sequence, make_sequences
from wpt_agents.zoo.run import learning, sequences
from wpt_agents.zoo.run.sequences import run_sequence, run_sequences
from wpt_agents.zoo.sequence_result import read_row, read_sequence

DOTS = [replace(DOT, name=name) for name in ("dot", "dot-two", "dot-three")]
NAMES = [f"dmc-{task.name}" for task in DOTS]


@pytest.fixture(autouse=True)
def dots(dot, monkeypatch):  # noqa: F811  # dot is the fixture of the first task
    for task in DOTS[1:]:
        monkeypatch.setitem(TASKS, task.id, task)
        gym.register(task.id, entry_point=make_dot)
    yield
    for task in DOTS[1:]:
        del gym.registry[task.id]


def sequence(tmp_path, method, tasks=3, **changes):
    one = job(tmp_path, method, learn={"frames": 50, "checkpoint_every": 25} | changes)
    one.preset.agents["packnet"] = {"tasks": tasks}
    return SequenceRun("dots", [replace(one, task=t, sequence="dots") for t in DOTS[:tasks]])


def returns(result):
    return [{task: score.returns for task, score in row.scores.items()} for row in result.rows]


def tensors(folder):
    _, groups = read_model(folder / "model.zip")
    return {f"{g}/{k}": v.numpy() for g, group in groups.items() for k, v in group.items()}


@pytest.mark.slow
def test_packnet_acts_on_earlier_tasks_as_before(tmp_path):
    whole = sequence(tmp_path, "packnet")
    result = run_sequence(whole)
    assert [list(row.scores) for row in result.rows] == [NAMES[:1], NAMES[:2], NAMES]
    two, three = returns(result)[1:]
    assert two[NAMES[0]] == three[NAMES[0]]  # since its pruning, when the second task began
    assert two[NAMES[0]] != two[NAMES[1]]
    assert [row.updates > 0 for row in result.rows] == [True] * 3
    assert run_sequence(whole) == result == read_sequence(whole.folder)
    assert not list(whole.folder.glob("*/replay")) and not list(whole.folder.glob("*/checkpoints"))
    assert (whole.runs[2].folder / "0.monitor.csv").exists()


@pytest.mark.slow
def test_wpt_retrieves_from_the_episodes_of_earlier_tasks(tmp_path, monkeypatch):
    kept, learn = [], WPT.learn

    def recorded(self, *args, **kwargs):
        kept.append([len(t) for t in self.kept.trajectories] if self.kept else [])
        return learn(self, *args, **kwargs)

    monkeypatch.setattr(WPT, "learn", recorded)
    result = run_sequence(sequence(tmp_path, "wpt"))
    assert kept == [[], [25] * 2, [25] * 4]
    assert all(np.isfinite(row.learned.mean) for row in result.rows)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["packnet", "wpt"])
def test_a_killed_sequence_ends_as_one_that_was_not(method, tmp_path, monkeypatch):
    whole, killed = (sequence(tmp_path / name, method, tasks=2) for name in ("one", "other"))
    expected = run_sequence(whole)
    bars = iter([None, 40])  # the first task ends, the second is killed at its step 40
    with monkeypatch.context() as patch:
        patch.setattr(learning, "LearningBar", lambda _: KillAt(next(bars)))
        with pytest.raises(Killed):
            run_sequence(killed)
    assert read_row(killed.runs[0].folder) and not read_row(killed.runs[1].folder)
    assert list(killed.runs[1].folder.glob("checkpoints/step-*"))
    assert len(read_sequence(killed.folder).rows) == 1
    assert_ends_alike(killed, whole, expected)


def assert_ends_alike(killed, whole, expected):
    """That a killed sequence, run again, has the scores and the model of an undisturbed one."""
    assert returns(run_sequence(killed)) == returns(expected)
    one, other = tensors(whole.runs[1].folder), tensors(killed.runs[1].folder)
    assert one.keys() == other.keys() and all((one[k] == other[k]).all() for k in one)


def killing(function, at):
    """The function, but the call of this number, from 0 on, ends in a kill."""
    numbers = count()

    def killed(*args, **kwargs):
        if next(numbers) == at:
            raise Killed
        return function(*args, **kwargs)

    return killed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "owner", "name", "at"),
    [
        ("packnet", PackNet, "_retrain", 0),  # the second task begins by pruning the first
        ("packnet", sequences, "play", 1),  # the second task is learned, but has no scores yet
        ("wpt", sequences, "play", 1),
        ("wpt", sequences, "learn", 1),  # before the second task's first step
        ("wpt", sequences, "write_sequence", 0),  # the first task's scores are written alone
    ],
)
def test_a_sequence_that_is_killed_between_two_tasks_ends_as_one_that_was_not(
    method, owner, name, at, tmp_path, monkeypatch
):
    whole, killed = (sequence(tmp_path / folder, method, tasks=2) for folder in ("one", "other"))
    expected = run_sequence(whole)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, killing(getattr(owner, name), at))
        with pytest.raises(Killed):
            run_sequence(killed)
    assert read_row(killed.runs[0].folder) and not read_row(killed.runs[1].folder)
    assert_ends_alike(killed, whole, expected)


def test_a_sequence_that_fails_is_reported_and_stops_no_other(tmp_path, monkeypatch):
    jobs = [sequence(tmp_path / name, "packnet", tasks=1) for name in ("one", "other")]
    begun = []

    def failing(job):
        begun.append(job)
        raise RuntimeError("out of luck")

    monkeypatch.setattr(sequences, "_do_tasks", failing)
    assert not run_sequences(jobs) and begun == jobs
    assert "out of luck" in (jobs[0].folder / "error.txt").read_text(encoding="utf-8")


@pytest.mark.parametrize("method", ["wpt", "packnet"])
@pytest.mark.parametrize("preset", ["debug", "tiny", "mid", "paper"])
def test_the_ant_sequence_can_be_planned_from_every_preset(method, preset, tmp_path):
    (one,) = make_sequences("ant", Request(preset, methods=[method], out=tmp_path))
    assert [run.task.name for run in one.runs] == list(find_sequence("ant").tasks)
    assert one.runs[0].preset.collect.tasks == ("dmc-quadruped-run",)
    assert not one.runs[0].preset.evaluate.keep_best
    assert one.folder == tmp_path / preset / method / "ant_0"
    assert len({run.folder for run in one.runs}) == 6
    if method == "packnet":
        assert one.runs[0].keywords["tasks"] == 6
    one.config()


def test_the_ant_sequence_of_the_paper_has_300_000_frames_a_task_and_a_small_world_model():
    changes = find_sequence("ant").changes("paper")
    preset = load_preset("dmc", "paper", (), changes)
    assert preset.learn.frames == 300_000 and preset.wpt["size"] == "small"
    assert set(find_sequence("ant").presets) <= set(preset_names("dmc"))


def test_methods_that_learn_single_tasks_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"drq-v2 learns single tasks; .* wpt, .* packnet"):
        make_sequences("ant", Request("debug", methods=["drq-v2"], out=tmp_path))
    with pytest.raises(ValueError, match="ants"):
        find_sequence("ants")


def test_the_command_shows_the_plan_and_refuses_what_does_not_go_together(
    tmp_path, monkeypatch, capsys
):
    words = ["run", "--sequence", "ant", "--method", "packnet", "--preset", "debug"]
    assert call(monkeypatch, *words, "--dry-run", "--out", tmp_path) == 0
    assert "dmc-quadruped-roll-fast" in capsys.readouterr().out
    assert call(monkeypatch, *words, "--tasks", "walker-run") != 0
    assert "--sequence cannot be combined" in capsys.readouterr().err


def test_a_dry_run_tells_of_a_sequence_with_other_settings(tmp_path, monkeypatch, capsys):
    words = ["run", "--sequence", "ant", "--method", "packnet", "--preset", "debug"]
    words += ["--dry-run", "--out", tmp_path]
    [one] = make_sequences("ant", Request("debug", methods=["packnet"], out=tmp_path))
    one.folder.mkdir(parents=True)
    (one.folder / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(one.config()))))
    assert call(monkeypatch, *words) == 0
    assert call(monkeypatch, *words, "--set", "packnet.batch_size=9") == 2
    assert "other settings (packnet.batch_size)" in capsys.readouterr().err
