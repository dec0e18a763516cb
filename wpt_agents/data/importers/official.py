"""The data that the paper's authors publish: `ncrl_datasets/<suite>/<domain or task>/*.npz`.

Files are those of `NpzEpisodes`, one per episode, named `{time}-{id}-{number}-{length}.npz`. The
folders are the labels: DMControl's are robots, Meta-World's are tasks of one robot.
"""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.npz import NpzEpisodes
from wpt_agents.files.folders import files_below

DMC, METAWORLD = SUITES = ("dmcontrol", "metaworld")
NAME = re.compile(r"[^-]+-[^-]+-\d+-(\d+)\.npz")  # time, id, number and length


class OfficialEpisodes(NpzEpisodes):
    """The authors' episodes, in the order of their paths.

    Actions beyond [-1, 1] are clipped, as the simulators did when the episodes were recorded.

    :param folder: `ncrl_datasets`, or one of the folders in it
    :raises ValueError: if the folder is neither inside `dmcontrol` or `metaworld` nor contains them
    """

    def __init__(self, folder: str | os.PathLike[str], **options: Any) -> None:
        if not is_official(folder):
            raise ValueError(
                f"{folder} is not the authors' data: its path has neither {DMC!r} nor "
                f"{METAWORLD!r}, whose folders name the robots and tasks; import it as npz"
            )
        super().__init__(folder, shifted=True, **options)

    def _kind(self, file: Path) -> str:
        named = NAME.fullmatch(file.name)  # avoids opening tens of thousands of files
        if named is None:
            return super()._kind(file)
        return "episode" if int(named[1]) > 0 else "single"

    def _actions(self, arrays: dict[str, np.ndarray], taken: slice) -> np.ndarray:
        actions = super()._actions(arrays, taken)
        # NaN and infinity stay, and are refused
        return np.where(np.isfinite(actions), actions.clip(-1, 1), actions)

    def _limits_of(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        ones = np.ones(action.shape[1])
        return super()._limits_of(action) or (-ones, ones)

    def _labels(self, file: Path) -> dict[str, Any]:
        suite, *folders = _below_suite(file.parent)
        name = folders[0] if folders else None
        labels = {"embodiment": name} if suite == DMC else {"embodiment": "sawyer", "task": name}
        return {k: v for k, v in labels.items() if v is not None and getattr(self, k) is None}


def is_official(folder: str | os.PathLike[str]) -> bool:
    """Return whether a folder is one of the authors' suites, contains one, or is inside one."""
    path = Path(folder)
    inside = any((path / suite).is_dir() for suite in SUITES)
    return inside or bool(_below_suite(path))


def holds_official(folder: Path) -> bool:
    """Return whether such a folder holds files that are named as the authors'."""
    return is_official(folder) and any(NAME.fullmatch(f.name) for f in files_below(folder, "*.npz"))


def _below_suite(folder: Path) -> list[str]:
    """Return the parts of the path of `folder`, from the last one that names a suite."""
    parts = Path(os.path.abspath(folder)).parts
    suites = [i for i, part in enumerate(parts) if part in SUITES]
    return list(parts[suites[-1] :]) if suites else []
