"""Flat HDF5 files in D4RL's manner: transitions in a row, episodes end at terminals or timeouts.

Action t was taken at observation t. The observation after an episode's last action is there only
if the file has `next_observations`; without it that action is left out, and no terminal state is
seen.
"""

import os
from itertools import pairwise
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, both_limits, needs, rescaled, warn_left_out
from wpt_agents.data.trajectory import Trajectory


class Hdf5Episodes(Episodes):
    """The episodes of one file; one of a single image is left out.

    :param image_key: the images' array; the next ones are at `next_` + it
    :param low: (A,) the actions' limits, if they are not in [-1, 1]
    :param high: (A,)
    """

    def __init__(
        self,
        file: str | os.PathLike[str],
        image_key: str = "observations",
        low: np.ndarray | None = None,
        high: np.ndarray | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._limits = both_limits(low, high)
        h5py = needs("h5py", "HDF5 files")
        try:
            self._file = h5py.File(file, "r")
        except FileNotFoundError:
            raise ValueError(f"{file} does not exist; name an HDF5 file") from None
        except OSError as error:
            raise ValueError(f"{file} is damaged or not an HDF5 file: {error}") from error
        self._name, self._key = os.fspath(file), image_key
        missing = {image_key, "actions"} - set(self._file)
        if missing or not {"terminals", "timeouts"} & set(self._file):
            raise ValueError(
                f"{file} needs {image_key!r}, 'actions' and 'terminals' or 'timeouts'; there are: "
                f"{', '.join(self._file)}"
            )
        self._next = f"next_{image_key}" in self._file
        self._bounds = self._find_bounds()

    def _find_bounds(self) -> list[tuple[int, int]]:
        """The first row of each episode and one past its last."""
        rows = len(self._file["actions"])
        flags = [self._file[k][:] for k in ("terminals", "timeouts") if k in self._file]
        ends = np.flatnonzero(np.logical_or.reduce([np.ravel(f) for f in flags])) + 1
        edges = np.unique(np.concatenate([[0], ends, [rows]])).tolist()
        shortest = 1 if self._next else 2
        bounds = [(start, stop) for start, stop in pairwise(edges) if stop - start >= shortest]
        warn_left_out(len(edges) - 1 - len(bounds), self._name)
        return bounds

    def __len__(self) -> int:
        return len(self._bounds)

    def __getitem__(self, i: int) -> Trajectory:
        start, stop = self._bounds[i]
        image, action = self._file[self._key][start:stop], self._file["actions"][start:stop]
        reward = self._file["rewards"][start:stop] if "rewards" in self._file else None
        terminated = False
        if self._next:
            image = np.concatenate([image, self._file[f"next_{self._key}"][stop - 1 : stop]])
            terminated = "terminals" in self._file and bool(self._file["terminals"][stop - 1])
        else:
            action, reward = action[:-1], None if reward is None else reward[:-1]
        if self._limits:
            action = rescaled(action, *self._limits)
        source = f"{os.path.basename(self._name)} rows {start} to {stop - 1}"
        return self._trajectory(image, action, reward, source, terminated=terminated)
