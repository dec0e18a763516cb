"""The index of a dataset's folder: its fixed properties, its trajectories, and the damaged ones.

::

    meta.json      kind, version, image size, codec; written once
    index.jsonl    one line per trajectory: CRC-32, then JSON; written after its blocks
    damaged.json   the places of trajectories that `validate` has set aside, if there are any

The index is only ever appended to. Deleting damaged.json brings back the trajectories it names.
"""

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

from wpt_agents.files.archive import replacing

KIND, VERSION = "wpt_agents.TrajectoryDataset", 1
CONVERT_LOCK = "convert.lock"  # an empty file, locked by the process that converts into a cache

Place = tuple[int, int]  # shard and offset, by which a trajectory is identified permanently


@dataclass(frozen=True)
class Meta:
    """The properties that are fixed when a dataset is created."""

    image_size: int
    codec: str


@dataclass(slots=True)
class Entry:
    """A trajectory's line in the index.

    :param blocks: the blocks' sizes in bytes, separated by spaces, because parsing 60,000 JSON
        lists would take a second
    :param checksum: CRC-32 of the blocks' own; None in datasets of older versions
    :param bounds: lowest and highest values of the actions in the robot's own units, if known
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
    checksum: int | None = None
    bounds: list[list[float]] | None = None

    @property
    def place(self) -> Place:
        """Where the trajectory begins."""
        return self.shard, self.at

    @property
    def sizes(self) -> list[int]:
        """The blocks' sizes in bytes."""
        return [int(size) for size in self.blocks.split()]

    def line(self) -> bytes:
        """The entry as a line of the index."""
        known = {k: v for k, v in asdict(self).items() if v is not None and v is not False}
        record = json.dumps(known, separators=(",", ":")).encode()
        return b"%08x %s\n" % (zlib.crc32(record), record)


def create_folder(path: Path, meta: Meta) -> None:
    """Create an empty dataset.

    :raises ValueError: an image size that is not positive, or a folder that is not empty
    """
    if not 0 < meta.image_size:
        raise ValueError(f"image_size must be positive, got {meta.image_size}")
    path.mkdir(parents=True, exist_ok=True)
    if not all(_left_by_create(file) for file in path.iterdir()):
        raise ValueError(
            f"{path} is not empty; open a dataset that is there with TrajectoryDataset.open, "
            "or create one in another folder"
        )
    (path / "index.jsonl").touch()
    with replacing(path / "meta.json") as temporary:
        head = {"kind": KIND, "version": VERSION, **asdict(meta)}
        temporary.write_text(json.dumps(head), encoding="utf-8")


def _left_by_create(file: Path) -> bool:
    """Return whether the file may be left over from a `create_folder` that was killed."""
    empty = file.name in ("index.jsonl", CONVERT_LOCK) and file.stat().st_size == 0
    return empty or file.name.startswith(".meta.json.tmp-")


def read_meta(path: Path) -> Meta:
    """Read the dataset's fixed properties.

    :raises ValueError: no dataset there, or one of a newer version
    """
    try:
        meta = json.loads((path / "meta.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError, json.JSONDecodeError) as error:
        state = f"damaged ({error})" if isinstance(error, json.JSONDecodeError) else "missing"
        what = f"is not a dataset: meta.json is {state}" if path.exists() else "does not exist"
        raise ValueError(
            f"{path} {what}. A dataset is a folder made by TrajectoryDataset.create, or by "
            "`python -m wpt_agents.zoo collect` or `import`"
        ) from None
    if not isinstance(meta, dict) or meta.get("kind") != KIND:
        raise ValueError(f"{path} is not a dataset: meta.json does not say {KIND!r}")
    if meta["version"] > VERSION:
        raise ValueError(
            f"{path} is a dataset of version {meta['version']}, this program reads up to "
            f"{VERSION}; update wpt_agents"
        )
    return Meta(meta["image_size"], meta["codec"])


def read_index(path: Path) -> tuple[list[Entry], int]:
    """Read all entries whose line is complete, and the offset at which the last one ends.

    :raises ValueError: no index, a complete line that does not match its checksum, or lines that
        are repeated or out of order
    """
    if not (path / "index.jsonl").exists():
        raise ValueError(f"{path} has lost its index.jsonl; restore the file")
    data = (path / "index.jsonl").read_bytes()
    # what follows is half a line of a writer at work, or of a killed one
    end = data.rfind(b"\n") + 1
    lines = data[:end].split(b"\n")[:-1]
    for i, line in enumerate(lines):
        if line[:8] != b"%08x" % zlib.crc32(line[9:]):
            raise ValueError(
                f"{path / 'index.jsonl'} is damaged in line {i + 1} (trajectory {i}); "
                "restore the file, or delete that line to go on without the trajectory"
            )
    records = json.loads(b"[" + b",".join(line[9:] for line in lines) + b"]")
    entries = [Entry(**record) for record in records]
    for i, (before, after) in enumerate(pairwise(entries), 1):
        if after.place <= before.place:  # each trajectory is written behind the one before
            raise ValueError(
                f"{path / 'index.jsonl'} is damaged: line {i + 1} is a repetition or out of "
                "order; restore the file, or delete repeated lines and restore the order"
            )
    return entries, end


def read_damaged(path: Path) -> dict[Place, str]:
    """Read the places of the trajectories that were set aside, with the reasons.

    :raises ValueError: the list itself is damaged
    """
    try:
        items = json.loads((path / "damaged.json").read_text(encoding="utf-8"))
        return {(item["shard"], item["at"]): item["reason"] for item in items}
    except FileNotFoundError:
        return {}
    except (json.JSONDecodeError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path / 'damaged.json'} is damaged ({error!r}); delete it and let "
            "validate(set_aside=True) write it again"
        ) from error


def add_damaged(path: Path, places: Mapping[Place, str]) -> None:
    """Set trajectories aside: readers who open the folder from now on do not see them."""
    known = {**read_damaged(path), **places}
    items = [{"shard": k[0], "at": k[1], "reason": known[k]} for k in sorted(known)]
    with replacing(path / "damaged.json") as temporary:
        temporary.write_text(json.dumps(items, indent=1), encoding="utf-8")


def undamaged(path: Path, entries: Sequence[Entry]) -> list[Entry]:
    """Return the entries that were not set aside."""
    damaged = read_damaged(path)
    return [entry for entry in entries if entry.place not in damaged]
