"""// Experience Retrieval of Algorithm 1: trajectories that begin most like the task, Eq. (5)."""

import warnings

import numpy as np

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.retrieval import Retriever
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.randomness import Purpose, Streams


def retrieve_ids(
    retriever: Retriever,
    dataset: TrajectoryDataset,
    query: np.ndarray,
    width: int,
    settings: Hyperparameters,
    streams: Streams,
) -> list[int]:
    """Return the numbers of the R trajectories that begin most like the task.

    Only trajectories with as many actions as the task are found, and if the dataset names the
    task's robot, only those of this robot or of none.

    :param query: (E,), e(o) of the task's first image
    :param width: the number of actions
    :raises ValueError: no trajectory has that many actions
    """
    names = set(dataset.embodiments)
    known = settings.embodiment if settings.embodiment in names else None
    if settings.embodiment is not None and known is None and names != {None}:
        others = ", ".join(sorted(name for name in names if name))
        warnings.warn(
            f"The dataset has no robot of the name {settings.embodiment!r} (it has {others}): "
            f"trajectories of any robot of {width} actions are retrieved, rehearsed and cloned",
            stacklevel=4,
        )
    if settings.retrieval == "random":
        rng = streams.numpy(Purpose.RETRIEVE, 0)
        numbers = retriever.draw(settings.num_retrieve, rng, known, width)
    else:
        numbers, _ = retriever.search(query, settings.num_retrieve, known, width)
    if len(numbers) == 0:
        raise ValueError(
            f"The dataset {dataset.path} has no trajectory of {width} actions to retrieve; add "
            "some, or learn with offline_ratio=0, guidance=0, kickstart=0"
        )
    return [int(i) for i in numbers]
