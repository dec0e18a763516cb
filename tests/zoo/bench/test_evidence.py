"""What the benches of exploration and retrieval count, by hand."""

import numpy as np
import pytest
from debug_agent import recorded

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.bench import exploration, retrieval

pytestmark = pytest.mark.slow  # it runs simulators or whole runs


def states(*places):
    """Walker states of (height, pitch, speed)."""
    rows = np.zeros((len(places), 24))
    for state, (height, pitch, speed) in zip(rows, places, strict=True):
        state[[0, 1, 14, 16]] = np.cos(pitch), np.sin(pitch), height, speed
    return rows


def test_coverage_counts_each_cell_once_and_what_lies_outside_at_the_edge():
    # cells are 0.1 m high, a 24th of a turn wide and 0.5 m/s fast
    assert exploration.coverage(states((0.55, 0.1, 0.1), (0.58, 0.2, 0.4))) == 1
    assert exploration.coverage(states((0.55, 0.1, 0.1), (0.62, 0.1, 0.1))) == 2
    assert exploration.coverage(states((0.55, 0.1, 0.1), (0.55, 0.3, 0.1))) == 2
    assert exploration.coverage(states((0.55, 0.1, 0.1), (0.55, 0.1, 0.6))) == 2
    assert exploration.coverage(states((9.0, 0.1, 99.0), (1.55, 0.1, 3.9))) == 1


@pytest.mark.parametrize("behaviour", ["random", "noise", "explore-state"])
def test_states_are_those_of_the_frames_that_are_counted(behaviour):
    one = exploration.explore(behaviour, 0, 1, steps=50)
    assert one.shape == (500, 24)  # of 2 frames each
    assert one[:, 14].min() > 0 and exploration.coverage(one) > 20
    assert not np.array_equal(one, exploration.explore(behaviour, 1, 1, steps=50))


def test_only_the_behaviours_that_are_asked_for_are_measured():
    (row,) = exploration.rows(quick=True, behaviours=["random"])
    assert row["behaviour"] == "random" and row["frames"] == 2000
    with pytest.raises(ValueError, match="explore-state"):
        next(exploration.rows(quick=True, behaviours=["explore-stat"]))


def test_shares_count_the_querys_own_kind_among_the_nearest(tmp_path):
    """Features are the red of the first pixel: walkers are at 0, 1, 2, a cheetah at 3."""
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        for red, robot in enumerate(["walker", "walker", "walker", "cheetah"]):
            image = recorded(2).image.copy()
            image[0, 0, 0, 0] = red
            task = f"wpt/dmc-{robot}-run-v0"
            dataset.append(
                Trajectory(image, np.zeros((2, 6), np.float32), embodiment=robot, task=task)
            )
    asked = np.zeros((2, 64, 64, 3), np.uint8)
    asked[1, 0, 0, 0] = 4
    queries = retrieval.Queries(asked, ["wpt/dmc-walker-run-v0", "wpt/dmc-cheetah-run-v0"])

    def embed(image):
        return image[:, 0, 0, :1].astype(np.float32)

    # of the two nearest, the walker's are both its own, the cheetah's one of them: 1 and 0.5
    assert retrieval.shares(dataset, embed, queries, 2)["own robot, DMControl"] == 0.75
    assert retrieval.shares(dataset, embed, queries, 2)["by chance"] == 0.5  # (3/4 + 1/4) / 2


def test_the_index_is_built_and_searched_at_the_size_asked_for():
    cost = retrieval.index_cost(300, 8)
    assert cost["features"] == "index of 300 x 8"
    assert 0 < cost["of which imports"] <= cost["peak MiB"]


def test_every_row_of_the_retrieval_bench_is_made(tmp_path, monkeypatch):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        for seed, task in enumerate(["wpt/dmc-walker-run-v0", "wpt/metaworld-soccer-v0"] * 2):
            robot = "walker" if "walker" in task else "sawyer"
            dataset.append(recorded(seed=seed, embodiment=robot, task=task))
    asked = np.stack([dataset[i].image[0] for i in range(2)])
    queries = retrieval.Queries(asked, dataset.tasks[:2])
    monkeypatch.setattr(retrieval, "collect", lambda *_: dataset)
    monkeypatch.setattr(retrieval, "fresh_queries", lambda *_: queries)
    monkeypatch.setattr(retrieval, "FOLDER", tmp_path)
    monkeypatch.setattr(retrieval, "MODEL", {**retrieval.MODEL, "size": "debug", "batch_length": 8})
    for name, value in {"STEPS": 1, "NEAREST": 1, "PAPER": (300, 8)}.items():
        monkeypatch.setattr(retrieval, name, value)
    made = list(retrieval.rows())
    assert [row["features"] for row in made] == [
        *("pre-trained, 1 updates", "untrained, seed 0", "untrained, seed 1", "untrained, seed 2"),
        *("raw pixels", "index of 300 x 8"),
    ]
    assert made[4]["own robot, DMControl"] == made[4]["own task, Meta-World"] == 1  # itself
