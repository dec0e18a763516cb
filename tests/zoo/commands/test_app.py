"""The command line end to end: help, refusals, dry runs, and a whole benchmark of the toy task."""

import json
from dataclasses import replace

import numpy as np
import pytest
import yaml
from debug_agent import recorded
from dot_runs import SECTIONS, dot  # noqa: F401  (dot registers the task for each test)
from typer.main import get_command
from zoo_command import call

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.commands import app as command_line
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan
from wpt_agents.zoo.report import record
from wpt_agents.zoo.result import Variant

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "--preset", "demmo"], "Did you mean 'demo'"),
        (["run", "--suite", "dcm"], "Did you mean 'dmc'"),
        (["run", "--tasks", "walker-rum"], "Did you mean 'walker-run'"),
        (["run", "--set", "gama=1"], "Did you mean 'gamma'"),
        (["run", "--set", "learn.fames=1"], "Did you mean 'frames'"),
        (["run", "--method", "scrath"], "Did you mean 'scratch'"),
        (["run", "--seeds", "none"], "how many"),
        (["run", "--tasks", "walker-run", "walker-rum"], "Did you mean 'walker-run'"),
        (["run", "--data", "nowhere"], "nowhere does not exist"),
        (["report", "nowhere"], "No finished run below nowhere"),
        (["list", "--suite", "dcm"], "Did you mean 'dmc'"),
        (["pretrain", "--preset", "demmo"], "Did you mean 'demo'"),
        (["collect", "--out", "data", "--tasks", "walker-rum"], "Did you mean 'walker-run'"),
        (["collect", "--out", "data", "--behaviour", "icn"], "Did you mean 'icm'"),
        (["collect", "--out", "data", "--behaviour", "icm", "--set", "gama=1"], "mean 'gamma'"),
        (["collect", "--out", "data", "--behaviour", "icm", "--set", "gamma=2"], "gamma must be a"),
        (["run", "--preset", "debug", "--device", "cuda:99"], "--device cuda:99: torch"),
        (["run", "--preset", "debug", "--device", "gpu"], "write auto, cpu, cuda"),
        (["run", "--preset", "debug", "--device", "gpu", "--engine", "local"], "write auto, cpu"),
        (["pretrain", "--preset", "debug", "--device", "cuda:99"], "--device cuda:99: torch"),
        (["run", "--preset", "debug", "--cpus", "4"], "--cpus has no effect with --engine none"),
        (["run", "--preset", "debug", "--engine", "local", "--gpus", "1"], "take ray or slurm"),
        (["run", "--preset", "debug", "--engine", "slurm", "--gpus", "0.5"], "whole GPUs"),
    ],
)
def test_a_wrong_name_ends_in_the_nearest_valid_one_and_code_2(
    words, message, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)
    assert call(monkeypatch, *words) == 2
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err and printed.out == ""  # refused before anything is begun
    assert list(tmp_path.iterdir()) == []


COMMANDS = get_command(command_line.app).commands


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_has_help(command, monkeypatch, capsys):
    assert call(monkeypatch, *command, "--help") == 0
    assert "Usage" in capsys.readouterr().out


@pytest.mark.parametrize(("suite", "preset"), [("dmc", "demo"), ("robotics", "tiny")])
def test_every_suite_runs_without_the_name_of_a_preset(
    suite, preset, monkeypatch, capsys, tmp_path
):
    monkeypatch.chdir(tmp_path)  # a short --out, which the table shows whole
    assert call(monkeypatch, "run", "--suite", suite, "--dry-run") == 0
    assert f"/{preset}/wpt/" in "".join(capsys.readouterr().out.split())


def test_the_list_shows_tasks_presets_and_methods(monkeypatch, capsys):
    assert call(monkeypatch, "list", "--suite", "dmc") == 0
    printed = capsys.readouterr().out
    for word in ("dmc-quadruped-roll-fast", "demo", "no-rehearsal"):
        assert word in printed
    assert "metaworld" not in printed


def test_a_dry_run_shows_the_plan_and_writes_nothing(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "cheetah-*", "--seeds", "2", "--out", tmp_path / "runs"]
    assert call(monkeypatch, "run", *words, "--preset", "debug", "--dry-run") == 0
    printed = capsys.readouterr().out
    assert printed.count("dmc-cheetah-run-back ") == 2
    assert "6 episodes to collect" in printed and " runs to do" in printed
    assert not (tmp_path / "runs").exists()


def test_from_nothing_pre_trains_where_a_preset_starts_from_a_shipped_model(
    monkeypatch, capsys, tmp_path
):
    words = ["--suite", "metaworld", "--tasks", "drawer-close", "--preset", "demo"]
    words += ["--dry-run", "--out", tmp_path / "runs"]
    assert call(monkeypatch, "run", *words) == 0
    assert "world model  metaworld-mid, which ships" in capsys.readouterr().out
    assert call(monkeypatch, "run", *words, "--from-nothing") == 0
    assert "world model  2,500 updates to make" in capsys.readouterr().out


def test_from_nothing_looks_at_the_presets_of_the_sequence(monkeypatch, capsys, tmp_path):
    words = ["--sequence", "ant", "--suite", "robotics", "--preset", "mid", "--dry-run"]
    words += ["--out", tmp_path / "runs"]
    assert call(monkeypatch, "run", *words) == 0
    assert "world model  dmc-mid, which ships" in capsys.readouterr().out
    assert call(monkeypatch, "run", *words, "--from-nothing") == 0
    assert "world model  9,000 updates to make" in capsys.readouterr().out


def test_from_nothing_changes_no_label_where_a_preset_pre_trains_anyway(monkeypatch, tmp_path):
    planned = []
    monkeypatch.setattr(
        "wpt_agents.zoo.run.dispatch.preview", lambda runs, *_: planned.extend(runs)
    )
    words = ["--tasks", "walker-run", "--preset", "debug", "--out", tmp_path]
    assert call(monkeypatch, "run", *words, "--from-nothing", "--dry-run") == 0
    assert str(planned[0].variant) == "debug"


def test_pretrain_refuses_a_preset_that_starts_from_a_shipped_model(monkeypatch, capsys, tmp_path):
    words = ["--suite", "metaworld", "--preset", "demo", "--out", tmp_path]
    assert call(monkeypatch, "pretrain", *words) == 2
    assert "--set pretrain.model= to pre-train another" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("max_action_dim=6", "The data have 12 actions, the preset's max_action_dim is 6: --set"),
        ("collect.behaviour=policy", "No collect.behaviour 'policy'"),
        ("env.rendering=fats", "Did you mean 'fast'"),
    ],
)
def test_pretrain_refuses_settings_before_it_collects(
    setting, message, monkeypatch, capsys, tmp_path
):
    words = ["pretrain", "--preset", "debug", "--out", tmp_path, "--set", setting]
    assert call(monkeypatch, *words) == 2
    assert message in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def test_a_pre_trained_model_can_be_shared_as_the_shipped_ones_are(monkeypatch, capsys, tmp_path):
    store, shared = tmp_path / "data", tmp_path / "toy-mid.zip"
    with TrajectoryDataset.create(store) as dataset:
        dataset.append(recorded(20))
    words = [
        "--preset",
        "debug",
        "--data",
        store,
        "--set",
        "batch_size=2",
        "--set",
        "batch_length=4",
    ]
    words += ["--out", tmp_path, "--share", shared]
    assert call(monkeypatch, "pretrain", *words) == 0
    assert f"To share: {shared}" in capsys.readouterr().out
    assert WPT.load(shared).pretrain_steps == 3 and shared.stat().st_size < 1e6


def test_a_dry_run_ends_in_what_the_run_would_be_refused_for(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "--device", "cuda:99", "--preset", "debug", "--dry-run"]
    assert call(monkeypatch, "run", *words, "--out", tmp_path / "runs") == 2
    printed = capsys.readouterr()
    assert "1 of 1 run to do" in printed.out and "--device cuda:99" in printed.err


def test_true_rewards_are_asked_for_before_any_work_with_a_remedy_that_works(
    monkeypatch, capsys, tmp_path
):
    words = ["run", "--tasks", "walker-walk", "--preset", "debug", "--dry-run", "--out", tmp_path]
    words += ["--method", "rlpd"]
    assert call(monkeypatch, *words) == 2
    assert "none in the data of a preset: use --data with rewards" in capsys.readouterr().err
    for reward, ends_in in ((None, 2), (np.ones(9, np.float32), 0)):
        folder = tmp_path / f"ends in {ends_in}"
        with TrajectoryDataset.create(folder) as data:
            data.append(replace(recorded(9, actions=6), reward=reward))
        assert call(monkeypatch, *words, "--data", folder) == ends_in
        assert (f"none in --data {folder}" in capsys.readouterr().err) == (reward is None)


def test_a_dry_run_marks_the_runs_that_a_record_has(monkeypatch, capsys, tmp_path):
    path = tmp_path / "mid.csv"
    words = ["run", "--suite", "metaworld", "--tasks", "hammer", "reach", "--preset", "mid"]
    words += ["--method", "wpt+", "--seeds", "2", "--dry-run", "--out", tmp_path / "runs"]
    where = "metaworld", "metaworld-hammer", "wpt+", 1, Variant.parse("mid"), 12_000
    record.update(path, [record.Line(*where, 50.0, 500.0, 0.5, 0.4, "c", "x")])
    assert call(monkeypatch, *words, "--record", path) == 0
    printed = capsys.readouterr().out
    assert printed.count("to do") == 4 + 1 and printed.count("recorded") == 1  # and a summary
    assert "has 1 of 4 runs" in printed
    (row,) = (line for line in printed.splitlines() if "recorded" in line)
    assert "hammer" in row and "│ 1 " in row
    assert call(monkeypatch, *words, "--record", path, "--frames", "6000") == 0
    assert "recorded" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--record", "a.txt"], "a record is a .csv"),
        (["--record", "a.csv", "--watch"], "cannot be combined with"),
        (["--record", "a.csv", "--sequence", "ant"], "cannot be combined with"),
    ],
)
def test_a_record_that_would_not_be_written_is_refused(
    words, message, monkeypatch, capsys, tmp_path
):
    assert call(monkeypatch, "run", "--preset", "debug", "--out", tmp_path, *words) == 2
    assert message in capsys.readouterr().err and list(tmp_path.iterdir()) == []


def test_a_dry_run_tells_of_a_folder_with_other_settings_too(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "walker-run", "--preset", "debug", "--out", tmp_path]
    folder = tmp_path / "debug" / "wpt" / "dmc-walker-run_0"
    folder.mkdir(parents=True)
    [one] = make_plan("dmc", ["walker-run"], Request("debug", out=tmp_path))
    (folder / "config.yaml").write_text(yaml.safe_dump(json.loads(json.dumps(one.config()))))
    assert call(monkeypatch, "run", *words, "--dry-run") == 0
    assert call(monkeypatch, "run", *words, "--dry-run", "--set", "gamma=0.9") == 2
    assert "other settings (wpt.gamma)" in capsys.readouterr().err


def test_collecting_ends_in_a_summary_of_what_there_is(monkeypatch, capsys, tmp_path):
    words = ["--tasks", "dot", "--episodes", "2", "--workers", "1", "--rendering", "fast"]
    assert call(monkeypatch, "collect", "--out", tmp_path / "data", *words) == 0
    printed = capsys.readouterr().out
    assert "embodiment" in printed and "Dataset:" in printed and "{" not in printed


def test_the_whole_command_line_runs_and_reports(monkeypatch, capsys, tmp_path):
    titles = ("env", "collect", "pretrain", "learn", "evaluate", "wpt")  # not of other agents
    sections = [f"{t}.{k}={json.dumps(v)}" for t in titles for k, v in SECTIONS[t].items()]
    words = ["run", "--preset", "debug", "--tasks", "dot", "--out", tmp_path, "--workers", "1"]
    assert call(monkeypatch, *words, "--frames", "50", "--set", *sections) == 0
    folder = tmp_path / "debug" / "wpt" / "dmc-dot_0"
    assert str(folder) in capsys.readouterr().out
    assert json.loads((folder / "result.json").read_text())["frames"] == 50
    assert call(monkeypatch, "report", tmp_path) == 0
    assert "dmc-dot" in capsys.readouterr().out
    assert call(monkeypatch, "report", tmp_path, "--markdown") == 0
    printed = capsys.readouterr().out
    assert all(f"| {name} |" in printed for name in ("doing nothing", "prior actor", "wpt"))
    assert call(monkeypatch, "report", tmp_path, "--csv") == 0
    assert capsys.readouterr().out.startswith("task,preset,frames,method,policy")
