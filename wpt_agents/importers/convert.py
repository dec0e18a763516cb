"""From any known format to a dataset on disk: `open_episodes`, `convert`."""

import os
from pathlib import Path
from typing import Any

from wpt_agents.dataset import TrajectoryDataset
from wpt_agents.importers.episodes import Episodes
from wpt_agents.importers.hdf5 import Hdf5Episodes
from wpt_agents.importers.lerobot import LeRobotEpisodes
from wpt_agents.importers.minari import MinariEpisodes
from wpt_agents.importers.npz import NpzEpisodes

FORMATS: dict[str, type[Episodes]] = {
    "hdf5": Hdf5Episodes,
    "lerobot": LeRobotEpisodes,
    "minari": MinariEpisodes,
    "npz": NpzEpisodes,
}


def open_episodes(
    source: str | os.PathLike[str], form: str | None = None, **options: Any
) -> Episodes:
    """The episodes at `source`, in the format `form` or the one it looks like.

    :raises ValueError: a format that is not known or not recognised
    """
    form = form or _recognise(Path(source))
    if form not in FORMATS:
        raise ValueError(f"No format {form!r}. There are: {', '.join(sorted(FORMATS))}")
    return FORMATS[form](source, **options)  # type: ignore[arg-type]


def _recognise(source: Path) -> str:
    if (source / "meta" / "info.json").exists():
        return "lerobot"
    if any((source / part / "metadata.json").exists() for part in ("data", ".")):
        return "minari"
    if source.suffix in (".hdf5", ".h5"):
        return "hdf5"
    if source.is_dir() and next(source.rglob("*.npz"), None):
        return "npz"
    raise ValueError(f"{source} looks like none of: {', '.join(sorted(FORMATS))}; name the format")


def convert(
    episodes: Episodes, path: str | os.PathLike[str], progress_bar: bool = False
) -> TrajectoryDataset:
    """Appends the episodes to the dataset at `path`; one that was cut short goes on.

    :raises ValueError: the dataset there does not begin with these episodes, or an episode cannot
        be converted; those before it are kept
    """
    from tqdm.auto import tqdm

    new = not Path(path).exists()
    dataset = (
        TrajectoryDataset.create(path, episodes.image_size) if new else TrajectoryDataset.open(path)
    )
    done = len(dataset)
    if done > len(episodes) or (done and dataset[-1].source != episodes[done - 1].source):
        raise ValueError(
            f"{path} holds {done} trajectories of another source; convert to another folder"
        )
    with dataset, tqdm(total=len(episodes), initial=done, disable=not progress_bar) as bar:
        for i in range(done, len(episodes)):
            dataset.append(episodes[i])
            bar.update()
    return dataset
