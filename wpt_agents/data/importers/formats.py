"""The formats that can be read, and which of them a path looks like."""

import inspect
import os
from pathlib import Path
from typing import Any

from stable_baselines3.common.buffers import ReplayBuffer

from wpt_agents.data.importers.episodes import Episodes
from wpt_agents.data.importers.hdf5 import Hdf5Episodes
from wpt_agents.data.importers.lerobot import LeRobotEpisodes
from wpt_agents.data.importers.minari import MinariEpisodes, local_minari
from wpt_agents.data.importers.npz import NpzEpisodes
from wpt_agents.data.importers.official import OfficialEpisodes, is_official
from wpt_agents.data.importers.rlds import RldsEpisodes
from wpt_agents.data.importers.sb3 import SB3Episodes
from wpt_agents.files.names import unknown_name

FORMATS: dict[str, type[Episodes]] = {
    "hdf5": Hdf5Episodes,
    "lerobot": LeRobotEpisodes,
    "minari": MinariEpisodes,
    "npz": NpzEpisodes,
    "official": OfficialEpisodes,
    "rlds": RldsEpisodes,
    "sb3": SB3Episodes,
}
Source = str | os.PathLike[str]


def open_episodes(
    source: Source | ReplayBuffer, form: str | None = None, **options: Any
) -> Episodes:
    """Open the episodes at `source`, in the format `form` or in the one that it looks like.

    :param options: the reader's own keywords, and those of `Episodes`
    :raises ValueError: an unknown format or option, or a source that is not recognised
    """
    if isinstance(source, str | os.PathLike):
        source = os.path.expanduser(source)
    form = form or recognise(source)
    if form is None:
        raise ValueError(
            f"{source} looks like none of: {', '.join(sorted(FORMATS))}; name the format"
        )
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    own = inspect.signature(FORMATS[form].__init__).parameters
    shared = inspect.signature(Episodes.__init__).parameters
    valid = [name for name in [*list(own)[2:], *shared] if name not in ("self", "options")]
    for name in options:
        if name not in valid:
            raise unknown_name(f"option for {form}", name, valid)
    return FORMATS[form](source, **options)  # type: ignore[arg-type]


def recognise(source: Source | ReplayBuffer) -> str | None:
    """The name in `FORMATS` that a source looks like; None for none, and for our own datasets."""
    if isinstance(source, ReplayBuffer):
        return "sb3"
    path = Path(source)
    if (path / "meta.json").exists():
        return None
    if (path / "meta" / "info.json").exists():
        return "lerobot"
    if any((path / part / "metadata.json").exists() for part in ("data", ".")):
        return "minari"
    if path.suffix in (".hdf5", ".h5"):
        return "hdf5"
    if path.is_dir():
        if is_official(path):
            return "official"
        for pattern, form in (("*.tfrecord*", "rlds"), ("*.npz", "npz")):
            if next(path.rglob(pattern), None):
                return form
    return "minari" if not path.exists() and local_minari(os.fspath(source)).exists() else None
