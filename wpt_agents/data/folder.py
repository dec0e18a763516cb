"""A folder of trajectories for a reader: whole trajectories, or the blocks of a part."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from wpt_agents.data.index import Entry, Meta
from wpt_agents.data.shards import BLOCK, read_steps
from wpt_agents.data.trajectory import Trajectory


class Part(Trajectory):
    """Some steps of a trajectory, which are not checked again."""

    def __post_init__(self) -> None:
        pass


class Folder(NamedTuple):
    """Where trajectories are stored and how."""

    path: Path
    meta: Meta

    def is_there(self) -> bool:
        """Whether the folder can be reached; one on a disk that is not mounted cannot."""
        return (self.path / "meta.json").is_file()

    def read(self, entry: Entry, start: int, stop: int) -> tuple[Trajectory, int, int]:
        """Read the blocks that hold images `start` .. `stop - 1`.

        :return: the blocks as a trajectory, and the positions of `start` and `stop` in it
        :raises OSError: a block cannot be read or is damaged
        """
        # The action and reward that led to image `start` are stored with the image before it.
        first, last = max(start - 1, 0) // BLOCK, (stop - 1) // BLOCK
        image, action, reward = read_steps(self.path, self.meta, entry, first, last)
        at_end = stop == entry.length + 1
        start, stop = start - first * BLOCK, stop - first * BLOCK
        part = Part(
            image=image[:stop],
            action=action[: stop - 1],
            reward=None if reward is None else reward[: stop - 1],
            terminated=entry.terminated and at_end,
            action_dim=entry.action_dim,
            embodiment=entry.embodiment,
            task=entry.task,
            source=entry.source,
            bounds=None if entry.bounds is None else np.array(entry.bounds),
        )
        return part, start, stop
