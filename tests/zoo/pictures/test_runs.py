"""The learning curve of a run."""

import numpy as np
import pytest
from matplotlib import pyplot as plt

from wpt_agents.zoo.pictures import runs
from wpt_agents.zoo.result import Score


@pytest.mark.parametrize(
    ("policies", "label"),
    [
        (["last"], "the agent at the end, 2"),
        (["last", "best"], "the best of the evaluated agents, 2"),
    ],
)
def test_the_point_at_the_end_names_its_policy(policies, label, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(plt, "close", shown.append)
    scores = dict.fromkeys(policies, Score((1.0, 2.0, 3.0)))
    runs.learning_curve(tmp_path / "a.png", "a run", np.arange(3), np.arange(3), scores)
    monkeypatch.undo()
    [figure] = shown
    assert label in figure.axes[0].get_legend_handles_labels()[1]
    plt.close(figure)


def test_the_names_of_lines_that_lie_close_together_do_not_overlap(tmp_path):
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.set_ylim(0, 1000)
    runs.name_lines(axes, {"prior actor": 900.0, "random": 9.0, "nothing": 0.0})
    figure.savefig(tmp_path / "a.png")
    boxes = {text.get_text(): text.get_window_extent() for text in axes.texts}
    plt.close(figure)
    assert boxes["nothing 0"].y1 <= boxes["random 9"].y0
    assert boxes["prior actor 900"].y0 == pytest.approx(axes.transData.transform((0, 900))[1])
