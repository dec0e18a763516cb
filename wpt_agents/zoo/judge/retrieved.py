"""How many of the retrieved trajectories are of the task."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
from wpt_envs.tasks import Task

from wpt_agents.agents.wpt import WPT


def own_task_shares(
    model: WPT,
    tasks: Sequence[Task],
    images: Sequence[int],
    number: int,
    env: Mapping[str, Any],
    seed: int = 0,
) -> Iterator[tuple[str, list[float]]]:
    """Yield each task's name and the share of what Eq. (5) retrieves for it that is of this task.

    :param model: has a dataset whose trajectories name their tasks
    :param images: numbers of first images to search for (`retrieval_images`); one share for each
    :param number: R, the trajectories that are retrieved
    :param env: keyword arguments of `gymnasium.make`
    :param seed: of the first episode; each of the next ones has a seed larger by 1
    """
    assert model.dataset is not None
    of = np.array(model.dataset.tasks)
    index = model.build_index()
    for task in tasks:
        with closing(gym.make(task.id, **env)) as made:
            first = np.stack([made.reset(seed=seed + i)[0] for i in range(max(images))])
        features = model.policy.embed(first)
        nearest = (index.search(features[:count], number)[0] for count in images)
        yield task.name, [float((of[numbers] == task.id).mean()) for numbers in nearest]
