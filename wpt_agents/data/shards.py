"""The shards of a dataset: written trajectory by trajectory, read block by block.

::

    index.jsonl       see `wpt_agents.data.index`
    shard-00000.bin   blocks of 16 steps, compressed separately, each followed by its CRC-32

A block holds the images of 16 steps, then the actions taken at them, then their rewards. A line is
appended to the index after its blocks are on the disk. So a writer that is killed at any moment
leaves at most blocks without a line, which the next writer removes. Only one writer can have the
lock; readers need none.
"""

import os
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from io import FileIO
from pathlib import Path

import numpy as np

from wpt_agents.data.codecs import find_codec
from wpt_agents.data.index import Entry, Meta, read_index, undamaged
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.files.archive import sync_folder
from wpt_agents.files.locks import lock, unlock

BLOCK = 16  # steps; longer blocks compress little better and make sequences read more in vain
SHARD_BYTES = 256 * 2**20  # a new file is begun at this size; a trajectory is never divided


def read_blocks(path: Path, entry: Entry, first: int, last: int) -> Iterator[memoryview]:
    """Yield the stored blocks `first` to `last` (inclusive), with their CRC-32.

    :raises OSError: a block that cannot be read or does not match its checksum
    """
    sizes = entry.sizes
    name = f"shard-{entry.shard:05d}.bin"
    with FileIO(path / name) as file:
        file.seek(entry.at + sum(sizes[:first]))
        # One read for all blocks, which are adjacent.
        data = memoryview(_read(file, sum(sizes[first : last + 1])))
    at, checksum = 0, 0
    for block in range(first, last + 1):
        stored = data[at : at + sizes[block]]
        at += sizes[block]
        if len(stored) < sizes[block] or zlib.crc32(stored[:-4]) != int.from_bytes(stored[-4:]):
            raise OSError(f"block {block} of {name} is cut short or does not match its checksum")
        # of the blocks' checksums: cheap, and tells trajectories apart
        checksum = zlib.crc32(stored[-4:], checksum)
        yield stored
    all_read = first == 0 and last + 1 == len(sizes)
    if all_read and entry.checksum is not None and checksum != entry.checksum:
        raise OSError(f"{name} holds another trajectory than the index names there")


def read_steps(
    path: Path, meta: Meta, entry: Entry, first: int, last: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Read images, actions and rewards of the blocks `first` to `last` (inclusive).

    :raises OSError: a block that cannot be read or does not match its checksum
    """
    parts = [
        _decode(stored[:-4], meta, entry, first + i)
        for i, stored in enumerate(read_blocks(path, entry, first, last))
    ]
    image, action, reward = (np.concatenate(part) for part in zip(*parts, strict=True))
    return image, action, reward if entry.reward else None


def _encode(trajectory: Trajectory, meta: Meta) -> Iterator[bytes]:
    for at in range(0, len(trajectory.image), BLOCK):
        steps = slice(at, at + BLOCK)
        vector = trajectory.action[steps, : trajectory.action_dim].tobytes()
        if trajectory.reward is not None:
            vector += trajectory.reward[steps].tobytes()
        block = find_codec(meta.codec).encode(trajectory.image[steps], vector)
        yield block + zlib.crc32(block).to_bytes(4)


def _decode(
    block: memoryview, meta: Meta, entry: Entry, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    images = min(BLOCK, entry.length + 1 - number * BLOCK)
    actions = min(BLOCK, entry.length - number * BLOCK)
    size, wide = meta.image_size, entry.action_dim
    behind = 4 * actions * (wide + entry.reward)
    data = find_codec(meta.codec).decode(block, behind)
    if len(data) != images * size * size * 3 + behind:
        raise OSError(f"block {number} does not hold {images} images of {size} x {size} pixels")
    image = np.frombuffer(data, np.uint8, images * size * size * 3)
    vector = np.frombuffer(data, np.float32, offset=image.nbytes)
    return (
        image.reshape(images, size, size, 3),
        vector[: actions * wide].reshape(actions, wide),
        vector[actions * wide :],
    )


class Writer:
    """Appends trajectories to a folder; it holds the write lock until it is closed.

    :ivar entries: the trajectories that existed when the writer was made
    :raises ValueError: another writer is at work, or a damaged index
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self._path, self._meta = path, meta
        # Unbuffered, so that a line is in the file when `_write` returns, and not later.
        self._index = FileIO(path / "index.jsonl", "rb+")
        try:
            lock(self._index.fileno())
            entries, end = read_index(path)
            self.entries = undamaged(path, entries)
            # Half a line, or blocks without a line, are what a killed writer left.
            self._index.truncate(end)
            self._index.seek(end)
            self._number, self._end = 0, 0
            if entries:
                self._number, self._end = entries[-1].shard, entries[-1].at + sum(entries[-1].sizes)
            self._shard = self._open_shard(self._number, self._end)
        except BlockingIOError as error:
            self._index.close()
            raise ValueError(
                f"{path} is being written to by another process; wait for it"
            ) from error
        except BaseException:
            self._index.close()
            raise

    def append(self, trajectory: Trajectory) -> Entry:
        """Write the blocks, then the line; a failure halfway leaves the dataset unchanged."""
        labels = Entry(
            shard=0,
            at=0,
            blocks="",
            length=len(trajectory),
            action_dim=trajectory.action_dim,
            reward=trajectory.reward is not None,
            terminated=trajectory.terminated,
            embodiment=trajectory.embodiment,
            task=trajectory.task,
            source=trajectory.source,
            bounds=None if trajectory.bounds is None else trajectory.bounds.tolist(),
        )
        return self._add(_encode(trajectory, self._meta), labels)

    def copy(self, blocks: Iterable[bytes | memoryview], entry: Entry) -> Entry:
        """Add a trajectory of another folder with the same Meta, from its stored blocks."""
        return self._add(blocks, entry)

    def _add(self, blocks: Iterable[bytes | memoryview], labels: Entry) -> Entry:
        if self._end >= SHARD_BYTES:
            shard = self._open_shard(self._number + 1, 0)
            self._shard.close()
            self._shard, self._number, self._end = shard, self._number + 1, 0
        line_at = self._index.tell()
        try:
            sizes, checksum = list[int](), 0
            for block in blocks:
                sizes.append(_write(self._shard.fileno(), block))
                checksum = zlib.crc32(block[-4:], checksum)
            # A line promises that its blocks are on the disk, so they go first.
            os.fsync(self._shard.fileno())
            entry = replace(
                labels,
                shard=self._number,
                at=self._end,
                blocks=" ".join(map(str, sizes)),
                checksum=checksum,
            )
            _write(self._index.fileno(), entry.line())
        except BaseException:
            for file, end in ((self._index, line_at), (self._shard, self._end)):
                file.truncate(end)
                file.seek(end)
            raise
        self._end += sum(sizes)
        return entry

    def flush(self) -> None:
        """Flush the index to the disk, so that appended trajectories survive a power failure."""
        os.fsync(self._index.fileno())

    def close(self) -> None:
        """Release the write lock."""
        self.flush()
        self._shard.close()
        unlock(self._index.fileno())
        self._index.close()

    def _open_shard(self, number: int, end: int) -> FileIO:
        file = FileIO(self._path / f"shard-{number:05d}.bin", "ab")
        try:
            file.truncate(end)
            sync_folder(self._path)
        except BaseException:
            file.close()
            raise
        return file


def _read(file: FileIO, size: int) -> bytes:
    data = file.read(size)
    # Linux reads at most 2 GiB at once, and a network disk may read less.
    while len(data) < size and (more := file.read(size - len(data))):
        data += more
    return data


def _write(descriptor: int, data: bytes | memoryview) -> int:
    rest = memoryview(data)
    while rest:  # a full disk takes a part of the data, then raises
        rest = rest[os.write(descriptor, rest) :]
    return len(data)
