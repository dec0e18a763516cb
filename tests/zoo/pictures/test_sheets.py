"""A look at the data: the table's numbers, and that the pictures show what they say."""

import json

import gymnasium as gym
import numpy as np
import pytest
from debug_agent import agent, recorded
from dot_runs import DOT, dot  # noqa: F401  (dot registers the task for each test)
from PIL import Image
from toy_env import DotEnv
from wpt_envs.tasks import find
from zoo_command import call

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.judge.retrieved import own_task_shares
from wpt_agents.zoo.pictures import datasets, retrieval
from wpt_agents.zoo.vec_envs import make_vec_env


@pytest.fixture
def dataset(tmp_path):
    """Three dots and two arms, of which each embodiment has its colour."""
    with TrajectoryDataset.create(tmp_path / "data") as made:
        for seed in range(3):
            made.append(recorded(8 + seed, seed, embodiment="dot", task=f"push-{seed}"))
        for seed in range(2):
            image = np.full((6, 64, 64, 3), (200, 0, 10 * seed), np.uint8)
            action = np.zeros((5, 4), np.float32)
            made.append(Trajectory(image, action, np.zeros(5), embodiment="arm", task="reach"))
    return TrajectoryDataset.open(tmp_path / "data")


def test_the_table_counts_robot_by_robot_and_all(dataset):
    table = datasets.data_table(dataset)
    rows = {
        cells[0]: cells[1:]
        for cells in zip(*(list(column.cells) for column in table.columns), strict=True)
    }
    # tasks, trajectories, transitions, action width, length, with reward
    assert rows["dot"][:6] == ("3", "3", "27", "2", "8 to 10", "0")
    assert rows["arm"][:6] == ("1", "2", "10", "4", "5", "2")
    assert rows["all"][:6] == ("4", "5", "37", "2, 4", "5 to 10", "2")
    stored = sum(p.stat().st_size for p in dataset.path.glob("shard-*"))
    assert float(rows["all"][6]) == pytest.approx(stored / 2**20, abs=0.06)
    assert int(rows["all"][7]) == pytest.approx(stored / 42, abs=1)  # 37 + 5 images


def test_what_is_shown_is_of_every_kind_first(dataset):
    assert datasets.spread(dataset, 2) == [0, 3]
    assert datasets.spread(dataset, 4) == [0, 1, 2, 3]
    assert sorted(datasets.spread(dataset, 99)) == [0, 1, 2, 3, 4]
    only = dataset.subset([0, 3, 4])
    assert datasets.spread(only, 3) == [0, 1, 2]


@pytest.mark.slow
def test_data_show_prints_the_table_and_draws_the_images(dataset, tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "data", "show", dataset.path, "--out", tmp_path / "sheet.png") == 0
    printed = capsys.readouterr().out
    assert (
        "arm" in printed
        and "37" in printed
        and str(tmp_path / "sheet.png") in printed.replace("\n", "")
    )
    assert {(200, 0, 0), (200, 0, 10), (30, 30, 30)} <= colours(tmp_path / "sheet.png")


def colours(path):
    return set(map(tuple, np.array(Image.open(path).convert("RGB")).reshape(-1, 3).tolist()))


def test_a_folder_that_is_no_dataset_is_named(tmp_path, monkeypatch, capsys):
    assert call(monkeypatch, "data", "show", tmp_path / "nowhere") == 2
    assert "nowhere does not exist" in capsys.readouterr().err


def test_a_search_leaves_the_query_out_and_keeps_to_its_robot_if_told_to(dataset):
    model = agent(DotEnv(), dataset=dataset)
    query = retrieval.query_of(dataset, 3)
    near, distances = retrieval.search(model, query, 4, own_robot=False)[1:]
    assert near[0] == 4 and 3 not in near and sorted(near) == [0, 1, 2, 4]
    assert (np.diff(distances) >= 0).all()
    assert retrieval.search(model, query, 4, own_robot=True).indices.tolist() == [4]
    with pytest.raises(ValueError, match=r"No trajectory 5: .* holds 5, from 0 on"):
        retrieval.query_of(dataset, 5)


def test_a_task_is_searched_for_by_its_first_image():
    query = retrieval.query_at(find("metaworld", "reach"), {"rendering": "fast"})
    env = gym.make("wpt/metaworld-reach-v0", rendering="fast")
    np.testing.assert_array_equal(query.image, env.reset(seed=0)[0])
    assert (query.embodiment, query.action_dim) == ("sawyer", 4)


@pytest.mark.parametrize("images", [1, 3])
def test_the_sheet_of_a_run_shows_what_the_run_retrieves(dataset, images, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(retrieval, "retrieval_sheet", lambda _, __, rows: shown.extend(rows))
    venv = make_vec_env(DOT.id, {"rendering": "fast"}, 5)
    settings = {"retrieval_images": images, "num_retrieve": 3, "bc_steps": 1}
    model = agent(venv, dataset=dataset, embodiment="dot", seed=5, **settings)
    retrieval.sheet_of_run(tmp_path / "a.png", model, DOT, {"rendering": "fast"}, 5)
    model._last_obs = venv.reset()
    model._last_episode_starts = np.ones(1, bool)
    model.retrieve()
    retrieved, every = shown
    assert retrieved.indices.tolist() == model.progress.retrieved_ids
    assert len(every.indices) == 5 and (f"for {images}" in retrieved.query.name) == (images > 1)


def test_retrieve_show_draws_the_query_and_what_was_found(dataset, tmp_path, monkeypatch, capsys):
    agent(DotEnv()).save(tmp_path / "model.zip")
    # of a folder, as that of a run or of a pre-training, its model file is used
    words = [dataset.path, "--model", tmp_path, "--out", tmp_path / "new" / "found.png"]
    assert call(monkeypatch, "retrieve", "show", *words, "--query", 3, "--number", 1) == 0
    assert str(tmp_path / "new" / "found.png") in capsys.readouterr().out.replace("\n", "")
    shown = colours(tmp_path / "new" / "found.png")
    assert {(200, 0, 0), (200, 0, 10)} <= shown  # the query and its nearest
    assert (30, 30, 30) not in shown  # no dot
    assert call(monkeypatch, "retrieve", "show", *words) == 0
    assert (30, 30, 30) in colours(tmp_path / "new" / "found.png")


@pytest.mark.parametrize(
    ("label", "words", "rendering"),
    [
        (None, [], "near"),
        ({"env": {}}, [], "near"),
        ({"env": {"rendering": "fast"}}, [], "fast"),
        ({"env": {"rendering": "fast"}}, ["--rendering", "exact"], "exact"),
    ],
)
def test_a_task_is_rendered_as_the_data_were_by_default(
    dataset, label, words, rendering, tmp_path, monkeypatch
):
    agent(DotEnv()).save(tmp_path / "model.zip")
    if label is not None:
        (dataset.path / "collect.json").write_text(json.dumps(label))
    used = []
    query = retrieval.query_of(dataset, 3)
    monkeypatch.setattr(retrieval, "query_at", lambda _, env: used.append(env) or query)
    shares = "wpt_agents.zoo.judge.retrieved.own_task_shares"
    monkeypatch.setattr(shares, lambda *args: used.append(args[4]) or [])
    words = [dataset.path, "--model", tmp_path, "--task", "dot", *words]
    assert call(monkeypatch, "retrieve", "show", *words, "--out", tmp_path / "found.png") == 0
    assert call(monkeypatch, "retrieve", "share", *words, "--suite", "dmc") == 0
    assert used == [{"rendering": rendering}] * 2


def test_the_share_of_the_own_task_counts_what_the_index_finds(tmp_path, monkeypatch, capsys):
    env = gym.make("wpt/metaworld-reach-v0", rendering="fast")
    action = np.zeros((4, 4), np.float32)
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        for seed, task in ((0, "reach"), (1, "push"), (2, "reach")):
            image = env.reset(seed=seed)[0]
            name = f"wpt/metaworld-{task}-v0"
            dataset.append(Trajectory(np.stack([image] * 5), action, task=name))
    agent(DotEnv()).save(tmp_path / "model.zip")
    words = ["--model", tmp_path / "model.zip", "--task", "reach", "--rendering", "fast"]
    words += ["--images", 1, "--images", 2, "--number", 2, "--seed", 1]
    assert call(monkeypatch, "retrieve", "share", tmp_path / "data", *words) == 0
    # seeds 1 and 2 find the second and the third; seed 1 alone finds the second and another
    assert capsys.readouterr().out.split("\n")[1].split() == ["reach", "0.50", "0.50"]
    words += ["--number", 1, "--seed", 2]
    assert call(monkeypatch, "retrieve", "share", tmp_path / "data", *words) == 0
    assert capsys.readouterr().out.split("\n")[1].split() == ["reach", "1.00", "1.00"]


@pytest.mark.parametrize("name", ["wpt/dmc-dot-v0", "dmc-dot", "dot"])
def test_the_share_of_the_own_task_knows_its_names_in_other_data(name, tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as data:
        data.append(recorded(task=name))
    model = agent(DotEnv(), dataset=data)
    [(_, [share])] = own_task_shares(model, [DOT], [1], 1, {"rendering": "fast"})
    assert share == 1.0


def test_datasets_are_checked_and_joined_from_a_terminal(tmp_path, monkeypatch, capsys):
    for name in ("one", "two"):
        with TrajectoryDataset.create(tmp_path / name) as dataset:
            dataset.extend(recorded(seed=i, embodiment=name) for i in range(2))
    both = tmp_path / "both"
    assert not call(monkeypatch, "data", "merge", both, tmp_path / "one", tmp_path / "two")
    assert TrajectoryDataset.open(both).embodiments == ["one", "one", "two", "two"]
    assert not call(monkeypatch, "data", "validate", both)
    assert "4 trajectories read, 0 damaged" in capsys.readouterr().out
    shard = next(both.glob("shard-*.bin"))
    shard.write_bytes(shard.read_bytes()[:-50])  # the last trajectory's end
    assert call(monkeypatch, "data", "validate", both) == 1
    printed = capsys.readouterr().out
    assert "trajectory 3" in printed and "4 trajectories read, 1 damaged" in printed
    assert not call(monkeypatch, "data", "validate", both, "--set-aside")
    assert len(TrajectoryDataset.open(both)) == 3
