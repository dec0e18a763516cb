"""From any known format to a dataset on disk: `open_episodes`, `Conversions`.

Readers know trajectories and no dataset; `TrajectoryDataset` stands above them and inherits
`Conversions`, so that it offers `from_npz` and its siblings without a circle of imports.
"""

import hashlib
import inspect
import os
import shutil
import sys
import tempfile
import weakref
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer

from wpt_agents.data.importers.episodes import Episodes
from wpt_agents.data.importers.hdf5 import Hdf5Episodes
from wpt_agents.data.importers.lerobot import LeRobotEpisodes
from wpt_agents.data.importers.minari import MinariEpisodes, local_minari
from wpt_agents.data.importers.npz import NpzEpisodes
from wpt_agents.data.importers.rlds import RldsEpisodes
from wpt_agents.data.importers.sb3 import SB3Episodes
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.names import unknown_name

FORMATS: dict[str, type[Episodes]] = {
    "hdf5": Hdf5Episodes,
    "lerobot": LeRobotEpisodes,
    "minari": MinariEpisodes,
    "npz": NpzEpisodes,
    "rlds": RldsEpisodes,
    "sb3": SB3Episodes,
}
Source = str | os.PathLike[str]
Data = Source | ReplayBuffer | Iterable[Trajectory]  # what `TrajectoryDataset.of` takes


def open_episodes(
    source: Source | ReplayBuffer, form: str | None = None, **options: Any
) -> Episodes:
    """The episodes at `source`, in the format `form` or the one it looks like.

    :param options: the reader's own keywords, and those of `Episodes`
    :raises ValueError: a format or an option that is not known, or a source not recognised
    """
    form = form or recognise(source)
    if form is None:
        raise ValueError(
            f"{source} looks like none of: {', '.join(sorted(FORMATS))}; name the format"
        )
    if form not in FORMATS:
        raise unknown_name("format", form, FORMATS)
    own, shared = (inspect.signature(c.__init__).parameters for c in (FORMATS[form], Episodes))
    valid = [name for name in [*list(own)[2:], *shared] if name not in ("self", "options")]
    for name in options:
        if name not in valid:
            raise unknown_name(f"option for {form}", name, valid)
    return FORMATS[form](source, **options)  # type: ignore[arg-type]


def recognise(source: Source | ReplayBuffer) -> str | None:
    """Which of `FORMATS` this looks like; None for none, and for a dataset of ours."""
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
        for pattern, form in (("*.tfrecord*", "rlds"), ("*.npz", "npz")):
            if next(path.rglob(pattern), None):
                return form
    return "minari" if not path.exists() and local_minari(os.fspath(source)).exists() else None


class Conversions:
    """Datasets made of other people's files: classmethods of `TrajectoryDataset`."""

    @classmethod
    def from_episodes(cls, episodes: Episodes, path: Source, progress_bar: bool = False) -> Self:
        """Appends the episodes to the dataset at `path`; one that was cut short goes on.

        :raises ValueError: the dataset there does not begin with these episodes, or an episode
            cannot be converted; those before it are kept
        """
        from tqdm.auto import tqdm

        store: Any = cls  # `open_or_create` and `append` are TrajectoryDataset's
        dataset = store.open_or_create(path, episodes.image_size)
        done = dataset.appended
        known = done > 0 and len(dataset) == done  # else the last one may be set aside
        if done > len(episodes) or (known and not _same(dataset, episodes[done - 1])):
            raise ValueError(
                f"{path} holds {done} trajectories of another source or with other labels; "
                "convert to another folder"
            )
        bar = tqdm(
            total=len(episodes),
            initial=done,
            desc="convert",
            unit=" episodes",
            mininterval=0.2 if sys.stderr.isatty() else 10,
            disable=not progress_bar,
        )
        with dataset, bar:
            for i in range(done, len(episodes)):
                dataset.append(episodes[i])
                bar.update()
        return dataset

    @classmethod
    def from_hdf5(
        cls, source: Source, path: Source, progress_bar: bool = False, **options: Any
    ) -> Self:
        """Converts a flat HDF5 file in D4RL's manner; options are `Hdf5Episodes`'."""
        return cls.from_episodes(open_episodes(source, "hdf5", **options), path, progress_bar)

    @classmethod
    def from_lerobot(
        cls, source: Source, path: Source, progress_bar: bool = False, **options: Any
    ) -> Self:
        """Converts a LeRobot dataset of version 3; options are `LeRobotEpisodes`'."""
        return cls.from_episodes(open_episodes(source, "lerobot", **options), path, progress_bar)

    @classmethod
    def from_minari(
        cls, source: Source, path: Source, progress_bar: bool = False, **options: Any
    ) -> Self:
        """Converts a Minari dataset, by name or folder; options are `MinariEpisodes`'."""
        return cls.from_episodes(open_episodes(source, "minari", **options), path, progress_bar)

    @classmethod
    def from_npz(
        cls, source: Source, path: Source, progress_bar: bool = False, **options: Any
    ) -> Self:
        """Converts a folder of episodes in `.npz`; options are `NpzEpisodes`'."""
        return cls.from_episodes(open_episodes(source, "npz", **options), path, progress_bar)

    @classmethod
    def from_rlds(
        cls, source: Source, path: Source, progress_bar: bool = False, **options: Any
    ) -> Self:
        """Converts RLDS episodes as TFDS stores them; options are `RldsEpisodes`'."""
        return cls.from_episodes(open_episodes(source, "rlds", **options), path, progress_bar)

    @classmethod
    def from_sb3(
        cls,
        source: Source | ReplayBuffer,
        path: Source,
        progress_bar: bool = False,
        **options: Any,
    ) -> Self:
        """Converts a replay buffer of Stable-Baselines3; options are `SB3Episodes`'."""
        return cls.from_episodes(open_episodes(source, "sb3", **options), path, progress_bar)

    @classmethod
    def of(cls, data: Data) -> Self:
        """Whatever can serve as a dataset, as one.

        - a dataset, or the path of one: itself;
        - a path in one of `FORMATS`, or a local Minari dataset's name: converted into the cache
          (see `cache_folder`), once; a conversion that was cut short goes on;
        - a replay buffer of SB3, or any trajectories: stored in a temporary folder.
        """
        if isinstance(data, cls):
            return data
        store: Any = cls
        if not isinstance(data, str | os.PathLike):
            found = store.create(tempfile.mkdtemp(prefix="wpt_dataset_"))
            weakref.finalize(found, shutil.rmtree, found.path, ignore_errors=True)
            with found:
                found.extend(_trajectories(data))
            return found
        form = recognise(data)
        if form is None:
            return store.open(data)
        return cls.from_episodes(open_episodes(data, form), cache_folder(data), progress_bar=True)


def _trajectories(data: Iterable[Trajectory] | ReplayBuffer) -> Iterator[Trajectory]:
    yield from SB3Episodes(data) if isinstance(data, ReplayBuffer) else data


def _same(dataset: Any, read: Trajectory) -> bool:
    """Whether a dataset's last trajectory is this one: sources alike may be named alike."""
    stored = dataset[-1]
    return (
        _label(stored) == _label(read)
        and np.array_equal(stored.action, read.action[:, : read.action_dim])
        and stored.image.shape == read.image.shape
        and (not dataset.lossless or np.array_equal(stored.image, read.image))
    )


def _label(trajectory: Trajectory) -> tuple[Any, ...]:
    rewarded = trajectory.reward is not None
    return trajectory.source, trajectory.embodiment, trajectory.task, rewarded


def cache_folder(source: Source) -> Path:
    """Where the conversion of `source` is kept: another folder as soon as a file of it changes.

    Below `$XDG_CACHE_HOME/wpt_agents`, or `~/.cache/wpt_agents`; what is there may be deleted.
    """
    path = Path(source).resolve() if Path(source).exists() else local_minari(os.fspath(source))
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256(os.fsencode(path))
    for file in files:
        stat = file.stat()
        digest.update(f"{file.name} {stat.st_size} {stat.st_mtime_ns}\n".encode())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "wpt_agents" / f"{path.name}-{digest.hexdigest()[:16]}"
