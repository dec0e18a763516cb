"""`.npz` files: one per episode (ExORL, URLB, DrQ-v2, the official NCRL data, Dreamer), or rows.

In a file per episode, arrays have length T + 1, and action t is the one that *led to* observation
t: the first action and reward are placeholders. So our action t is their action t + 1. If there are
only T actions for T + 1 images, their timing is ours.

In a file of rows (OGBench), flags such as `terminals` say where episodes end; action t was taken at
observation t. Such files are read row by row, never as a whole.
"""

import os
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import Episodes, warn_left_out
from wpt_agents.data.importers.keys import ACTIONS, ENDS, Table, count, first, natural
from wpt_agents.data.importers.rows import between_images
from wpt_agents.data.importers.tables import TableEpisodes
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.folders import files_below

# of ExORL and URLB, of Dreamer, of others
IMAGE_KEYS = ("observation", "image", "pixels")
OTHERS = ("reward", "discount", "is_terminal", "is_first")
# all exceptions that zipfile and NumPy raise for damaged files
FAULTS = (zipfile.BadZipFile, zlib.error, RuntimeError, ValueError, EOFError, OSError, KeyError)


class NpzEpisodes(Episodes):
    """The episodes of a `.npz` file, or of all files below a folder, sorted by name.

    :param folder: searched for `.npz` files; those without actions and images are skipped
    :param shifted: whether row t holds the action that led to image t, instead of the one that was
        taken at it; by default it did, and a first action that is no placeholder is refused
    :param options: those of `Episodes`
    """

    def __init__(
        self, folder: str | os.PathLike[str], shifted: bool | None = None, **options: Any
    ) -> None:
        super().__init__(**options)
        path = Path(folder)
        self._shifted = shifted
        self._folder = path.parent if path.is_file() else path
        self._image_keys = (self.image_key,) if self.image_key else IMAGE_KEYS
        self._action_keys = self.action_keys or ("action",)
        files = [path] if path.is_file() else sorted(files_below(path, "*.npz"))
        if not files:
            raise ValueError(f"{folder} holds no .npz file")
        kinds = {file: self._kind(file) for file in files}
        self._files = [file for file, kind in kinds.items() if kind == "episode"]
        self._flat = FlatNpz(path, shifted, **options) if "flat" in kinds.values() else None
        strange = [file for file, kind in kinds.items() if kind == "other"]
        if strange and (self._files or self._flat):
            warnings.warn(
                f"{folder}: {len(strange)} .npz files without actions and images are skipped, "
                f"{strange[0].name} for example",
                stacklevel=2,
            )
        elif strange:
            self._files = strange  # so that the error of reading says what they lack
        warn_left_out(list(kinds.values()).count("single"), folder)

    def _kind(self, file: Path) -> str:
        """Return the kind of a file: "episode", "single" (of one image at most), "flat" or "other".

        Damaged files count as episodes, so that reading them raises an error that names them.
        """
        if is_flat(file):
            return "flat"
        try:
            names = names_of(file)
            images = [key for key in self._image_keys if key in names]
            actions = [key for key in self._action_keys if key in names]
            if not images and not actions:
                return "other"
            if actions and len(arrays_of(file, set(actions)).get(actions[0], ())) <= 1:
                lengths = {len(array) for array in arrays_of(file, set(images)).values()}
                return "single" if lengths and max(lengths) <= 1 else "episode"
        except (ValueError, TypeError):  # TypeError: a number in place of an array
            pass
        return "episode"

    def __len__(self) -> int:
        return len(self._files) + (0 if self._flat is None else len(self._flat))

    def __getitem__(self, i: int) -> Trajectory:
        if self._flat is not None and i >= len(self._files):
            return self._flat[i - len(self._files)]
        file = self._files[i]
        keys = {*self._image_keys, *self._action_keys, *OTHERS, *self._done_keys()}
        if not self.rewards:
            keys.discard("reward")
        arrays = arrays_of(file, keys)
        key = self._check(file, arrays)
        images = len(arrays[key])
        actions = [arrays[name] for name in self._action_keys]
        taken = between_images(actions, images, self._shifted, str(file))
        # dm_env marks a terminal state by a discount of 0, and a time limit by 1
        over = arrays.get("is_terminal", 1 - arrays.get("discount", np.ones(1)))
        if self.done_key is not None:
            over = arrays[self.done_key]
        # Where the last action is dropped, what it led to is not seen.
        seen = taken.start == 1 or len(actions[0]) < images
        return self._trajectory(
            arrays[key],
            self._actions(arrays, taken),
            arrays["reward"][taken] if "reward" in arrays else None,
            source=file.relative_to(self._folder).as_posix(),
            terminated=seen and bool((np.ravel(over)[-1:] == 1).any()),
            **self._labels(file),
        )

    def _actions(self, arrays: dict[str, np.ndarray], taken: slice) -> np.ndarray:
        """Return the actions between the images; several arrays are concatenated."""
        actions = [np.asarray(arrays[name][taken]) for name in self._action_keys]
        if len(actions) == 1:
            return actions[0]
        return np.concatenate([a.reshape(len(a), -1) for a in actions], axis=1)

    def _labels(self, file: Path) -> dict[str, Any]:
        """Return robot and task as the file's path names them, unless the user set them."""
        return {}

    def _done_keys(self) -> tuple[str, ...]:
        return () if self.done_key is None else (self.done_key,)

    def _check(self, file: Path, arrays: dict[str, np.ndarray]) -> str:
        """Return the images' key.

        :raises ValueError: if an array is missing or has another length, or if there are several
            episodes
        """
        key = next((key for key in self._image_keys if key in arrays), None)
        needed = (*self._action_keys, *self._done_keys())
        if key is None or any(name not in arrays for name in needed):
            raise ValueError(
                f"{file} holds {', '.join(names_of(file)) or 'nothing'}; an episode needs "
                f"{', '.join(map(repr, needed))} and one of {', '.join(self._image_keys)}; name "
                "them by image_key and action_key (--image-key, --action-key)"
            )
        images = count(arrays[key])
        counts = {len(np.atleast_1d(arrays[name])) for name in self._action_keys}
        if counts not in ({images}, {images - 1}):
            raise ValueError(
                f"{file} has {' and '.join(map(str, sorted(counts)))} actions for {images} images; "
                "in this format they are equally many, and the first action is a placeholder, or "
                "there is one action fewer"
            )
        rewards = len(np.atleast_1d(arrays.get("reward", ())))
        if "reward" in arrays and {rewards} != counts:
            raise ValueError(f"{file} has {rewards} rewards for {max(counts)} actions")
        if np.ravel(arrays.get("is_first", 0))[1:].any():
            raise ValueError(
                f"{file} holds parts of several episodes (is_first), as DreamerV3's chunks do; "
                "write one file per episode"
            )
        return key


class FlatNpz(TableEpisodes):
    """The episodes of `.npz` files that contain rows."""

    _archive: zipfile.ZipFile | None = None

    def _list(self, path: Path) -> list[Path]:
        files = [path] if path.is_file() else sorted(files_below(path, "*.npz"), key=natural)
        return [file for file in files if is_flat(file)]

    def _read(self, file: Path) -> Table:
        if self._archive is not None:
            self._archive.close()
        try:
            self._archive = zipfile.ZipFile(file)
            names = [n.removesuffix(".npy") for n in self._archive.namelist()]
            members = {name: Member(self._archive, name) for name in names}
            # Python objects, such as dictionaries about the recording, would need a pickle.
            return {name: m for name, m in members.items() if not m.dtype.hasobject}
        except FAULTS as error:
            raise ValueError(f"{file} is damaged or not an .npz of arrays: {error}") from error


class Member:
    """An array in an `.npz` archive that is read row by row; fast if rows are read in order.

    :ivar shape: of the whole array
    :ivar dtype: of its numbers
    """

    def __init__(self, archive: zipfile.ZipFile, name: str) -> None:
        self._archive = archive
        self._name = f"{name}.npy"
        self._stream = archive.open(self._name)
        version = np.lib.format.read_magic(self._stream)  # type: ignore[no-untyped-call]
        read = getattr(np.lib.format, f"read_array_header_{version[0]}_{version[1]}")
        self.shape, fortran, self.dtype = read(self._stream)
        self._data = self._stream.tell()
        # The rows of an array in Fortran order, a transposed one, are not adjacent.
        self._whole = self._read_whole() if fortran and not self.dtype.hasobject else None

    def __len__(self) -> int:
        return int(self.shape[0]) if self.shape else 0

    def _read_whole(self) -> np.ndarray:
        numbers = np.frombuffer(self._stream.read(), self.dtype)
        return np.ascontiguousarray(numbers.reshape(self.shape, order="F"))

    def __getitem__(self, rows: slice) -> np.ndarray:
        if self._whole is not None:
            return self._whole[rows]
        start, stop, _ = rows.indices(len(self))
        size = int(self.dtype.itemsize * np.prod(self.shape[1:], dtype=np.int64))
        try:
            self._stream.seek(self._data + start * size)
            data = self._stream.read((stop - start) * size)
        except FAULTS as error:
            file = self._archive.filename
            raise ValueError(f"{file} is damaged in {self._name}: {error}") from error
        return np.frombuffer(data, self.dtype).reshape(-1, *self.shape[1:])


def is_flat(file: Path) -> bool:
    """Return whether a file contains rows of many episodes, with flags at their ends."""
    try:
        names = names_of(file)
    except ValueError:
        return False
    return first(ACTIONS, names) is not None and first(ENDS, names) is not None


def names_of(file: Path) -> list[str]:
    """Return the names of the arrays in a file."""
    try:
        with zipfile.ZipFile(file) as archive:
            return [name.removesuffix(".npy") for name in archive.namelist()]
    except FAULTS as error:
        raise _unreadable(file, error) from error


def arrays_of(file: Path, names: set[str]) -> dict[str, np.ndarray]:
    """Load some arrays of a file."""
    if not zipfile.is_zipfile(file):  # np.load reads other files, too, or takes them for pickles
        raise _unreadable(file, "it is not a zip archive")
    try:
        with open(file, "rb") as opened, np.load(opened, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files if name in names}
    except FAULTS as error:
        raise _unreadable(file, error) from error


def _unreadable(file: Path, fault: object) -> ValueError:
    """Return the error for a file that is no `.npz` archive, or a damaged one."""
    known = "" if file.suffix == ".npz" else "; if it is of another format, name that, or auto"
    return ValueError(f"{file} is damaged or not an .npz of arrays: {fault}{known}")
