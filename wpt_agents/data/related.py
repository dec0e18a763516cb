"""The offline data that a baseline uses: trajectories of its own task, or else of its own robot."""

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
    """Return the numbers of the trajectories that bear the task's name, or else the robot's.

    The paper's baselines use "only task-related data". Exploration data of DMControl name no task,
    so there the robot decides. Trajectories of another action width are never used.

    :param most: if there are more, this many are drawn at random
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
