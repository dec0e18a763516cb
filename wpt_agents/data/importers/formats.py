"""The formats that can be read, and their recognition by path."""

import inspect
import os
from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer

from wpt_agents.data.importers.episodes import Episodes, Without
from wpt_agents.data.importers.hdf5 import Hdf5Episodes
from wpt_agents.data.importers.lerobot import LeRobotEpisodes
from wpt_agents.data.importers.minari import MinariEpisodes
from wpt_agents.data.importers.npz import NpzEpisodes
from wpt_agents.data.importers.official import OfficialEpisodes
from wpt_agents.data.importers.recognise import recognise_path, refusal
from wpt_agents.data.importers.rlds import RldsEpisodes
from wpt_agents.data.importers.sb3 import SB3Episodes
from wpt_agents.data.importers.tdmpc2 import TdMpc2Episodes
from wpt_agents.data.importers.zarr import ZarrEpisodes
from wpt_agents.files.names import unknown_name

FORMATS: dict[str, type[Episodes]] = {
    "hdf5": Hdf5Episodes,
    "lerobot": LeRobotEpisodes,
    "minari": MinariEpisodes,
    "npz": NpzEpisodes,
    "official": OfficialEpisodes,
    "rlds": RldsEpisodes,
    "sb3": SB3Episodes,
    "tdmpc2": TdMpc2Episodes,
    "zarr": ZarrEpisodes,
}
NAMES = ", ".join(FORMATS)
Source = str | os.PathLike[str]


def open_episodes(
    source: Source | ReplayBuffer,
    form: str | None = None,
    skip: Sequence[int] = (),
    **options: Any,
) -> Episodes:
    """Open the episodes at `source`, in the format `form` or in the one that is recognised.

    :param skip: the numbers of episodes to leave out, counted from 0
    :param options: the reader's own keywords, and those of `Episodes`
    :raises ValueError: if the format, an option or the source is unknown
    """
    if isinstance(source, str | os.PathLike):
        source = os.path.expanduser(source)
    form = form or recognise(source)
    if form is None:
        raise refusal(os.fspath(source), NAMES)  # type: ignore[arg-type]  # a buffer has a format
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    parameters = inspect.signature(FORMATS[form].__init__).parameters
    shared = inspect.signature(Episodes.__init__).parameters
    names = [*list(parameters)[2:], *shared, "skip"]
    valid = [name for name in names if name not in ("self", "options")]
    for name in options:
        if name not in valid:
            raise unknown_name(f"option for {form}", name, valid)
    episodes = FORMATS[form](source, **options)  # type: ignore[arg-type]
    if isinstance(source, str):
        episodes.name = source
    return Without(episodes, skip) if len(skip) else episodes


def recognise(source: Source | ReplayBuffer) -> str | None:
    """Return the recognised name in `FORMATS`, None if there is none or for our own datasets."""
    return "sb3" if isinstance(source, ReplayBuffer) else recognise_path(source)
