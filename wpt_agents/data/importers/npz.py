"""One compressed `.npz` an episode: ExORL, URLB, DrQ-v2, the official NCRL data, Dreamer, V-D4RL.

Arrays are T + 1 long, and action t is the one that *led to* observation t: the first is a
placeholder, as is the first reward. So action t of ours is their action t + 1.
"""

import os
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, both_limits, rescaled, warn_left_out
from wpt_agents.data.trajectory import Trajectory

IMAGE_KEYS = ("observation", "image", "pixels")
OTHERS = ("action", "reward", "discount", "is_terminal", "is_first")


class NpzEpisodes(Episodes):
    """The `.npz` files of a folder and the folders in it, by name.

    :param folder: searched for episodes
    :param image_key: the images' array; else the first found of observation, image, pixels
    :param low: (A,) the actions' limits, if they are not in [-1, 1]
    :param high: (A,)
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        image_key: str | None = None,
        low: np.ndarray | None = None,
        high: np.ndarray | None = None,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._limits = both_limits(low, high)
        self._folder, self._keys = Path(folder), (image_key,) if image_key else IMAGE_KEYS
        files = sorted(self._folder.rglob("*.npz"))
        if not files:
            raise ValueError(f"{folder} holds no .npz file")
        self._files = [file for file in files if not self._is_single(file)]
        warn_left_out(len(files) - len(self._files), folder)

    def _is_single(self, file: Path) -> bool:
        """Whether an episode has one image; what is damaged or strange is named when it is read."""
        try:
            if len(_arrays(file, {"action"}).get("action", ())) != 1:
                return False
            return {len(images) for images in _arrays(file, set(self._keys)).values()} == {1}
        except (ValueError, TypeError):  # TypeError: a number in place of an array
            return False

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, i: int) -> Trajectory:
        file = self._files[i]
        arrays = _arrays(file, {*self._keys, *OTHERS})
        key = next((key for key in self._keys if key in arrays), None)
        if key is None or "action" not in arrays:
            raise ValueError(
                f"{file} holds {sorted(arrays) or 'nothing known'}; an episode needs 'action' and "
                f"one of {', '.join(self._keys)}"
            )
        if len(arrays["action"]) != len(arrays[key]):
            raise ValueError(
                f"{file} has {len(arrays['action'])} actions for {len(arrays[key])} images; in "
                "this format they are equally many, the first action a placeholder"
            )
        if arrays.get("is_first", np.zeros(1))[1:].any():
            raise ValueError(
                f"{file} holds parts of several episodes (is_first), as DreamerV3's chunks do; "
                "write a file an episode"
            )
        over = arrays.get("is_terminal", 1 - arrays.get("discount", np.ones(1)))
        return self._trajectory(
            arrays[key],
            self._rescaled(arrays["action"][1:]),
            arrays["reward"][1:] if "reward" in arrays else None,
            source=file.relative_to(self._folder).as_posix(),
            terminated=bool(np.ravel(over)[-1] == 1),
            **self._labels(file),
        )

    def _rescaled(self, action: np.ndarray) -> np.ndarray:
        """(T, A) in the file's own limits -> (T, A) in [-1, 1]."""
        return rescaled(action, *self._limits) if self._limits else action

    def _labels(self, file: Path) -> dict[str, str]:
        """What the file's path says of robot and task, where nothing else was asked for."""
        return {}


def _arrays(file: Path, names: set[str]) -> dict[str, np.ndarray]:
    try:
        with open(file, "rb") as opened, np.load(opened, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if name in names}
    except (zipfile.BadZipFile, zlib.error, ValueError, EOFError, OSError) as error:
        raise ValueError(f"{file} is damaged or not an .npz of arrays: {error}") from error
