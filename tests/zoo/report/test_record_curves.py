"""The learning curves beside a record."""

import shutil
from contextlib import nullcontext

import numpy as np
import pytest
from run_folders import make_run
from typer.testing import CliRunner

from wpt_agents.zoo.commands.app import app
from wpt_agents.zoo.report import record, record_curves, record_page
from wpt_agents.zoo.report.evidence import evidence
from wpt_agents.zoo.report.folders import find_finished
from wpt_agents.zoo.result import Variant


def scores(points):
    """The points of a task, method and seed as (frames, score)."""
    found_points = {}
    for point in points:
        key = point.task, point.method, point.seed
        found_points.setdefault(key, []).append((point.at, point.score))
    return found_points


def test_a_part_of_a_last_step_does_not_stretch_the_frames(tmp_path):
    make_run(tmp_path, "dmc-walker-run", frames=1001)  # 500 steps of two frames
    points = record_curves.points_of(find_finished(tmp_path))
    assert [point.at for point in points] == [200, 600, 1000]


def test_points_are_means_in_percent_or_tenths_of_returns(tmp_path):
    # evaluations after 100, 300 and 500 steps of two frames, of 0, 1/2 and 1 times the returns
    make_run(tmp_path, "metaworld-reach", returns=(10.0, 20.0))
    make_run(tmp_path, "dmc-walker-run", returns=(200.0, 400.0))
    points = list(record_curves.points_of(find_finished(tmp_path)))
    assert scores(points) == {
        ("dmc-walker-run", "wpt", 0): [(200, 0), (600, 15), (1000, 30)],
        ("metaworld-reach", "wpt", 0): [(200, 0), (600, 50), (1000, 100)],  # above 5 is a success
    }
    assert {(point.frames, point.episodes, str(point.preset)) for point in points} == {
        (1000, 2, "debug")
    }


def test_curves_stay_when_run_folders_go_and_are_replaced_by_a_repeated_run(tmp_path):
    runs, path = tmp_path / "runs", tmp_path / "mid.csv"
    for seed in range(2):
        make_run(runs, "metaworld-reach", seed)
    record_page.add(path, find_finished(runs))
    both = record_curves.read(path)
    assert len(both) == 6 and (tmp_path / "curves" / "mid.png").stat().st_size > 1000
    shutil.rmtree(runs)
    folder = make_run(runs, "metaworld-reach", 1)
    arrays = {"timesteps": np.array([100]), "results": np.zeros((1, 2))}
    arrays |= {"ep_lengths": np.full((1, 2), 50), "successes": np.zeros((1, 2), bool)}
    np.savez(folder / "evaluations.npz", **arrays)
    record_page.add(path, find_finished(runs))
    assert scores(record_curves.read(path)) == {
        ("metaworld-reach", "wpt", 0): [(200, 0), (600, 50), (1000, 100)],
        ("metaworld-reach", "wpt", 1): [(200, 0)],
    }


def test_curves_are_of_the_unchanged_preset_and_the_usual_budget(tmp_path):
    make_run(tmp_path, "metaworld-reach")
    make_run(tmp_path, "metaworld-reach", 1, returns=(0.0, 20.0))
    make_run(tmp_path, "metaworld-reach", 2, frames=3000)
    make_run(tmp_path / "changed", "metaworld-push", preset="debug gamma=0.9")
    make_run(tmp_path, "metaworld-hammer", method="scratch")
    runs = find_finished(tmp_path)
    (one,) = evidence(record.lines_of(runs))
    curves = record_curves.curves_of(one, list(record_curves.points_of(runs)))
    assert curves == {
        "metaworld-hammer": {"scratch": {200: [0], 600: [50], 1000: [100]}},
        "metaworld-reach": {"wpt": {200: [0, 0], 600: [50, 50], 1000: [100, 50]}},
    }
    assert one.preset == Variant("debug") and one.frames == 1000


def test_a_panel_shows_the_mean_the_prior_actor_and_the_papers_score(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(record_curves.plt, "close", drawn.append)
    for seed, returns in enumerate([(10.0, 20.0), (0.0, 20.0)]):
        make_run(tmp_path, "metaworld-drawer-open", seed, returns=returns)
    record_page.add(tmp_path / "mid.csv", find_finished(tmp_path))
    (panel,) = drawn[-1].axes
    lines = {line.get_label(): list(line.get_ydata()) for line in panel.get_lines()}
    assert lines == {
        "wpt": [0, 50, 75],
        "prior actor": [0, 0],  # returns of 4 and 5 are no successes
        "the paper's WPT, 150,000 frames": [100, 100],
    }
    assert panel.get_title() == "drawer-open" and list(panel.get_lines()[0].get_xdata()) == [
        *(0.2, 0.6, 1.0)
    ]


@pytest.mark.parametrize("tasks", [["hammer"], ["hammer", "drawer-open"]])
def test_the_legend_of_few_panels_fits_into_the_picture(tasks, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(record_curves.plt, "close", drawn.append)
    for task in tasks:
        for method in ("wpt", "scratch"):
            make_run(tmp_path, f"metaworld-{task}", method=method)
    record_page.add(tmp_path / "mid.csv", find_finished(tmp_path))
    figure = drawn[-1]
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1


def test_negative_returns_of_hard_tasks_are_within_the_panel(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(record_curves.plt, "close", drawn.append)
    make_run(tmp_path, "dmc-walker-walk-hard", returns=(-140.0, -140.0))
    record_page.add(tmp_path / "mid.csv", find_finished(tmp_path))
    assert -24 < drawn[-1].axes[0].get_ylim()[0] < -14


def test_runs_without_evaluations_leave_no_file_and_damaged_curves_are_named(tmp_path):
    folder = make_run(tmp_path / "runs", "metaworld-reach")
    (folder / "evaluations.npz").unlink()
    path = tmp_path / "mid.csv"
    record_page.add(path, find_finished(tmp_path / "runs"))
    assert not (tmp_path / "curves").exists() and record_curves.read(path) == []
    (tmp_path / "curves").mkdir()
    (tmp_path / "curves" / "mid.csv").write_text("suite,task\na,b\n")
    with pytest.raises(ValueError, match=r"curves/mid.csv does not hold learning curves"):
        record_page.add(path, find_finished(tmp_path / "runs"))
    (tmp_path / "curves" / "mid.csv").write_bytes(b"suite\n\xff\n")
    with pytest.raises(ValueError, match=r"curves/mid.csv does not hold .*can't decode"):
        record_curves.read(path)


def test_the_picture_is_drawn_again_without_run_folders(tmp_path, monkeypatch):
    locked = []

    def lock(folder):
        locked.append(folder)
        return nullcontext()

    monkeypatch.setattr(record_page, "locked_folder", lock)
    make_run(tmp_path / "runs", "metaworld-reach")
    path = tmp_path / "mid.csv"
    record_page.add(path, find_finished(tmp_path / "runs"))
    picture = tmp_path / "curves" / "mid.png"
    picture.unlink()
    ran = CliRunner().invoke(app, ["report", str(tmp_path / "none"), "--record", str(path)])
    assert ran.exit_code == 0 and picture.exists()
    assert locked == [tmp_path, tmp_path]  # no other process writes meanwhile
