"""zarr groups of rows, as Diffusion Policy and UMI write them: data/img, data/action, meta/...

`meta/episode_ends` holds one past the last row of each episode. Row t holds observation t and the
action taken at it.
"""

from pathlib import Path
from typing import Any

from wpt_agents.data.importers.episodes import needs
from wpt_agents.data.importers.keys import Table
from wpt_agents.data.importers.tables import TableEpisodes


class ZarrEpisodes(TableEpisodes):
    """The episodes of a zarr folder or a `.zip` file of one; see `TableEpisodes` for options."""

    def _read(self, file: Path) -> Table:
        zarr = needs("zarr", "zarr groups")
        try:
            zipped = file.suffix == ".zip"
            store = zarr.storage.ZipStore(file, mode="r") if zipped else str(file)
            group = zarr.open_group(store, mode="r")
            arrays = dict(_arrays(group, zarr.Array))
        except Exception as error:  # zarr and its codecs raise many types of exceptions
            raise ValueError(f"{file} cannot be read as a zarr group: {error!r}") from error
        return {name.removeprefix("data/").removeprefix("meta/"): a for name, a in arrays.items()}


def _arrays(group: Any, kind: type) -> Any:
    """Yield the path and array of all arrays in a group."""
    for name, node in group.members(max_depth=None):
        if isinstance(node, kind):
            yield name, node
