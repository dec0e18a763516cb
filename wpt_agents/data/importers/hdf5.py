"""HDF5 files of robomimic, LIBERO, mimicgen, ALOHA and ACT, D4RL, V-D4RL, Minari and others.

- A group per episode, `data/demo_0/obs/agentview_image` and `data/demo_0/actions`, in numeric
  order (robomimic and LIBERO), or `traj_0/...` (ManiSkill).
- A file per episode, `observations/images/<camera>` and `action` (ALOHA and ACT).
- Flat rows, whose episodes end at `terminals`, `timeouts`, `terminations`, `truncations`, `dones`
  or `step_type` (D4RL and V-D4RL).
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from wpt_agents.data.importers.episodes import needs
from wpt_agents.data.importers.keys import Table, natural
from wpt_agents.data.importers.tables import TableEpisodes

SUFFIXES = (".hdf5", ".h5", ".he5", ".hdf")


class Hdf5Episodes(TableEpisodes):
    """The episodes of an HDF5 file, or of all files in a folder; see `TableEpisodes` for options.

    A folder is searched for `.hdf5` and `.h5` files.
    """

    _handle: Any = None

    def _list(self, path: Path) -> Sequence[Path]:
        if not path.is_dir():
            return super()._list(path)
        files = sorted((f for f in path.rglob("*") if f.suffix in SUFFIXES), key=natural)
        if not files:
            raise ValueError(f"{path} holds no HDF5 file ({', '.join(SUFFIXES)})")
        return files

    def _read(self, file: Path) -> Table:
        h5py = needs("h5py", "HDF5 files")
        if self._handle is not None:
            self._handle.close()
        try:
            self._handle = h5py.File(file, "r")
        except OSError as error:
            raise ValueError(f"{file} is damaged or not an HDF5 file: {error}") from error
        arrays: dict[str, Any] = {}

        def add(name: str, node: Any) -> None:
            if isinstance(node, h5py.Dataset):
                arrays[name] = node

        self._handle.visititems(add)
        return arrays

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
