"""RL Zoo's own plotting scripts read our run folders, with the real package where it is there."""

import runpy
import sys

import numpy as np
import pytest
from run_folders import make_run

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

TASK = "metaworld-reach"


@pytest.fixture
def runs(tmp_path):
    for seed in (0, 1):
        make_run(tmp_path, TASK, seed, "wpt", (9.0 + seed, 1.0))
        make_run(tmp_path, TASK, seed, "scratch", (2.0, 4.0))
    return tmp_path / "debug"


@pytest.fixture
def script(monkeypatch):
    """Runs one of RL Zoo's scripts and returns the lines of its figure, by label."""
    pytest.importorskip("rl_zoo3", reason="the extra `rlzoo` is not installed")
    pytest.importorskip("seaborn", reason="the extra `rlzoo` is not installed")
    from matplotlib import pyplot as plt

    def call(name, *words):
        plt.close("all")
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        monkeypatch.setattr(plt, "show", lambda: None)
        with pytest.warns(RuntimeWarning, match="found in sys.modules"):  # its package imports it
            runpy.run_module(f"rl_zoo3.plots.{name}", run_name="__main__")
        return {line.get_label(): line.get_xydata() for line in plt.gca().get_lines()}

    yield call
    plt.close("all")


@pytest.mark.parametrize(("of", "means"), [("reward", [1.5, 2.5, 3.5]), ("success", [0, 0.5, 1])])
def test_plot_train_draws_returns_and_successes_of_each_seed(runs, script, of, means):
    words = ["-a", "wpt", "-e", TASK, "-f", runs, "-y", of, "-w", 2]
    lines = script("plot_train", *words)
    assert set(lines) == {f"{TASK}_0", f"{TASK}_1"}
    np.testing.assert_allclose(lines[f"{TASK}_0"], np.stack([[250, 375, 500], means], 1))


def test_all_plots_draws_the_evaluations_of_each_method(runs, script, capsys):
    words = ["-a", "wpt", "scratch", "-e", TASK, "-f", runs, "--no-million"]
    lines = script("all_plots", *words)
    # evaluations at 0, 1/2 and 1 of the last returns, whose mean is 5 and 5.5, or 3 and 3
    wpt = lines[f"WPT-{runs}"]
    np.testing.assert_allclose(wpt, [[100, 0], [300, 5.25 / 2], [500, 5.25]])
    np.testing.assert_allclose(lines[f"SCRATCH-{runs}"][-1], [500, 3])
    assert f"|{TASK}" in capsys.readouterr().out
