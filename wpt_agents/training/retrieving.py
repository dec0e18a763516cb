"""Experience retrieval (Algorithm 1): trajectories with first images like the task's, Eq. (5)."""

import warnings
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from gymnasium import spaces

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.retrieval import Retriever
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.units import in_units_of
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.randomness import Purpose, Streams

CHUNK = 256  # images that are embedded at once


def retrieve_ids(
    retriever: Retriever,
    dataset: TrajectoryDataset,
    query: np.ndarray,
    width: int,
    settings: Hyperparameters,
    streams: Streams,
) -> list[int]:
    """Return the numbers of the R trajectories whose first images are most like the task's.

    Only trajectories whose actions have the task's width are retrieved and, if the dataset names
    the task's robot, only those of this robot or without a name.

    :param query: (Q, E), e(o) of the first images of Q episodes of the task
    :param width: the width of the task's actions
    :raises ValueError: no trajectory can be retrieved
    """
    names = set(dataset.embodiments)
    # The authors filter by action width alone, which mixes robots: cheetah and walker both have 6.
    known = settings.embodiment if settings.embodiment in names else None
    if settings.embodiment is not None and known is None and names != {None}:
        others = ", ".join(sorted(name for name in names if name))
        warnings.warn(
            f"The dataset has no robot named {settings.embodiment!r} (it has {others}): "
            f"trajectories of any robot with {width} actions are retrieved, rehearsed and cloned",
            stacklevel=5,
        )
    number = settings.value("num_retrieve")
    if settings.retrieval == "random":
        rng = streams.numpy(Purpose.RETRIEVE, 0)
        numbers = retriever.draw(number, rng, known, width)
    else:
        numbers, _ = retriever.search(query, number, known, width)
    if len(numbers) == 0:
        whose = "" if known is None else f" of the robot {known!r}, or of none,"
        raise ValueError(
            f"The dataset {dataset.path} has no trajectory of {width} actions{whose} to retrieve; "
            f"add some{', set another embodiment' * bool(whose)}, or learn with offline_ratio=0, "
            "guidance=0, kickstart=0, adapt_steps=0, without ibrl and residual"
        )
    return [int(i) for i in numbers]


def with_kept(
    index: Retriever, kept: Sequence[Trajectory], embed: Callable[[np.ndarray], np.ndarray]
) -> Retriever:
    """Return an index of its dataset's trajectories, followed by those in memory.

    :param index: the index of the dataset
    :param kept: the trajectories in memory, at least one
    :param embed: (n, 64, 64, 3) uint8 -> (n, E) float32, with the encoder of the index
    """
    first = [trajectory.image[0] for trajectory in kept]
    parts = [embed(np.stack(first[at : at + CHUNK])) for at in range(0, len(first), CHUNK)]
    return Retriever(
        np.concatenate([index.features, *parts]),
        np.concatenate([index.action_dims, [trajectory.action_dim for trajectory in kept]]),
        [*index.embodiments, *(trajectory.embodiment for trajectory in kept)],
        index.encoder_id,
        index.dataset_id,
    )


def read_retrieved(
    dataset: TrajectoryDataset,
    kept: Sequence[Trajectory],
    numbers: Sequence[int],
    box: spaces.Box,
) -> Iterator[Trajectory]:
    """Yield retrieved trajectories by the numbers that the index of `with_kept` gives them.

    :param box: the task's action space, to whose units the actions of the dataset are converted
    :raises ValueError: a retrieved trajectory in memory is missing
    """
    stored = len(dataset)
    if max(numbers, default=0) >= stored + len(kept):
        raise ValueError(
            f"Episodes of earlier tasks were retrieved, but model.kept holds {len(kept)}: set it "
            "to a ReplayBuffer with all of them, or call reset_task()"
        )
    chosen = dataset.subset([number for number in numbers if number < stored])
    yield from in_units_of(chosen, box)
    yield from (kept[number - stored] for number in numbers if number >= stored)
