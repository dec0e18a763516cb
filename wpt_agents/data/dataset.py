"""D_off, the non-curated offline data: trajectories in a folder, read lazily.

Example::

    with TrajectoryDataset.create("walker") as dataset:
        dataset.append(Trajectory(image, action, embodiment="walker"))
    dataset = TrajectoryDataset.open("walker")
    batch = dataset.sample(16, 64)
"""

import hashlib
import os
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from wpt_agents.data.codecs import find_codec
from wpt_agents.data.importers.convert import Conversions
from wpt_agents.data.index import (
    Entry,
    Meta,
    add_damaged,
    create_folder,
    read_damaged,
    read_index,
    read_meta,
    undamaged,
)
from wpt_agents.data.shards import BLOCK, Writer, read_blocks, read_steps
from wpt_agents.data.trajectory import IMAGE_SIZE, Batch, Trajectory
from wpt_agents.data.windows import Piece, Windows, make_batch

T = TypeVar("T")


class Damage(NamedTuple):
    """A trajectory that cannot be read, and why."""

    trajectory: int
    reason: str


class _Part(Trajectory):
    """Some steps of a trajectory; the whole was checked when it was appended."""

    def __post_init__(self) -> None:
        pass


class TrajectoryDataset(Conversions):
    """Trajectories in a folder (see `wpt_agents.data.shards`); one writer, any number of readers.

    A reader sees the trajectories that were there when it opened the folder. Nothing but the index
    is held in memory.

    :param ids: where each trajectory stands in the folder, for a subset
    :param workers: threads that decompress; they pay only where cores are to spare
    """

    def __init__(
        self,
        path: Path,
        meta: Meta,
        entries: list[Entry],
        ids: Sequence[int] | None = None,
        workers: int = 0,
    ) -> None:
        self.path, self.workers = path, workers
        self._meta, self._entries, self._ids = meta, entries, ids
        self._whole: TrajectoryDataset | None = None
        self._writer: Writer | None = None
        self._windows: Windows | None = None
        self._pool: ThreadPoolExecutor | None = None
        self._pool_owner = 0

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        image_size: int = IMAGE_SIZE,
        codec: str = "zstd",
        workers: int = 0,
    ) -> "TrajectoryDataset":
        """Makes an empty dataset in a new or empty folder.

        :param codec: "zstd" (lossless, about a sixth of simulated images), "raw" or "jpeg" (lossy,
            about a fourth, for noisy images, as of cameras, which zstd does not halve)
        :raises ValueError: an unknown codec, or a folder with something in it
        """
        find_codec(codec)
        create_folder(Path(path), Meta(image_size, codec))
        return cls.open(path, workers)

    @classmethod
    def open(cls, path: str | os.PathLike[str], workers: int = 0) -> "TrajectoryDataset":
        """Opens a dataset, reading its index only, without the trajectories set aside.

        :raises ValueError: no dataset there, one of a newer version, or a damaged index
        """
        path = Path(path)
        meta = read_meta(path)
        find_codec(meta.codec)
        return cls(path, meta, undamaged(path, read_index(path)[0]), workers=workers)

    @classmethod
    def open_or_create(
        cls, path: str | os.PathLike[str], image_size: int = IMAGE_SIZE
    ) -> "TrajectoryDataset":
        """The dataset at `path` to go on with, or an empty one where none is yet.

        A `create` that was killed halfway is repeated.

        :raises ValueError: as `open` and `create`
        """
        there = (Path(path) / "meta.json").exists()
        return cls.open(path) if there else cls.create(path, image_size)

    @classmethod
    def merge(
        cls,
        path: str | os.PathLike[str],
        datasets: Sequence["TrajectoryDataset | str | os.PathLike[str]"],
        workers: int = 0,
    ) -> "TrajectoryDataset":
        """Makes a new dataset at `path` of all trajectories of `datasets`, in their order.

        Its codec is theirs, or "zstd" if they differ, so that nothing more is lost.

        :raises ValueError: no datasets, images of different sizes, a folder with something in it,
            or a damaged trajectory; those before it are kept
        """
        opened = [d if isinstance(d, TrajectoryDataset) else cls.open(d) for d in datasets]
        metas = {dataset._meta: dataset.path for dataset in opened}
        if len({meta.image_size for meta in metas}) != 1:
            found = ", ".join(f"{path} has {meta.image_size}" for meta, path in metas.items())
            raise ValueError(f"merge wants datasets of one image size: {found or 'none given'}")
        size, codecs = next(iter(metas)).image_size, {meta.codec for meta in metas}
        with cls.create(path, size, codecs.pop() if len(codecs) == 1 else "zstd") as merged:
            for dataset in opened:
                merged.extend(dataset)
        return cls.open(path, workers)

    def append(self, trajectory: Trajectory) -> None:
        """Adds a trajectory at the end. Once this returns, readers who open the folder see it.

        :raises ValueError: another image size, non-zero padding, a subset, or another writer
        """
        size = self._meta.image_size
        if trajectory.image.shape[1:3] != (size, size):
            raise ValueError(
                f"{self.path} holds images of {size} x {size}, got "
                f"{trajectory.image.shape[1]} x {trajectory.image.shape[2]}; resize them, or "
                "create a dataset with that image_size"
            )
        if trajectory.action[:, trajectory.action_dim :].any():
            raise ValueError(
                f"Actions past action_dim={trajectory.action_dim} must be zero; "
                f"give the true action_dim, of at most {trajectory.action.shape[1]}"
            )
        entry = self._begin().append(trajectory)  # which may replace the list of entries
        self._entries.append(entry)
        self._windows = None

    def extend(self, trajectories: Iterable[Trajectory]) -> None:
        """Adds trajectories one by one; what is added stays.

        Those of another dataset with the same codec are copied as they are stored, checked but not
        decoded.
        """
        if isinstance(trajectories, TrajectoryDataset) and trajectories._meta == self._meta:
            trajectories._copy_to(self)
        else:
            for trajectory in trajectories:
                self.append(trajectory)

    def _copy_to(self, other: "TrajectoryDataset") -> None:
        writer = other._begin()
        for i, entry in enumerate(list(self._entries)):
            try:
                blocks = list(read_blocks(self.path, entry, 0, len(entry.sizes) - 1))
            except OSError as error:
                raise self._damaged(i, error) from error
            other._entries.append(writer.copy(blocks, entry))
            other._windows = None

    def reserve(self) -> None:
        """Takes the right to write now, not at the first append; what others appended is seen.

        :raises ValueError: another writer is at work; a subset
        """
        self._begin()

    def _begin(self) -> Writer:
        """The right to write, taken at the first append; what others appended is seen then."""
        if self.is_subset:
            raise ValueError("A subset is read-only; append to the dataset it was taken from")
        if self._writer is None:
            self._writer = Writer(self.path, self._meta)
            self._entries = self._writer.entries
        return self._writer

    def flush(self) -> None:
        """Makes what was appended survive a power cut; a killed process loses nothing anyway."""
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        """Ends the appending and the threads; the dataset can still be read."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None
        if self._pool is not None:
            self._pool.shutdown()
            self._pool = None

    def __enter__(self) -> "TrajectoryDataset":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __len__(self) -> int:
        """The number of trajectories."""
        return len(self._entries)

    def __getitem__(self, i: int) -> Trajectory:
        """Trajectory `i`, whole, its actions `action_dim` wide.

        :raises ValueError: it is damaged
        """
        entry = self._entries[i]
        part, _, _ = self._read((i % len(self), 0, entry.length + 1))
        return Trajectory(**vars(part))

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[i] for i in range(len(self)))

    @property
    def lengths(self) -> np.ndarray:
        """(N,) int, the number of actions of each trajectory."""
        return np.array([entry.length for entry in self._entries], np.int64)

    @property
    def action_dims(self) -> np.ndarray:
        """(N,) int, the true action width of each trajectory."""
        return np.array([entry.action_dim for entry in self._entries], np.int64)

    @property
    def embodiments(self) -> list[str | None]:
        """The robots' names, None where unknown."""
        return [entry.embodiment for entry in self._entries]

    @property
    def tasks(self) -> list[str | None]:
        """What each behaviour was after, None where unknown."""
        return [entry.task for entry in self._entries]

    @property
    def sources(self) -> list[str | None]:
        """Where each trajectory comes from, None where unknown."""
        return [entry.source for entry in self._entries]

    @property
    def max_action_dim(self) -> int:
        """The widest embodiment's action width, 0 without trajectories."""
        return max((entry.action_dim for entry in self._entries), default=0)

    @property
    def image_size(self) -> int:
        """Height and width of the images."""
        return self._meta.image_size

    @property
    def lossless(self) -> bool:
        """Whether images are read as they were appended."""
        return find_codec(self._meta.codec).lossless

    @property
    def is_subset(self) -> bool:
        """Whether this is a view made by `subset`, be it of all trajectories in another order."""
        return self._ids is not None

    @property
    def fingerprint(self) -> str:
        """A hash of which trajectories these are, in which order; an index keeps its dataset's."""
        digest = hashlib.sha256()
        for e in self._entries:
            checksum = "" if e.checksum is None else f" {e.checksum}"
            digest.update(f"{e.shard} {e.at} {e.length} {e.blocks}{checksum}\n".encode())
        return digest.hexdigest()

    def subset(self, indices: Sequence[int] | np.ndarray) -> "TrajectoryDataset":
        """A read-only view of some trajectories, in the order given.

        :param indices: their numbers, or a mask: a bool for each trajectory
        :raises ValueError: a mask of another length
        """
        chosen = np.asarray(indices, None if len(indices) else int)
        if chosen.dtype == bool:
            if len(chosen) != len(self):
                raise ValueError(f"A mask of {len(chosen)} for {len(self)} trajectories")
            chosen = np.flatnonzero(chosen)
        entries = [self._entries[i] for i in chosen]
        ids = [self._id(i) for i in chosen]
        view = TrajectoryDataset(self.path, self._meta, entries, ids, self.workers)
        view._whole = self  # a temporary folder lasts as long as its dataset
        return view

    def first_observations(self, batch: int = 1024) -> Iterator[np.ndarray]:
        """The first image of every trajectory, in order: (n, 64, 64, 3) uint8 with n <= `batch`."""
        for at in range(0, len(self), batch):
            chunk = range(at, min(at + batch, len(self)))
            yield np.stack(list(self._each(self._first, chunk)))

    def _first(self, i: int) -> np.ndarray:
        return self._read((i, 0, 1))[0].image[0].copy()  # a view would keep its block

    def sample(
        self,
        batch_size: int,
        length: int,
        action_width: int | None = None,
        rng: np.random.Generator | None = None,
        share: slice = slice(None),
    ) -> Batch:
        """Windows drawn by the rule of `wpt_agents.data.windows`; nothing but `rng` decides which.

        :param action_width: how wide the batch's actions are; `max_action_dim` when not given
        :param rng: other windows at every call when not given
        :param share: which of the windows drawn are read
        :raises ValueError: an empty dataset, a damaged trajectory, or one with more actions than
            `action_width`
        """
        if not self._entries:
            raise ValueError(f"{self.path} holds no trajectory; append some before sampling")
        if self._windows is None:
            self._windows = Windows(self.lengths)
        rows = self._windows.draw(batch_size, length, rng or np.random.default_rng())[share]
        action_width = self.max_action_dim if action_width is None else action_width
        shape = (self.image_size, self.image_size, 3)
        return make_batch(rows, self._read, shape, action_width, self._each)

    def batches(
        self,
        batch_size: int,
        length: int,
        action_width: int,
        seed: int,
        purpose: int = 0,
        start: int = 0,
        ahead: int = 2,
        pin: bool = False,
        share: slice = slice(None),
    ) -> Generator[Batch, None, None]:
        """Batches without end, from number `start`; batch k depends on (seed, purpose, k) alone.

        :param purpose: another number for each use that shares the seed
        :param ahead: how many are prepared in the background
        :param pin: put them into pinned memory, from which a GPU copies while it computes
        :param share: which of each batch's rows are read, for one of several processes
        """

        def draw(k: int) -> Batch:
            rng = np.random.default_rng([seed, purpose, k])
            batch = self.sample(batch_size, length, action_width, rng, share)
            return batch.pin() if pin else batch

        with ThreadPoolExecutor(1, "batches") as pool:
            waiting = deque(pool.submit(draw, k) for k in range(start, start + ahead + 1))
            try:
                for k in count(start + ahead + 1):
                    yield waiting.popleft().result()
                    waiting.append(pool.submit(draw, k))
            finally:
                pool.shutdown(cancel_futures=True)

    def info(self) -> dict[str, Any]:
        """Counts, widths, lengths and how many bytes an image takes.

        `compression` is the ratio of the images' own size to what is stored, actions included.
        """
        stored = sum(sum(entry.sizes) for entry in self._entries)
        images = int(self.lengths.sum()) + len(self)
        return {
            "path": str(self.path),
            "trajectories": len(self),
            "transitions": images - len(self),
            "lengths": [int(self.lengths.min()), int(self.lengths.max())] if len(self) else [],
            "embodiments": dict(Counter(self.embodiments)),
            "action_dims": {int(k): n for k, n in Counter(self.action_dims).items()},
            "tasks": dict(Counter(self.tasks)),
            "with_reward": sum(entry.reward for entry in self._entries),
            "set_aside": len(read_damaged(self.path)),
            "image_size": self.image_size,
            "codec": self._meta.codec,
            "lossless": find_codec(self._meta.codec).lossless,
            "bytes": stored,
            "bytes_per_image": stored / images if images else 0.0,
            "compression": images * self.image_size**2 * 3 / stored if images else 1.0,
        }

    @property
    def appended(self) -> int:
        """How many trajectories were ever appended: those here, and those set aside."""
        return len(self) + len(read_damaged(self.path))

    def validate(self, progress_bar: bool = False, set_aside: bool = False) -> list[Damage]:
        """Reads every byte and names the trajectories that are damaged; [] if all is well.

        :param set_aside: leave the damaged ones out, here and for all who open the folder from now
            on; those behind them move up. The folder's damaged.json lists them; without that file
            they are back
        """
        from tqdm.auto import tqdm

        damaged = []
        with tqdm(total=len(self), desc="validate", disable=not progress_bar) as bar:
            for at in range(0, len(self), 256):
                for damage in self._each(self._damage, range(at, min(at + 256, len(self)))):
                    damaged += [damage] if damage is not None else []
                    bar.update()
        if set_aside and damaged:
            add_damaged(self.path, {self._entries[d.trajectory].place: d.reason for d in damaged})
            self._leave_out({d.trajectory for d in damaged})
        return damaged

    def _leave_out(self, gone: set[int]) -> None:
        keep = [i for i in range(len(self)) if i not in gone]
        self._entries = [self._entries[i] for i in keep]
        self._ids = None if self._ids is None else [self._ids[i] for i in keep]
        self._windows = None

    def _damage(self, i: int) -> Damage | None:
        try:
            self[i]
        except ValueError as error:
            return Damage(i, str(error))
        return None

    def _each(self, function: Callable[[int], T], items: Iterable[int]) -> Iterable[T]:
        if self.workers < 1:
            return map(function, items)
        if self._pool is None or self._pool_owner != os.getpid():  # threads do not survive a fork
            self._pool, self._pool_owner = ThreadPoolExecutor(self.workers, "dataset"), os.getpid()
        return self._pool.map(function, items)

    def _id(self, i: int) -> int:
        return int(i) % len(self) if self._ids is None else self._ids[i]

    def _read(self, piece: Piece) -> tuple[Trajectory, int, int]:
        """The blocks a piece lies in, as a trajectory, and the piece's place therein."""
        i, start, stop = piece
        entry = self._entries[i]
        first, last = max(start - 1, 0) // BLOCK, (stop - 1) // BLOCK  # with the reward before it
        try:
            image, action, reward = read_steps(self.path, self._meta, entry, first, last)
        except OSError as error:
            raise self._damaged(i, error) from error
        start, stop = start - first * BLOCK, stop - first * BLOCK
        part = _Part(
            image=image[:stop],
            action=action[: stop - 1],
            reward=None if reward is None else reward[: stop - 1],
            terminated=entry.terminated and piece[2] == entry.length + 1,
            action_dim=entry.action_dim,
            embodiment=entry.embodiment,
            task=entry.task,
            source=entry.source,
        )
        return part, start, stop

    def _damaged(self, i: int, error: OSError) -> ValueError:
        return ValueError(
            f"Trajectory {self._id(i)} of {self.path} is damaged: {error}. `validate` lists all "
            "that are, `validate(set_aside=True)` leaves them out"
        )
