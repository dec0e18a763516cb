"""The strips of predictions say in whole words what their rows and columns are."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from wpt_agents.zoo.pictures import predictions, runs

IMAGES = np.zeros((45, 64, 64, 3), np.uint8)


@pytest.fixture
def drawn(monkeypatch):
    """The figures that are closed during the test; they are closed after it."""
    figures = []
    with monkeypatch.context() as patched:
        patched.setattr(plt, "close", figures.append)
        yield figures
    for figure in figures:
        plt.close(figure)


def test_the_columns_of_strips_are_steps_ahead_and_the_rows_are_explained(drawn, tmp_path):
    rows = {"true": IMAGES[:3], "world model": IMAGES[:3]}
    predictions.draw_strips(tmp_path / "a.png", [predictions.Strip("arm", rows, (0, 1, 40))])
    (figure,) = drawn
    columns = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert columns == ["last\nseen", "1 step\nahead", "40 steps\nahead"]
    assert "what happened" in figure.get_suptitle() and "one action" in figure.get_suptitle()


def test_the_strip_of_a_run_says_the_same(drawn, tmp_path):
    runs.prediction_strip(tmp_path / "a.png", "arm, wpt, seed 0", IMAGES, IMAGES, 5)
    (figure,) = drawn
    upper = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert upper[:3] == ["first\nseen", "last\nseen", "1 step\nahead"]
    assert upper[-1] == "40 steps\nahead" and len(upper) == 12
    assert figure.get_suptitle().startswith("arm, wpt, seed 0\nabove: what happened")


def test_the_mean_of_samples_looks_unlike_a_single_prediction(drawn, tmp_path):
    names = ("world model", "world model, mean of 8", "other", "other, mean of 8", "mean frame")
    errors = np.ones((3, 41))
    curves = [predictions.Curve("arm", name, *errors) for name in names]
    predictions.draw_curves(tmp_path / "a.png", curves)
    (figure,) = drawn
    lines = figure.axes[0].get_lines()
    assert [line.get_label() for line in lines] == list(names)
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == len(names)
