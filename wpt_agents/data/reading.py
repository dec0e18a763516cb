"""Reading stored trajectories: by number, by sequence, or by batch."""

import errno
import hashlib
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Self, TypeVar

import numpy as np

from wpt_agents.data.codecs import find_codec
from wpt_agents.data.folder import Folder
from wpt_agents.data.index import Entry
from wpt_agents.data.threads import Threads, prefetched
from wpt_agents.data.trajectory import Batch, Trajectory
from wpt_agents.data.windows import Piece, Windows, make_batch

T = TypeVar("T")
# What says nothing about a file: too many open files, no permission, no memory.
OTHER_CAUSES = (errno.EMFILE, errno.ENFILE, errno.EACCES, errno.EPERM, errno.ENOMEM)
PAUSES = (1.0, 4.0, 15.0)  # seconds between attempts to read a folder that has disappeared


class StoredTrajectories:
    """Trajectories in one folder or several; only their index is kept in memory.

    :param folders: folders whose images all have the same size
    :param entries: the index's lines, in the order of the trajectories
    :param folder_of: for each trajectory, the number of its folder; all are in the first if None
    :param ids: the number of each trajectory in its own folder, for a read-only view
    :param workers: threads that decompress; they help only if there are idle cores
    """

    def __init__(
        self,
        folders: Sequence[Folder],
        entries: list[Entry],
        folder_of: Sequence[int] | None = None,
        ids: Sequence[int] | None = None,
        workers: int = 0,
    ) -> None:
        self._folders = list(folders)
        self._entries = entries
        self._folder_of = folder_of
        self._ids = ids
        self._whole: object = None  # what must stay alive: a temporary folder, a view's dataset
        self._windows: Windows | None = None
        self._backgrounds: dict[object, np.ndarray] = {}  # 12 kB for each trajectory seen
        self._threads = Threads(workers)

    def __len__(self) -> int:
        """The number of trajectories."""
        return len(self._entries)

    def __getitem__(self, i: int) -> Trajectory:
        """Return trajectory `i`, with actions of its true width.

        :raises ValueError: the trajectory is damaged
        """
        if isinstance(i, slice):
            raise TypeError("A dataset has no slices: use subset(range(...)) for several")
        entry = self._entries[i]
        part, _, _ = self._read((i % len(self), 0, entry.length + 1))
        return Trajectory(**vars(part))

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[i] for i in range(len(self)))

    @property
    def workers(self) -> int:
        """The number of threads that decompress."""
        return self._threads.workers

    @property
    def lengths(self) -> np.ndarray:
        """The number of actions of each trajectory, (N,) int."""
        return np.array([entry.length for entry in self._entries], np.int64)

    @property
    def action_dims(self) -> np.ndarray:
        """The true action width of each trajectory, (N,) int."""
        return np.array([entry.action_dim for entry in self._entries], np.int64)

    @property
    def embodiments(self) -> list[str | None]:
        """The robots' names, None where unknown."""
        return [entry.embodiment for entry in self._entries]

    @property
    def tasks(self) -> list[str | None]:
        """The task of each trajectory, None where unknown."""
        return [entry.task for entry in self._entries]

    @property
    def sources(self) -> list[str | None]:
        """Where each trajectory comes from, None where unknown."""
        return [entry.source for entry in self._entries]

    @property
    def bounds(self) -> list[list[list[float]] | None]:
        """The values that -1 and 1 stand for in each trajectory, [lowest, highest], or None."""
        return [entry.bounds for entry in self._entries]

    @property
    def max_action_dim(self) -> int:
        """The widest embodiment's action width, 0 without trajectories."""
        return max((entry.action_dim for entry in self._entries), default=0)

    @property
    def image_size(self) -> int:
        """Height and width of the images."""
        return self._folders[0].meta.image_size

    @property
    def lossless(self) -> bool:
        """Whether images are read exactly as they were appended."""
        return all(find_codec(folder.meta.codec).lossless for folder in self._folders)

    @property
    def is_subset(self) -> bool:
        """Whether this is a read-only view: a subset, or several datasets joined."""
        return self._ids is not None

    @property
    def fingerprint(self) -> str:
        """A hash of the trajectories and their order, by which a retrieval index is recognised."""
        digest = hashlib.sha256()
        for e in self._entries:
            # datasets of older versions have none, and keep their fingerprint
            checksum = "" if e.checksum is None else f" {e.checksum}"
            digest.update(f"{e.shard} {e.at} {e.length} {e.blocks}{checksum}\n".encode())
        return digest.hexdigest()

    def subset(self, indices: Sequence[int] | np.ndarray) -> Self:
        """Return a read-only view of some trajectories, in the order of `indices`.

        :param indices: the numbers of the trajectories, or a mask: a bool for each trajectory
        :raises ValueError: a mask of another length
        """
        chosen = np.asarray(indices, None if len(indices) else int)
        if chosen.dtype == bool:
            if len(chosen) != len(self):
                raise ValueError(f"A mask of {len(chosen)} for {len(self)} trajectories")
            chosen = np.flatnonzero(chosen)
        entries = [self._entries[i] for i in chosen]
        ids = [self._id(i) for i in chosen]
        of = None if self._folder_of is None else [self._folder_of[i] for i in chosen]
        view = type(self)(self._folders, entries, of, ids, self.workers)
        view._whole = self
        return view

    def first_observations(self, batch: int = 1024) -> Iterator[np.ndarray]:
        """Yield all first images, in order.

        :param batch: number of images at a time, at most
        :return: (n, S, S, 3) uint8 with n <= `batch`
        """
        for at in range(0, len(self), batch):
            chunk = range(at, min(at + batch, len(self)))
            yield np.stack(list(self._threads.map(self._first_image, chunk)))

    def images(self, i: int, times: Sequence[int]) -> np.ndarray:
        """Return images of a trajectory; only their blocks are read.

        :param i: the number of the trajectory
        :param times: n numbers of images, from 0 to T
        :return: (n, S, S, 3) uint8
        :raises ValueError: the trajectory is damaged
        """
        parts = [self._read((i, time, time + 1)) for time in times]
        return np.stack([part.image[start] for part, start, _ in parts])

    def _first_image(self, i: int) -> np.ndarray:
        image: np.ndarray = self._read((i, 0, 1))[0].image[0]
        return image.copy()  # a view would keep its whole block in memory

    def sample(
        self,
        batch_size: int,
        length: int,
        action_width: int | None = None,
        rng: np.random.Generator | None = None,
        share: slice = slice(None),
        mark: bool = False,
    ) -> Batch:
        """Draw a batch of sequences; all sequences of all trajectories are equally likely.

        :param batch_size: number of sequences
        :param length: number of images in a sequence
        :param action_width: width to which actions are padded; `max_action_dim` by default
        :param rng: source of the random numbers; by default, every call draws other sequences
        :param share: the rows that are read, for one of several processes
        :param mark: return a `MarkedBatch`; for this, each trajectory is read once as a whole
        :return: (B, T) sequences
        :raises ValueError: an empty dataset, a damaged trajectory, or one with more actions than
            `action_width`
        """
        if not self._entries:
            path = self._folders[0].path
            raise ValueError(f"{path} holds no trajectory; append some before sampling")
        if self._windows is None:
            self._windows = Windows(self.lengths)
        rows = self._windows.draw(batch_size, length, rng or np.random.default_rng())[share]
        action_width = self.max_action_dim if action_width is None else action_width
        shape = (self.image_size, self.image_size, 3)
        background = self._background if mark else None
        return make_batch(rows, self._read, shape, action_width, self._threads.map, background)

    def _background(self, i: int) -> np.ndarray:
        key = self._folder(i), self._entries[i].place  # numbers change when some are set aside
        if key not in self._backgrounds:
            self._backgrounds[key] = self[i].background
        return self._backgrounds[key]

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
        mark: bool = False,
    ) -> Generator[Batch, None, None]:
        """Yield batches without end; batch k depends on nothing but (seed, purpose, k).

        :param batch_size: number of sequences
        :param length: number of images in a sequence
        :param action_width: width to which actions are padded
        :param seed: seed of the random numbers
        :param purpose: a different number for each use that shares the seed
        :param start: the number of the first batch
        :param ahead: number of batches that are prepared in the background
        :param pin: copy the batches into pinned memory, from which a GPU copies while it computes
        :param share: the rows of each batch that are read, for one of several processes
        :param mark: yield batches that mark the pixels that move, `MarkedBatch`
        """

        def draw(k: int) -> Batch:
            rng = np.random.default_rng([seed, purpose, k])
            batch = self.sample(batch_size, length, action_width, rng, share, mark)
            return batch.pin() if pin else batch

        return prefetched(draw, start, ahead)

    def _folder(self, i: int) -> Folder:
        return self._folders[0 if self._folder_of is None else self._folder_of[i]]

    def _id(self, i: int) -> int:
        """Return the number of trajectory `i` in its own folder."""
        return int(i) % len(self) if self._ids is None else self._ids[i]

    def _read(self, piece: Piece) -> tuple[Trajectory, int, int]:
        """Read the blocks of a piece as a trajectory, and return the piece's place in it."""
        i, start, stop = piece
        return self._attempt(i, lambda folder, entry: folder.read(entry, start, stop))

    def _attempt(self, i: int, read: Callable[[Folder, Entry], T]) -> T:
        """Read from trajectory `i`, several times if its folder has disappeared.

        :raises ValueError: the trajectory is damaged
        :raises FileNotFoundError: the folder has disappeared and does not come back
        :raises OSError: the process may not read the file, or has too many files open
        """
        folder = self._folder(i)
        for pause in (*PAUSES, None):
            try:
                return read(folder, self._entries[i])
            except OSError as error:
                if error.errno in OTHER_CAUSES:
                    raise
                if error.errno != errno.ESTALE and folder.is_there():
                    raise self._damaged(i, error) from error
                if pause is None:
                    raise self._gone(folder, error) from error
                time.sleep(pause)
        raise AssertionError  # the last attempt returns or raises

    def _gone(self, folder: Folder, error: OSError) -> OSError:
        return FileNotFoundError(
            f"The dataset {folder.path} cannot be reached any more ({error}), also not after "
            f"{sum(PAUSES):g} seconds: bring it back, for example by mounting its disk, and start "
            "again; what was saved before continues from there"
        )

    def _damaged(self, i: int, error: OSError) -> ValueError:
        return ValueError(
            f"Trajectory {self._id(i)} of {self._folder(i).path} is damaged: {error}. `validate` "
            "lists all that are, `validate(set_aside=True)` leaves them out"
        )
