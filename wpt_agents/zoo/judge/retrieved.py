"""The share of retrieved trajectories that are of the right task."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.tasks import name_in_data


def own_task_shares(
    model: WPT,
    tasks: Sequence[Task],
    images: Sequence[int],
    number: int,
    env: Mapping[str, Any],
    seed: int = 0,
) -> Iterator[tuple[str, list[float]]]:
    """Yield each task's name and its share of the trajectories that Eq. (5) retrieves for it.

    :param model: a model with a dataset whose trajectories name their tasks
    :param images: numbers of first images to search for (`retrieval_images`); one share for each
    :param number: R, the number of trajectories to retrieve
    :param env: keyword arguments of `gymnasium.make`
    :param seed: seed of the first episode, which increases by 1 for each next one
    """
    assert model.dataset is not None
    of = np.array(model.dataset.tasks)
    index = model.build_index()
    for task in tasks:
        name = name_in_data(task, model.dataset.tasks)
        with closing(gym.make(task.id, **env)) as made:
            first = np.stack([made.reset(seed=seed + i)[0] for i in range(max(images))])
        features = model.policy.embed(first)
        nearest = (index.search(features[:count], number)[0] for count in images)
        yield task.name, [float((of[numbers] == (name or task.id)).mean()) for numbers in nearest]
