"""Time and disk space are estimated before work starts, and too little space stops it."""

import shutil
from collections import namedtuple
from dataclasses import asdict, replace

import pytest
from debug_agent import recorded
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)
from run_folders import make_run
from zoo_command import call

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.model.sizes import SIZES
from wpt_agents.zoo.plan.estimate import (
    LARGEST,
    check_space,
    disk_needed,
    gigabytes,
    hours_needed,
    parameters,
    summary,
)
from wpt_agents.zoo.plan.overview import show_plan
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.sequence_result import Row, write_row

Usage = namedtuple("Usage", "total used free")


def test_the_dataset_and_two_models_a_run_are_counted(tmp_path):
    scratch = [job(tmp_path, "scratch", seed) for seed in range(2)]
    # debug: 200,000 parameters of 12 bytes; two files a run, two checkpoints; 75 raw images
    assert disk_needed(scratch) == (2 * 2 + 2) * 2_400_000 + 75 * 12_288
    # 4 episodes of one task, counted as 1,000 steps
    assert disk_needed([job(tmp_path)]) - disk_needed(scratch[:1]) == 4 * 1000 * 2_500


def test_a_plan_counts_the_episodes_that_a_dataset_lacks(tmp_path, capsys):
    one = job(tmp_path)
    whole = disk_needed([one])
    with TrajectoryDataset.create(one.shared.data_path) as dataset:
        dataset.append(recorded())
    assert whole - disk_needed([one]) == 1000 * 2_500
    show_plan([one], force=False)
    assert "dataset      3 episodes to collect" in capsys.readouterr().out
    with TrajectoryDataset.open(one.shared.data_path) as dataset:
        dataset.extend(recorded() for _ in range(3))
    show_plan([one], force=False)
    assert "dataset      exists" in capsys.readouterr().out


def test_a_finished_task_of_a_sequence_needs_no_more_space(tmp_path):
    runs = [replace(job(tmp_path, "scratch", seed), sequence="dots") for seed in range(2)]
    left = disk_needed(runs[1:])
    assert disk_needed(runs) > left
    score = Score((1.0,))
    runs[0].folder.mkdir(parents=True)
    write_row(runs[0].folder, Row("dmc-dot", {"dmc-dot": score}, 1, 1.0, 1.0))
    assert disk_needed(runs) == left


def test_networks_of_ones_own_widths_count_as_the_next_larger_ones():
    assert parameters(SIZES["debug"]) == parameters("debug") == 0.2e6
    wider = {**asdict(SIZES["debug"]), "deter": 72}
    assert parameters(wider) == parameters("tiny")
    assert parameters({**wider, "deter": 20_000}) == LARGEST == parameters("paper")


def test_no_room_is_told_before_any_work(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10, 9, 1))
    with pytest.raises(ValueError, match=r"0 MB free.*need about"):
        check_space([job(tmp_path)])
    words = ["run", "--tasks", "dot", "--method", "scratch", "--preset", "debug"]
    words += ["--out", tmp_path / "new"]
    assert call(monkeypatch, *words) == 2
    assert "make room" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_hours_come_from_finished_runs_of_the_preset(tmp_path):
    jobs = [job(tmp_path, seed=seed) for seed in range(2)]
    assert hours_needed(jobs, jobs[0]) is None
    assert "time unknown until" in summary(jobs)
    make_run(tmp_path, "dmc-walker-run", preset="toy", frames=1000)  # 2 seconds
    assert hours_needed(jobs, jobs[0]) == pytest.approx(2 / 1000 * 150 / 3600)
    finished = tmp_path / "toy" / "wpt" / "dmc-walker-run_0"
    shutil.copytree(finished, finished.with_suffix(".bak"))  # which only a report refuses
    assert hours_needed(jobs, jobs[0]) == pytest.approx(2 / 1000 * 150 / 3600)
    other = [replace(one, preset_name="other") for one in jobs]
    assert hours_needed(other, other[0]) is None


def test_what_force_makes_anew_is_counted(tmp_path):
    jobs = [job(tmp_path, seed=seed) for seed in range(2)]
    assert make_run(tmp_path, "dmc-dot", preset="toy", frames=75) == jobs[0].folder
    assert summary(jobs).startswith("1 of 2 runs to do")
    assert summary(jobs, force=True).startswith("2 of 2 runs to do")


@pytest.mark.parametrize(("size", "text"), [(5e6, "5 MB"), (2.54e9, "2.5 GB")])
def test_sizes_are_read_easily(size, text):
    assert gigabytes(size) == text
