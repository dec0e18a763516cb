"""Make a dataset from anything that can serve as one: `open_dataset`, and the conversions.

This module assigns `TrajectoryDataset.of`, `TrajectoryDataset.from_npz` and the other constructors;
the module of the class itself knows no other format.
"""

import hashlib
import os
import shutil
import tempfile
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer as SB3Buffer
from stable_baselines3.common.vec_env import VecEnv

from wpt_agents.data.bars import StageBar
from wpt_agents.data.dataset import Source, TrajectoryDataset
from wpt_agents.data.importers.damaged import converted
from wpt_agents.data.importers.episodes import Episodes
from wpt_agents.data.importers.formats import FORMATS, NAMES, open_episodes, recognise
from wpt_agents.data.importers.lerobot import LeRobotEpisodes
from wpt_agents.data.importers.minari import MinariEpisodes, local_minari
from wpt_agents.data.importers.recognise import refusal
from wpt_agents.data.importers.sb3 import SB3Episodes
from wpt_agents.data.index import CONVERT_LOCK
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.data.units import Ranges
from wpt_agents.files.folders import files_below
from wpt_agents.files.locks import locked

# Increased when a reader begins to read a format differently, so that conversions by earlier
# versions are not used any more.
READERS = 2

One = Source | TrajectoryDataset | SB3Buffer | ReplayBuffer | Episodes | Trajectory
Data = One | Sequence[One] | Iterable[Trajectory]


def open_dataset(data: Data) -> TrajectoryDataset:
    """Open anything that can serve as a dataset.

    - A dataset, or the path of one: the dataset itself.
    - The path of files in one of `FORMATS`, or the name of a local Minari dataset: it is converted
      once, into the cache (see `cache_folder`); an interrupted conversion continues.
    - A replay buffer, a Trajectory, or an iterable of Trajectories: stored in a temporary folder.
    - A list of any of these: a view of all as one dataset.

    :param data: one of these
    :return: the dataset
    :raises ValueError: anything else; the message says what it is and what to do
    """
    if isinstance(data, TrajectoryDataset):
        return data
    if isinstance(data, str | os.PathLike):
        return _open_path(data)
    if isinstance(data, SB3Buffer):
        return _stored(SB3Episodes(data))
    if isinstance(data, ReplayBuffer):
        return _stored(data.trajectories)
    if isinstance(data, Trajectory):
        return _stored([data])
    module = type(data).__module__.split(".")[0]
    if module == "minari":
        return _stored(MinariEpisodes(data))
    if module == "lerobot" and hasattr(data, "root"):
        chosen = getattr(data, "episodes", None)
        if chosen is None:
            return _open_path(data.root)
        return _stored(LeRobotEpisodes(data.root, episodes=chosen))
    if isinstance(data, Episodes) or not isinstance(data, Sequence):
        return _stored(_checked(data))
    if not data:
        raise ValueError("The dataset is an empty list; pass trajectories, datasets or paths")
    if all(isinstance(item, Trajectory) for item in data):
        return _stored(cast(Sequence[Trajectory], data))
    refuse_object(data)
    return TrajectoryDataset.join([open_dataset(item) for item in data])


def _checked(data: Any) -> Iterator[Trajectory]:
    """Yield the trajectories of an iterable; raise a ValueError for anything else."""
    refuse_object(data)
    for i, item in enumerate(data):
        if not isinstance(item, Trajectory):
            raise ValueError(
                f"Item {i} of the {type(data).__name__} is a {type(item).__name__}; an iterable "
                "that is taken for a dataset must yield Trajectory(image, action)"
            )
        yield item


def refuse_object(data: Any) -> None:
    """Raise a ValueError with advice for objects that are often mistaken for a dataset.

    :raises ValueError: a dictionary, an array, arrays or an environment, for example
    """
    kind = type(data).__name__
    make = "make Trajectory(image, action) of each episode and pass their list"
    if isinstance(data, Mapping):
        raise ValueError(f"A dictionary ({', '.join(map(str, data))}) is not a dataset; {make}")
    if isinstance(data, np.ndarray | torch.Tensor):
        raise ValueError(
            f"An array of {tuple(data.shape)} is not a dataset: it has images or actions only; "
            f"{make}"
        )
    if isinstance(data, Sequence) and any(
        isinstance(item, np.ndarray | torch.Tensor) for item in data
    ):
        raise ValueError(f"A {kind} of arrays is not a dataset; {make}")
    if isinstance(data, gym.Env | VecEnv):
        raise ValueError(
            f"An environment ({kind}) is not a dataset: pass it as env=, and as dataset= the data"
        )
    if isinstance(data, bytes) or not isinstance(data, Iterable):
        raise ValueError(
            f"An object of type {kind} is not a dataset; pass a TrajectoryDataset, a path, "
            "trajectories, a replay buffer, or a list of these"
        )


class TemporaryFolder:
    """A folder that is removed with the last dataset that reads it, copies included."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="wpt_dataset_"))
        weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)

    def __deepcopy__(self, memo: object) -> "TemporaryFolder":
        return self


def _stored(trajectories: Iterable[Trajectory]) -> TrajectoryDataset:
    """Return a dataset in a temporary folder, which is removed with it and its copies."""
    folder = TemporaryFolder()
    dataset = TrajectoryDataset.create(folder.path)
    dataset._whole = folder
    with dataset:
        dataset.extend(trajectories)
    return dataset


def _open_path(source: Source) -> TrajectoryDataset:
    source = os.path.expanduser(source)
    form = recognise(source)
    if form is None and (Path(source) / "meta.json").exists():
        return TrajectoryDataset.open(source)
    if form is None:
        raise refusal(source, NAMES)
    folder = cache_folder(source)
    with ExitStack() as stack:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            # Of several processes that start at once, one converts; the others wait and find it
            # done.
            stack.enter_context(locked(folder / CONVERT_LOCK))
        except OSError as error:
            # A conversion that is there is used, also where nothing can be written.
            missing = not (folder / "meta.json").exists()
            if missing and error.errno is None:  # this system has no locks
                raise
            if missing:
                raise ValueError(
                    f"{source} is converted into a cache, which cannot be made ({error}): set "
                    "XDG_CACHE_HOME to a folder that can be written to, or convert first by "
                    f"`python -m wpt_agents.zoo import {form} {source} DST`"
                ) from error
        return from_episodes(open_episodes(source, form), folder, progress_bar=True)


def from_episodes(
    episodes: Episodes, path: Source, progress_bar: bool = False
) -> TrajectoryDataset:
    """Convert episodes into a dataset at `path`; an interrupted conversion continues.

    :param episodes: trajectories by number, such as a reader of a format
    :param path: the folder of the dataset
    :param progress_bar: show a progress bar
    :return: the dataset
    :raises ValueError: the dataset at `path` does not begin with these episodes, or an episode
        cannot be converted; the episodes before it are kept
    """
    dataset = TrajectoryDataset.open_or_create(path, episodes.image_size)
    ranges = Ranges()
    with dataset:
        done = _count_done(dataset, episodes, path)
        if done < len(episodes):
            dataset.reserve()  # another process may have converted some in between
            done = _count_done(dataset, episodes, path)
        with StageBar(len(episodes), "convert", progress_bar, done, " episodes") as bar:
            for i in range(done, len(episodes)):
                trajectory = converted(episodes, i)
                dataset.append(trajectory)
                ranges.add(trajectory)
                bar.update()
    ranges.warn(episodes.name)
    return dataset


def _count_done(dataset: TrajectoryDataset, episodes: Episodes, path: Source) -> int:
    """Return how many of the episodes are in the dataset already.

    :raises ValueError: the dataset does not begin with these episodes
    """
    done = dataset.appended
    known = done > 0 and len(dataset) == done  # otherwise the last one may be set aside
    if done > len(episodes) or (known and not _same(dataset, episodes[done - 1])):
        raise ValueError(
            f"{path} holds {done} trajectories of another source, from another camera or other "
            "limits, or with other labels; convert to another folder"
        )
    return done


def _same(dataset: TrajectoryDataset, read: Trajectory) -> bool:
    """Return whether `read` is a dataset's last trajectory; names of sources are not unique."""
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
    """Return the folder for the conversion of `source`, another one if a file of it changes.

    It is in `$XDG_CACHE_HOME/wpt_agents`, or `~/.cache/wpt_agents`; its content may be deleted.
    """
    path = Path(source).resolve() if Path(source).exists() else local_minari(os.fspath(source))
    files = sorted(p for p in files_below(path) if p.is_file()) if path.is_dir() else [path]
    digest = hashlib.sha256(os.fsencode(path) + b" %d" % READERS)
    for file in files:
        # Size and time instead of the content, which may be many gigabytes.
        stat = file.stat()
        name = file.relative_to(path).as_posix()  # the folders in it may be labels
        digest.update(os.fsencode(f"{name} {stat.st_size} {stat.st_mtime_ns}\n"))
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return base / "wpt_agents" / f"{path.name}-{digest.hexdigest()[:16]}"


def convert(
    source: Source | SB3Buffer,
    path: Source,
    progress_bar: bool = False,
    form: str | None = None,
    **options: Any,
) -> TrajectoryDataset:
    """Convert data in another format at `source` into a dataset at `path`.

    :param source: a file, a folder, a name or a replay buffer, depending on the format
    :param path: the folder of the dataset
    :param progress_bar: show a progress bar
    :param form: a name in `FORMATS`; recognised by default
    :param options: keywords of the format's reader, such as `image_key` or `low` and `high`
    :return: the dataset
    :raises ValueError: data or options that cannot be used, or another dataset at `path`
    """
    return from_episodes(open_episodes(source, form, **options), path, progress_bar)


DOOR = """Convert `{form}` data into a dataset; an interrupted conversion continues.

:param source: the files: what `{reader}` takes
:param path: the folder of the dataset
:param progress_bar: show a progress bar
:param options: keywords of every format (`embodiment`, `task`, `rewards`, `image_size`, `crop`,
    `image_key`, `action_key`, `done_key`, `low`, `high`; see `Episodes`), `skip`, the numbers of
    episodes to leave out, and those of `{reader}`
:raises ValueError: data or options that cannot be used, or another dataset at `path`
"""


def _door(form: str) -> Callable[..., TrajectoryDataset]:
    def door(
        source: Source | SB3Buffer, path: Source, progress_bar: bool = False, **options: Any
    ) -> TrajectoryDataset:
        return convert(source, path, progress_bar, form, **options)

    door.__name__ = f"from_{form}"
    door.__qualname__ = f"TrajectoryDataset.{door.__name__}"
    door.__doc__ = DOOR.format(form=form, reader=FORMATS[form].__name__)
    return door


# The constructors of `TrajectoryDataset`, whose module cannot import this one.
TrajectoryDataset.of = staticmethod(open_dataset)
TrajectoryDataset.from_episodes = staticmethod(from_episodes)
for _form in FORMATS:
    setattr(TrajectoryDataset, f"from_{_form}", staticmethod(_door(_form)))
