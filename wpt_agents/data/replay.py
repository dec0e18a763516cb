"""D_on and D_retrieval: trajectories in memory, and `mix`, experience rehearsal's batch of both.

Example::

    replay = ReplayBuffer()
    replay.add(trajectory)
    batch = replay.sample(16, 64, action_width=12, rng=np.random.default_rng(0))
"""

import os

import numpy as np

from wpt_agents.data.trajectory import Batch, Trajectory
from wpt_agents.data.windows import Piece, Row, Windows, make_batch
from wpt_agents.files.archive import load_arrays, save_arrays

NEWEST = 5  # episodes that `draw_recent` draws from
# what an episode's file holds as arrays; the labels below are in its JSON
ARRAYS = ("image", "action", "reward", "bounds")
LABELS = ("terminated", "action_dim", "embodiment", "task", "source")


class ReplayBuffer:
    """Episodes, and parts of long ones, in memory, without a capacity limit.

    :ivar trajectories: in the order of addition; change the list through `add` only
    """

    def __init__(self) -> None:
        self.trajectories: list[Trajectory] = []
        self._transitions = 0
        self._windows: Windows | None = None

    def add(self, trajectory: Trajectory) -> None:
        """Append one episode, without copying it.

        :param trajectory: an episode, or a part of a long one
        :raises ValueError: images of another size than those already here
        """
        size = trajectory.image.shape[1:]
        if self.trajectories and size != self.trajectories[0].image.shape[1:]:
            raise ValueError(
                f"The replay buffer holds images of {self.trajectories[0].image.shape[1:]}, "
                f"got {size}; resize them"
            )
        self.trajectories.append(trajectory)
        self._transitions += len(trajectory)
        self._windows = None

    def __len__(self) -> int:
        """The number of transitions (actions), not of episodes."""
        return self._transitions

    def sample(
        self,
        batch_size: int,
        length: int,
        action_width: int,
        rng: np.random.Generator,
        mark: bool = False,
    ) -> Batch:
        """Draw a batch by the rule of `wpt_agents.data.windows`.

        :param batch_size: B, number of sequences
        :param length: T, number of images in a sequence
        :param action_width: A, width to which actions are padded
        :param rng: source of the random numbers
        :param mark: return a `MarkedBatch`, which marks the pixels that move
        :return: (B, T) sequences
        :raises ValueError: an empty buffer, or a trajectory with more actions than `action_width`
        """
        rows = self.draw(batch_size, length, rng)
        return _batch_of(self.trajectories, rows, action_width, mark)

    def draw(self, batch_size: int, length: int, rng: np.random.Generator) -> list[Row]:
        """Draw the pieces that `sample` copies."""
        if not self.trajectories:
            raise ValueError("The replay buffer is empty; add a trajectory before sampling")
        if self._windows is None:
            self._windows = Windows(np.array([len(t) for t in self.trajectories]))
        return self._windows.draw(batch_size, length, rng)

    def draw_recent(self, batch_size: int, length: int, rng: np.random.Generator) -> list[Row]:
        """Draw pieces as `draw` does, from the five newest episodes alone."""
        lengths = np.array([len(t) for t in self.trajectories[-NEWEST:]])
        rows = Windows(lengths).draw(batch_size, length, rng)
        return _renumbered(rows, len(self.trajectories) - len(lengths))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file (arrays and JSON, no pickle) atomically.

        :param path: the file
        """
        episodes = [{k: getattr(t, k) for k in LABELS} for t in self.trajectories]
        arrays = {
            f"{i}/{name}": getattr(trajectory, name)
            for i, trajectory in enumerate(self.trajectories)
            for name in ARRAYS
            if getattr(trajectory, name) is not None
        }
        save_arrays(path, "ReplayBuffer", {"episodes": episodes}, arrays)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "ReplayBuffer":
        """Read a file of `save`.

        :param path: the file
        :raises ValueError: a file that is cut short, damaged, or not a replay buffer
        """
        head, arrays = load_arrays(path, "ReplayBuffer")
        replay = cls()
        for i, labels in enumerate(head["episodes"]):
            streams = {n: arrays[f"{i}/{n}"] for n in ARRAYS if f"{i}/{n}" in arrays}
            replay.add(Trajectory(**(labels | streams)))
        return replay


def mix(
    online: ReplayBuffer,
    retrieved: ReplayBuffer | None,
    ratio: float,
    batch_size: int,
    length: int,
    action_width: int,
    rng: np.random.Generator,
    recent_share: float = 0.0,
    mark: bool = False,
) -> Batch:
    """Draw a batch for experience rehearsal: rows of `online`, then of `retrieved`.

    The rewards of `retrieved` belong to other tasks or to none, so they are masked.

    :param online: the task's episodes
    :param retrieved: the retrieved trajectories, None for no rehearsal
    :param ratio: share of the rows that are of `retrieved`, in [0, 1]
    :param batch_size: B, number of sequences
    :param length: T, number of images in a sequence
    :param action_width: A, width to which actions are padded
    :param rng: source of the random numbers
    :param recent_share: share of the online rows that are drawn from the five newest episodes,
        which uniform replay has drawn least often
    :param mark: return a `MarkedBatch`, which marks the pixels that move
    :return: (B, T) sequences
    :raises ValueError: a ratio outside [0, 1]
    """
    if not 0 <= ratio <= 1:
        raise ValueError(f"The share of retrieved data must be in [0, 1], got {ratio}")
    n_retrieved = round(batch_size * ratio) if retrieved else 0
    n_online = batch_size - n_retrieved
    n_recent = round(n_online * recent_share)
    trajectories = online.trajectories
    rows: list[Row] = []
    if n_online > n_recent:
        rows += online.draw(n_online - n_recent, length, rng)
    if n_recent:
        rows += online.draw_recent(n_recent, length, rng)
    if retrieved and n_retrieved:
        drawn = retrieved.draw(n_retrieved, length, rng)
        rows += _renumbered(drawn, len(trajectories))
        trajectories = trajectories + retrieved.trajectories
    batch = _batch_of(trajectories, rows, action_width, mark)
    # The retrieved rows are last, as in the authors' batches of 12 + 4.
    batch.reward[n_online:] = 0
    batch.reward_known[n_online:] = False
    return batch


def _renumbered(rows: list[Row], offset: int) -> list[Row]:
    """Return the rows for a list of trajectories with `offset` others in front."""
    return [[(offset + i, start, stop) for i, start, stop in row] for row in rows]


def _batch_of(
    trajectories: list[Trajectory], rows: list[Row], width: int, mark: bool = False
) -> Batch:
    def read(piece: Piece) -> tuple[Trajectory, int, int]:
        i, start, stop = piece
        return trajectories[i], start, stop

    def background(i: int) -> np.ndarray:
        return trajectories[i].background

    shape = trajectories[0].image.shape[1:]
    return make_batch(rows, read, shape, width, background=background if mark else None)
