"""SB3's files of evaluations and training episodes; only this module depends on their columns.

`evaluations.npz` is written by SB3's EvalCallback, `0.monitor.csv` by its Monitor.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from wpt_agents.files.archive import FAULTS

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
        """Read the file; return None if it does not exist.

        :raises ValueError: if the file is damaged
        """
        if not path.exists():
            return None
        try:
            # NumPy's default is allow_pickle=False; it leaves a damaged file open that it opened.
            with open(path, "rb") as file, np.load(file) as arrays:
                successes = arrays["successes"] if "successes" in arrays else None
                return cls(arrays["timesteps"], arrays["results"], arrays["ep_lengths"], successes)
        except FAULTS as error:
            raise damaged(path, error) from None


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
        """Read the file, which may not exist yet; an incomplete last line is ignored.

        :raises ValueError: if the file is damaged
        """
        rows = []
        try:
            text = path.read_text(encoding="utf-8") if path.exists() else ""
            for line in text.splitlines(keepends=True)[2:]:
                cells = line.split(",")
                if line.endswith("\n") and len(cells) >= 3 and cells[0] != "r":
                    rows.append([float(cell) for cell in cells[:3]])
        except ValueError as error:
            raise damaged(path, error) from None
        returns, lengths, times = np.array(rows).reshape(-1, 3).T
        return cls(lengths, returns, times)

    def __len__(self) -> int:
        return len(self.lengths)


def damaged(path: Path, error: Exception) -> ValueError:
    """Return the error for a damaged file that a run's scores do not depend on."""
    return ValueError(
        f"{path} is damaged ({error!r}); restore it from a copy, or delete it to go on without it"
    )
