"""SB3's files of evaluations and training episodes; only this module depends on their columns.

`evaluations.npz` is written by SB3's EvalCallback, `0.monitor.csv` by its Monitor.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

EVALUATIONS = "evaluations.npz"
MONITOR = "0.monitor.csv"


@dataclass(frozen=True)
class Evaluations:
    """The evaluations during fine-tuning.

    :param steps: (N,), calls of `env.step` before each evaluation
    :param returns: (N, episodes)
    :param lengths: (N, episodes), calls of `env.step`
    :param successes: (N, episodes), None if the task reports none
    """

    steps: np.ndarray
    returns: np.ndarray
    lengths: np.ndarray
    successes: np.ndarray | None

    @classmethod
    def read(cls, path: Path) -> Self | None:
        """Read the file; return None if it does not exist."""
        if not path.exists():
            return None
        with np.load(path) as arrays:  # NumPy's default allow_pickle=False
            successes = arrays["successes"] if "successes" in arrays else None
            return cls(arrays["timesteps"], arrays["results"], arrays["ep_lengths"], successes)


@dataclass(frozen=True)
class TrainingEpisodes:
    """The episodes of fine-tuning, in the order of their ends.

    :param lengths: (N,), calls of `env.step`
    :param returns: (N,)
    :param times: (N,), seconds since the process began at which each episode ended
    """

    lengths: np.ndarray
    returns: np.ndarray
    times: np.ndarray

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the file, which may not exist yet; an incomplete last line is ignored."""
        rows = []
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines(keepends=True)[2:]:
                cells = line.split(",")
                if line.endswith("\n") and len(cells) >= 3 and cells[0] != "r":
                    rows.append([float(cell) for cell in cells[:3]])
        returns, lengths, times = np.array(rows).reshape(-1, 3).T
        return cls(lengths, returns, times)

    def __len__(self) -> int:
        return len(self.lengths)
