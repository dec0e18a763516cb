"""What the live view says of a run is what its folder says."""

import json

import numpy as np
import pytest
from dot_runs import dot, job  # noqa: F401  (dot registers the task for each test)
from rich.console import Console
from stable_baselines3.common.results_plotter import load_results, plot_results, ts2xy
from zoo_command import call

from wpt_agents.zoo.locks import locked
from wpt_agents.zoo.run.runner import run
from wpt_agents.zoo.run.watch import clock, overview, speed, standing

HEAD = '#{"t_start": 1.0}\nr,l,t\n'


@pytest.fixture
def one(tmp_path):
    """A run of 75 steps that has been begun, and no more."""
    one = job(tmp_path)
    one.folder.mkdir(parents=True)
    (one.folder / "config.yaml").write_text("")
    return one


def test_a_run_goes_from_waiting_to_finished(tmp_path, one):
    assert standing(job(tmp_path, seed=9)).state == "waiting"
    assert standing(one).state == "stopped"
    with locked(one.folder / "lock"):
        assert standing(one).state == "preparing"
        (one.folder / "0.monitor.csv").write_text(HEAD + "3.0,25,10.0\n5.0,25,20.0\n")
        now = standing(one)
        assert (now.state, now.steps, now.mean_return, now.speed) == ("learning", 50, 4.0, 2.5)
        (one.folder / "0.monitor.csv").write_text(HEAD + "3.0,75,10.0\n")
        assert standing(one).state == "evaluating"
    assert standing(one).state == "stopped"
    (one.folder / "error.txt").write_text("RuntimeError")
    assert standing(one).state == "failed"
    (one.folder / "result.json").write_text("{}")
    assert standing(one).state == "finished"


def test_speed_counts_since_the_process_began_again():
    lengths = np.full(4, 100.0)
    assert speed(lengths, np.array([10, 20, 30, 40])) == 10
    assert speed(lengths, np.array([90, 100, 4, 8])) == 25  # resumed: the clock restarted
    assert speed(lengths[:1], np.array([10])) is None


def test_each_run_has_a_line_with_progress_return_speed_and_time_left(one, capsys):
    (one.folder / "0.monitor.csv").write_text(HEAD + "3.0,25,10.0\n5.0,25,20.0\n")
    with locked(one.folder / "lock"):
        Console(width=140).print(overview([one]))
    line = next(line for line in capsys.readouterr().out.splitlines() if "dmc-dot" in line)
    cells = [cell.strip() for cell in line.strip("│ ").split("│")]
    assert cells == ["dmc-dot", "wpt", "0", "learning", "50", "67%", "4.0", "2.5", "0:00:10"]


@pytest.mark.parametrize(("seconds", "text"), [(3, "0:00:03"), (3723, "1:02:03"), (-1, "0:00:00")])
def test_the_clock_shows_hours(seconds, text):
    assert clock(seconds) == text


def test_watching_ends_when_all_is_over_and_does_nothing_itself(tmp_path, monkeypatch, capsys):
    words = ["--tasks", "dot", "--method", "scratch", "--preset", "debug"]
    words += ["--out", tmp_path, "--watch"]
    folder = tmp_path / "debug" / "scratch" / "dmc-dot_0"
    folder.mkdir(parents=True)
    (folder / "error.txt").write_text("RuntimeError")
    assert call(monkeypatch, "run", *words) == 0
    assert "failed" in capsys.readouterr().out
    assert [path.name for path in folder.iterdir()] == ["error.txt"]


@pytest.mark.slow
def test_sb3s_plots_and_rl_zoos_layout_read_a_run(tmp_path):
    pytest.importorskip("pandas", reason="SB3's results_plotter needs pandas (the extra `dev`)")
    import matplotlib.pyplot as plt

    one = job(tmp_path, evaluate={"every": 25, "during_episodes": 2})
    run(one)
    steps, returns = ts2xy(load_results(str(one.folder)), "timesteps")
    assert steps.tolist() == [25, 50, 75] and np.isfinite(returns).all()
    plot_results([str(one.folder)], None, "timesteps", "dot")
    plt.close("all")
    # all_plots reads <log>/<algo>/<env>_<n>/evaluations.npz and these keys
    assert one.folder.parent.name == "wpt" and one.folder.name == "dmc-dot_0"
    with np.load(one.folder / "evaluations.npz") as arrays:
        assert arrays["timesteps"].tolist() == [25, 50, 75]
        assert arrays["results"].shape == arrays["ep_lengths"].shape == (3, 2)
    assert json.loads((one.folder / "result.json").read_text())["steps"] == 75
