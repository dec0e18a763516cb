"""A picture of retrieval results: query images beside their nearest trajectories."""

import os
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.zoo.pictures.sheets import COLUMNS, cut, draw, finish, kind
from wpt_agents.zoo.pictures.style import AGENT, CLONE, INK, plt
from wpt_agents.zoo.vec_envs import make_vec_env


class Query(NamedTuple):
    """A first image to search for, with its label and robot."""

    name: str
    image: np.ndarray  # (64, 64, 3) uint8
    embodiment: str | None
    action_dim: int
    number: int | None = None  # its index, if it is from the dataset
    images: np.ndarray | None = None  # (n, 64, 64, 3), if several first images are searched for


class Found(NamedTuple):
    """A query and the trajectories with the most similar first images, nearest first."""

    query: Query
    indices: np.ndarray  # (k,)
    distances: np.ndarray  # (k,)


def query_of(dataset: TrajectoryDataset, i: int) -> Query:
    """Return the first image of trajectory `i` as a query."""
    if not 0 <= i < len(dataset):
        raise ValueError(f"No trajectory {i}: {dataset.path} holds {len(dataset)}, from 0 on")
    trajectory = dataset[i]
    name = f"#{i}\n{kind(trajectory.task, trajectory.embodiment)}"
    return Query(name, trajectory.image[0], trajectory.embodiment, trajectory.action_dim, i)


def query_at(task: Task, env: Mapping[str, Any], seed: int = 0) -> Query:
    """Return the first image of a task as a query, as in fine-tuning with this seed.

    :param env: keyword arguments of `gymnasium.make`
    """
    with closing(gym.make(task.id, **env)) as made:
        image, _ = made.reset(seed=seed)
    return Query(f"first image of\n{cut(task.name, 18)}", image, task.embodiment, task.action_dim)


def first_images(task: Task, env: Mapping[str, Any], seed: int, number: int) -> np.ndarray:
    """Return the first images of a task's first episodes, (number, 64, 64, 3).

    :param seed: of the environment, as in fine-tuning
    """
    with closing(make_vec_env(task.id, env, seed)) as made:
        return np.concatenate([np.asarray(made.reset()) for _ in range(number)])


def search(model: WPT, query: Query, number: int, own_robot: bool) -> Found:
    """Return the nearest by Eq. (5), without the query's own trajectory.

    :param own_robot: only those that `WPT.learn` would retrieve, by robot and action width
    """
    assert model.dataset is not None
    robot = query.embodiment if query.embodiment in model.dataset.embodiments else None
    known = (robot, query.action_dim) if own_robot else (None, None)
    feature = model.policy.embed(query.image[None] if query.images is None else query.images)
    indices, distances = model.build_index().search(feature, number + 1, *known)
    others = indices != (-1 if query.number is None else query.number)
    return Found(query, indices[others][:number], distances[others][:number])


def retrieval_sheet(
    path: str | os.PathLike[str], dataset: TrajectoryDataset, results: Sequence[Found]
) -> None:
    """Draw each query beside the first images of its nearest; blue frames mark its own robot."""
    columns = max(len(result.indices) for result in results) + 1
    figure, axes = plt.subplots(
        len(results), columns, figsize=(columns * 1.25, len(results) * 1.62 + 0.5), squeeze=False
    )
    for row, (query, indices, distances) in zip(axes, results, strict=True):
        draw(row[0], query.image, INK, 2.5)
        row[0].set_title(query.name, fontsize=7, color=INK, fontweight="bold", pad=3)
        for axis in row[1 + len(indices) :]:
            axis.axis("off")
        for axis, i, distance in zip(row[1:], indices, distances, strict=False):
            robot, task = dataset.embodiments[i], dataset.tasks[i]
            same = query.embodiment is not None and robot == query.embodiment
            first = next(dataset.subset([i]).first_observations())[0]
            draw(axis, first, AGENT if same else CLONE, 2)
            axis.set_title(
                f"#{i}  d {distance:.3g}\n{kind(task, robot)}", fontsize=6.5, color=INK, pad=3
            )
    robots = "blue: the query's own robot, orange: another"
    finish(figure, path, f"First images and the nearest in {dataset.path.name} ({robots})")


def sheet_of_run(path: Path, model: WPT, task: Task, env: Mapping[str, Any], seed: int) -> None:
    """Draw the trajectories that a run retrieves, and below them the nearest of all robots.

    With `retrieval_images`, the first row shows those that are nearest to one of these images.
    """
    assert model.dataset is not None
    name = cut(task.name, 18)
    query = query_at(task, env, seed)
    one = query._replace(name=f"retrieved for\n{name}")
    if (number := model.retrieval_images) > 1:
        images = first_images(task, env, seed, number)
        one = one._replace(name=f"retrieved for {number}\nimages of {name}", images=images)
    every = query._replace(name=f"nearest of all\n{name}")
    results = [search(model, one, COLUMNS, True), search(model, every, COLUMNS, False)]
    retrieval_sheet(path, model.dataset, results)
