"""The offline data of a baseline: trajectories of its task, or else of its robot."""

import numpy as np

from wpt_agents.data.dataset import TrajectoryDataset


def related_trajectories(
    dataset: TrajectoryDataset,
    task: str | None,
    embodiment: str | None,
    action_dim: int,
    most: int,
    rng: np.random.Generator,
) -> list[int]:
    """Return the numbers of the trajectories of the task or, if there are none, of the robot.

    The paper's baselines use "only task-related data". Exploration data of DMControl name no task,
    so there the robot decides. Trajectories of another action width are never used.

    :param task: the name of the task, or None
    :param embodiment: the name of the robot, or None
    :param action_dim: the width of the actions
    :param most: the largest number of trajectories; if there are more, they are drawn at random
    :raises ValueError: the dataset holds neither; the message lists what it holds
    """
    own_width = [width == action_dim for width in dataset.action_dims]
    for name, names in ((task, dataset.tasks), (embodiment, dataset.embodiments)):
        matching = [
            i for i, n in enumerate(names) if name is not None and n == name and own_width[i]
        ]
        if matching:
            chosen = matching
            if len(matching) > most:
                chosen = rng.choice(matching, most, replace=False).tolist()
            return sorted(int(i) for i in chosen)
    tasks, robots = (
        ", ".join(sorted({n for n in names if n})) or "none"
        for names in (dataset.tasks, dataset.embodiments)
    )
    raise ValueError(
        f"The dataset {dataset.path} has no trajectory of the task {task!r} or the robot "
        f"{embodiment!r} with {action_dim} actions. Its tasks: {tasks}; its robots: {robots}. "
        "Pass task= or embodiment=, or another dataset="
    )
