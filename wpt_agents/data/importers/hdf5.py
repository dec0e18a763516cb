"""HDF5 files of robomimic, LIBERO, mimicgen, ALOHA and ACT, D4RL, V-D4RL, Minari and others.

- A group per episode, `data/demo_0/obs/agentview_image` and `data/demo_0/actions`, in numeric
  order (robomimic and LIBERO), or `traj_0/...` (ManiSkill).
- A file per episode, `observations/images/<camera>` and `action` (ALOHA and ACT).
- Flat rows, whose episodes end at `terminals`, `timeouts`, `terminations`, `truncations`, `dones`
  or `step_type` (D4RL and V-D4RL).
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from wpt_agents.data.importers.episodes import needs
from wpt_agents.data.importers.keys import Table, natural
from wpt_agents.data.importers.tables import TableEpisodes
from wpt_agents.files.folders import files_below

SUFFIXES = (".hdf5", ".h5", ".he5", ".hdf")


class Hdf5Episodes(TableEpisodes):
    """The episodes of an HDF5 file, or of all files in a folder; see `TableEpisodes` for options.

    A folder is searched for `.hdf5` and `.h5` files.
    """

    remedy = (
        ". If it is not damaged but compressed by a filter that HDF5 lacks, pip install hdf5plugin"
    )
    _handle: Any = None

    def _list(self, path: Path) -> Sequence[Path]:
        if not path.is_dir():
            return super()._list(path)
        files = sorted((f for f in files_below(path) if f.suffix in SUFFIXES), key=natural)
        if not files:
            raise ValueError(f"{path} holds no HDF5 file ({', '.join(SUFFIXES)})")
        return files

    def _read(self, file: Path) -> Table:
        h5py = needs("h5py", "HDF5 files")
        with suppress(ImportError):
            import_module("hdf5plugin")  # registers further filters
        if self._handle is not None:
            self._handle.close()
        try:
            self._handle = h5py.File(file, "r")
        except OSError as error:
            raise ValueError(f"{file} is damaged or not an HDF5 file: {error}") from error
        return {
            # an empty array has no shape
            name: Array(self._handle, name, array.shape or (), array.dtype, array.chunks)
            for name, array in _arrays(self._handle, h5py.Dataset)
        }

    def _task(self, file: Path) -> str | None:
        """Return LIBERO's instruction, or the name of robomimic's environment."""
        attributes = self._handle["data"].attrs if "data" in self._handle else {}
        for attribute, key in (("problem_info", "language_instruction"), ("env_args", "env_name")):
            try:
                label = json.loads(attributes[attribute])[key]
            except (KeyError, TypeError, ValueError):
                continue
            return "".join(label) if isinstance(label, list) else str(label)
        return None


@dataclass(frozen=True)
class Array:
    """An array of an open file, which is opened for each access.

    HDF5 keeps up to megabytes of what was read from an array for as long as the array is open.
    """

    file: Any
    name: str
    shape: tuple[int, ...]
    dtype: np.dtype
    chunks: tuple[int, ...] | None

    def __getitem__(self, rows: Any) -> np.ndarray:
        values: np.ndarray = self.file[self.name][rows]
        return values


def _arrays(group: Any, kind: type, above: tuple[Any, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield the path and array of all arrays in a group, through links, too.

    :param above: the groups that contain it, to which a link may lead back
    :raises ValueError: if a link leads nowhere
    """
    for name in group:
        try:
            node = group[name]
        except (KeyError, OSError) as error:
            raise ValueError(
                f"the link {name!r} in {group.name!r} leads nowhere ({error}): restore the file "
                f"that it names, or remove the link, del file[{group.name!r}][{name!r}]"
            ) from error
        if isinstance(node, kind):
            yield name, node
        elif hasattr(node, "items") and node not in (*above, group):
            for inner, array in _arrays(node, kind, (*above, group)):
                yield f"{name}/{inner}", array
