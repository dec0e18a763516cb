"""Files of arrays (HDF5, zarr): flat rows, a group per episode, or a file per episode."""

import os
import warnings
import zipfile
import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from wpt_agents.data.importers import rows
from wpt_agents.data.importers.episodes import Episodes, as_images, warn_left_out
from wpt_agents.data.importers.keys import (
    ENDS,
    Keys,
    Table,
    by_group,
    count,
    find_keys,
    first,
    match,
    within,
)
from wpt_agents.data.trajectory import Trajectory

# what h5py, zarr's codecs and zip archives raise for damaged files
UNREADABLE = (OSError, RuntimeError, zipfile.BadZipFile, zlib.error)


@dataclass(frozen=True)
class Place:
    """The location of an episode: a file, a group in it, and rows (None: the whole group)."""

    file: Path
    group: str
    bounds: tuple[int, int] | None
    keys: Keys
    shifted: bool | None
    task: str | None


class TableEpisodes(Episodes):
    """The episodes in files of arrays, file by file.

    :param path: a file, or a folder whose files are read in their numeric order
    :param shifted: whether row t holds the action that led to observation t, as in dm_env's
        convention, instead of the one that was taken at it; inferred for `step_type` if None
    """

    remedy = ""  # what to do where arrays cannot be read

    def __init__(
        self, path: str | os.PathLike[str], shifted: bool | None = None, **options: Any
    ) -> None:
        super().__init__(**options)
        self._root = Path(path)
        self._shifted = shifted
        self._opened: tuple[Path, Table] | None = None
        self._grouped: tuple[Path, Mapping[str, Table]] | None = None
        self._places: list[Place] = []
        self._chosen: set[str] = set()
        self._doubtful: list[bool] = []
        left_out = 0
        files = self._list(self._root)
        for file in files:
            try:
                left_out += self._find(file, several=len(files) > 1)
            except UNREADABLE as error:
                raise ValueError(f"{file} cannot be read: {error}{self.remedy}") from error
            except ValueError as error:
                name = "" if str(error).startswith(str(file)) else f"{file}: "
                raise ValueError(f"{name}{error}") from error
        warn_left_out(left_out, path)
        # One episode may well begin so.
        if self._doubtful and all(self._doubtful) and len(self._places) > 1:
            warnings.warn(
                f"{path}: the first action of every episode is zero. If it is a placeholder, the "
                "action of a row led to its observation, and shifted=True (--shifted) is needed; "
                "shifted=False (--no-shifted) confirms that it was taken at the observation",
                stacklevel=2,
            )

    def _list(self, path: Path) -> Sequence[Path]:
        """Return the files to read.

        :raises ValueError: if there are none
        """
        if not path.exists():
            raise ValueError(f"{path} does not exist")
        return [path]

    @abstractmethod
    def _read(self, file: Path) -> Table:
        """Return all arrays of a file by their paths in it."""

    def _task(self, file: Path) -> str | None:
        """Return the task of a file's episodes, if the file names it."""
        return None

    def _table(self, file: Path) -> Table:
        if self._opened is None or self._opened[0] != file:
            self._opened = file, self._read(file)
        return self._opened[1]

    def _groups(self, file: Path) -> Mapping[str, Table]:
        """Return the arrays of each episode's group; those of the present file are kept."""
        if self._grouped is None or self._grouped[0] != file:
            self._grouped = file, by_group(self._table(file), self.action_keys)[0]
        return self._grouped[1]

    def _find(self, file: Path, several: bool) -> int:
        """Add the locations of a file's episodes; return the number of those without an action."""
        table = self._table(file)
        task = self._task(file)
        groups, idle = by_group(table, self.action_keys)
        if not groups and any(match(key, table) is None for key in self.action_keys):
            groups, idle = by_group(table, ())  # the error then names the group's arrays
        if idle:
            warnings.warn(
                f"{file}: {len(idle)} groups of images without actions are left out, {idle[0]} for "
                "example",
                stacklevel=4,
            )
        if groups:
            return self._find_groups(file, groups, task)
        keys = self._keys(table, self.image_key, self.action_keys)
        self._say_camera(keys)
        flags = self.done_key is not None or first(ENDS, table) is not None
        flags = flags or len(rows.starts(table, count(table[keys.actions[0]]))) > 1
        alone = several or keys.image.startswith("observations/images/")
        if (alone and not flags) or rows.is_one_episode(table, keys, self.done_key):
            return self._add_whole(file, "", table, keys, task)
        cut = rows.cut(table, keys, self.done_key, self._shifted)
        for bounds in cut.bounds:
            self._places.append(Place(file, "", bounds, keys, cut.shifted, task))
        self._doubtful.append(cut.doubtful)
        return cut.left_out

    def _keys(self, table: Table, *names: Any) -> Keys:
        """Return the names of an episode's arrays; rewards that are not kept are not read."""
        keys = find_keys(table, *names)
        return keys if self.rewards else replace(keys, reward=None)

    def _find_groups(self, file: Path, groups: dict[str, Table], task: str | None) -> int:
        image_key = None if self.image_key is None else within(self.image_key, groups)
        action_keys = tuple(within(key, groups) for key in self.action_keys)
        done_key = None if self.done_key is None else within(self.done_key, groups)
        left_out = 0
        for group, table in groups.items():
            try:
                keys = self._keys(table, image_key, action_keys, done_key)
            except ValueError as error:
                raise ValueError(f"{file} in {group}: {error}") from error
            self._say_camera(keys)
            left_out += self._add_whole(file, group, table, keys, task)
        return left_out

    def _add_whole(
        self, file: Path, group: str, table: Table, keys: Keys, task: str | None
    ) -> bool:
        """Add the location of an episode; return whether it was left out, as it has no action."""
        short = count(table[keys.image]) < (2 if keys.next_image is None else 1)
        if not short:
            self._places.append(Place(file, group, None, keys, self._shifted, task))
        return short

    def _say_camera(self, keys: Keys) -> None:
        if keys.others and keys.image not in self._chosen:
            self._chosen.add(keys.image)
            warnings.warn(
                f"{self._root} has several cameras; {keys.image!r} is used. To use another, pass "
                f"image_key (--image-key): {', '.join(keys.others)}",
                stacklevel=4,
            )

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, i: int) -> Trajectory:
        place = self._places[i]
        table = self._table(place.file)
        if place.group:
            table = self._groups(place.file)[place.group]
        source = self._source(place)
        try:
            if place.bounds is None:
                episode = rows.whole(table, place.keys, place.shifted)
            else:
                episode = rows.episode(table, place.keys, *place.bounds, bool(place.shifted))
            pieces, action, reward, terminated = episode
            image = rows.read_images(pieces, lambda images: as_images(images, self._resize))
        except UNREADABLE as error:
            raise ValueError(f"{source} cannot be read: {error}{self.remedy}") from error
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error
        return self._trajectory(
            image, action, reward, source, terminated=terminated, task=self.task or place.task
        )

    def _source(self, place: Place) -> str:
        """Return the name of an episode: its file, and its group or rows in it."""
        name = place.file.name if place.file == self._root else self._relative(place.file)
        if place.bounds is not None:
            start, stop = place.bounds
            return f"{name} rows {start} to {stop - 1}"
        return f"{name} {place.group}" if place.group else name

    def _relative(self, file: Path) -> str:
        return file.relative_to(self._root).as_posix()
