"""The folder a dataset is kept in: written trajectory by trajectory, read block by block.

::

    meta.json         kind, version, image size, codec; written once
    index.jsonl       a line a trajectory: CRC-32, then JSON; one exists once its line does
    shard-00000.bin   blocks of 16 steps, each compressed by itself and followed by its CRC-32

A block holds the images of 16 steps, then the actions taken at them, then their rewards. A line is
appended after its blocks are on the disk, so a writer killed at any moment leaves at most bytes
that no line speaks of, and the next writer removes them. A writer excludes others; readers need
no lock.
"""

import json
import os
import zlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from wpt_agents.archive import replacing, sync_folder
from wpt_agents.trajectory import Trajectory

KIND, VERSION = "wpt_agents.TrajectoryDataset", 1
BLOCK = 16  # steps; longer compresses little better and makes a window's edges dearer
SHARD_BYTES = 256 * 2**20
CODECS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "zstd": (
        lambda data: zstandard.ZstdCompressor(level=3).compress(data),
        lambda data: zstandard.ZstdDecompressor().decompress(data),
    ),
    "raw": (lambda data: data, lambda data: data),
}


@dataclass(frozen=True)
class Meta:
    """What is fixed when a dataset is made."""

    image_size: int
    codec: str


@dataclass(slots=True)
class Entry:
    """A trajectory's line in the index.

    :param blocks: the blocks' sizes in bytes, in words: parsing 60,000 lists would take a second
    """

    shard: int
    at: int
    blocks: str
    length: int
    action_dim: int
    reward: bool = False
    terminated: bool = False
    embodiment: str | None = None
    task: str | None = None
    source: str | None = None

    @property
    def size(self) -> int:
        """How many bytes of its shard the trajectory takes."""
        return sum(map(int, self.blocks.split()))

    def line(self) -> bytes:
        """The entry as the index holds it."""
        known = {k: v for k, v in asdict(self).items() if v is not None and v is not False}
        record = json.dumps(known, separators=(",", ":")).encode()
        return b"%08x %s\n" % (zlib.crc32(record), record)


def create_folder(path: Path, meta: Meta) -> None:
    """Makes an empty dataset.

    :raises ValueError: an unknown codec, or a folder with something in it
    """
    if meta.codec not in CODECS:
        raise ValueError(f"No codec {meta.codec!r}. There are: {', '.join(sorted(CODECS))}")
    if not 0 < meta.image_size:
        raise ValueError(f"image_size must be positive, got {meta.image_size}")
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise ValueError(
            f"{path} is not empty; open a dataset that is there with TrajectoryDataset.open, "
            "or create one in another folder"
        )
    (path / "index.jsonl").touch()
    with replacing(path / "meta.json") as temporary:
        temporary.write_text(json.dumps({"kind": KIND, "version": VERSION, **asdict(meta)}))


def read_meta(path: Path) -> Meta:
    """The dataset's fixed properties.

    :raises ValueError: no dataset there, or one of a newer version
    """
    try:
        meta = json.loads((path / "meta.json").read_text())
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError) as error:
        what = "is not a dataset" if path.exists() else "does not exist"
        raise ValueError(
            f"{path} {what} ({error}); make one with TrajectoryDataset.create"
        ) from error
    if not isinstance(meta, dict) or meta.get("kind") != KIND:
        raise ValueError(f"{path} is not a dataset: meta.json does not say {KIND!r}")
    if meta["version"] > VERSION:
        raise ValueError(
            f"{path} is a dataset of version {meta['version']}, this program reads up to "
            f"{VERSION}; upgrade wpt-agents"
        )
    return Meta(meta["image_size"], meta["codec"])


def read_index(path: Path) -> tuple[list[Entry], int]:
    """All trajectories whose line is complete, and where the last complete line ends.

    :raises ValueError: no index, or a complete line that does not match its checksum
    """
    if not (path / "index.jsonl").exists():
        raise ValueError(f"{path} has lost its index.jsonl; restore the file")
    data = (path / "index.jsonl").read_bytes()
    end = data.rfind(b"\n") + 1
    lines = data[:end].split(b"\n")[:-1]
    for i, line in enumerate(lines):
        if line[:8] != b"%08x" % zlib.crc32(line[9:]):
            raise ValueError(
                f"{path / 'index.jsonl'} is damaged in line {i + 1} (trajectory {i}); "
                "restore the file, or delete that line to go on without the trajectory"
            )
    records = json.loads(b"[" + b",".join(line[9:] for line in lines) + b"]")
    return [Entry(**record) for record in records], end


def read_steps(
    path: Path, meta: Meta, entry: Entry, first: int, last: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """The images, actions and rewards of the blocks `first` to `last`, `last` included.

    :raises OSError: a block that cannot be read or does not match its checksum
    """
    sizes = [int(size) for size in entry.blocks.split()]
    name = f"shard-{entry.shard:05d}.bin"
    with FileIO(path / name) as file:
        file.seek(entry.at + sum(sizes[:first]))
        data = memoryview(file.read(sum(sizes[first : last + 1])))
    parts, at = [], 0
    for block in range(first, last + 1):
        stored = data[at : at + sizes[block]]
        at += sizes[block]
        if len(stored) < sizes[block] or zlib.crc32(stored[:-4]) != int.from_bytes(stored[-4:]):
            raise OSError(f"block {block} of {name} is cut short or does not match its checksum")
        parts.append(_decode(stored[:-4], meta, entry, block))
    image, action, reward = (np.concatenate(part) for part in zip(*parts, strict=True))
    return image, action, reward if entry.reward else None


def _encode(trajectory: Trajectory, meta: Meta) -> Iterator[bytes]:
    compress = CODECS[meta.codec][0]
    for at in range(0, len(trajectory.image), BLOCK):
        steps = slice(at, at + BLOCK)
        streams = [trajectory.image[steps], trajectory.action[steps, : trajectory.action_dim]]
        if trajectory.reward is not None:
            streams.append(trajectory.reward[steps])
        block = compress(b"".join(np.ascontiguousarray(s).tobytes() for s in streams))
        yield block + zlib.crc32(block).to_bytes(4)


def _decode(
    block: memoryview, meta: Meta, entry: Entry, number: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    data = CODECS[meta.codec][1](block)
    images = min(BLOCK, entry.length + 1 - number * BLOCK)
    actions = min(BLOCK, entry.length - number * BLOCK)
    size, wide = meta.image_size, entry.action_dim
    image = np.frombuffer(data, np.uint8, images * size * size * 3)
    vector = np.frombuffer(data, np.float32, offset=image.nbytes)
    return (
        image.reshape(images, size, size, 3),
        vector[: actions * wide].reshape(actions, wide),
        vector[actions * wide :],
    )


class Writer:
    """Appends trajectories to a folder; one at a time has the right to.

    :ivar entries: the index, as it is on the disk
    :raises ValueError: another writer is at work
    """

    def __init__(self, path: Path, meta: Meta) -> None:
        self._path, self._meta = path, meta
        self._index = FileIO(path / "index.jsonl", "rb+")
        try:
            _lock(self._index.fileno())
        except BlockingIOError as error:
            self._index.close()
            raise ValueError(f"{path} is being written to by someone else; wait for it") from error
        self.entries, end = read_index(path)
        self._index.truncate(end)
        self._index.seek(end)
        self._number = max((entry.shard for entry in self.entries), default=0)
        self._end = max((e.at + e.size for e in self.entries if e.shard == self._number), default=0)
        self._shard = self._open_shard()

    def append(self, trajectory: Trajectory) -> Entry:
        """Writes the blocks, then the line; what fails halfway leaves the dataset as it was."""
        if self._end >= SHARD_BYTES:
            self._shard.close()
            self._number, self._end = self._number + 1, 0
            self._shard = self._open_shard()
        line_at = self._index.tell()
        try:
            blocks = [_write(self._shard.fileno(), b) for b in _encode(trajectory, self._meta)]
            os.fsync(self._shard.fileno())
            entry = self._entry(trajectory, " ".join(map(str, blocks)))
            _write(self._index.fileno(), entry.line())
        except BaseException:
            for file, end in ((self._shard, self._end), (self._index, line_at)):
                file.truncate(end)
                file.seek(end)
            raise
        self._end += sum(blocks)
        self.entries.append(entry)
        return entry

    def flush(self) -> None:
        """Makes what was appended survive a power cut."""
        os.fsync(self._index.fileno())

    def close(self) -> None:
        """Gives the right to write back."""
        self.flush()
        self._shard.close()
        self._index.close()

    def _open_shard(self) -> FileIO:
        path = self._path / f"shard-{self._number:05d}.bin"
        file = FileIO(path, "ab")
        file.truncate(self._end)
        sync_folder(self._path)
        return file

    def _entry(self, trajectory: Trajectory, blocks: str) -> Entry:
        return Entry(
            shard=self._number,
            at=self._end,
            blocks=blocks,
            length=len(trajectory),
            action_dim=trajectory.action_dim,
            reward=trajectory.reward is not None,
            terminated=trajectory.terminated,
            embodiment=trajectory.embodiment,
            task=trajectory.task,
            source=trajectory.source,
        )


def _write(descriptor: int, data: bytes) -> int:
    rest = memoryview(data)
    while rest:  # a disk that fills up takes a part, then raises
        rest = rest[os.write(descriptor, rest) :]
    return len(data)


def _lock(descriptor: int) -> None:
    import fcntl  # the kernel takes the lock back when the writer dies

    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
