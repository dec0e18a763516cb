"""Operations on a whole dataset: describe it, and find damaged trajectories."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from wpt_agents.data.bars import StageBar
from wpt_agents.data.codecs import find_codec
from wpt_agents.data.folder import Folder
from wpt_agents.data.index import Entry, read_damaged


class Damage(NamedTuple):
    """A trajectory that cannot be read, and why."""

    trajectory: int
    reason: str


def count_set_aside(folders: Sequence[Folder]) -> int:
    """Return the number of trajectories that `validate(set_aside=True)` has left out."""
    return sum(len(read_damaged(folder.path)) for folder in folders)


def describe(folders: Sequence[Folder], entries: Sequence[Entry]) -> dict[str, Any]:
    """Count trajectories, widths, lengths and the bytes that an image takes.

    `compression` is the ratio of the raw size of the images to the stored size, which includes
    actions and rewards.
    """
    stored = sum(sum(entry.sizes) for entry in entries)
    lengths = [entry.length for entry in entries]
    images, size = sum(lengths) + len(entries), folders[0].meta.image_size
    codecs = sorted({folder.meta.codec for folder in folders})
    return {
        "path": ", ".join(str(folder.path) for folder in folders),
        "trajectories": len(entries),
        "transitions": images - len(entries),
        "lengths": [min(lengths), max(lengths)] if entries else [],
        "embodiments": dict(Counter(entry.embodiment for entry in entries)),
        "action_dims": dict(Counter(entry.action_dim for entry in entries)),
        "tasks": dict(Counter(entry.task for entry in entries)),
        "with_reward": sum(entry.reward for entry in entries),
        "set_aside": count_set_aside(folders),
        "image_size": size,
        "codec": ", ".join(codecs),
        "lossless": all(find_codec(codec).lossless for codec in codecs),
        "bytes": stored,
        "bytes_per_image": stored / images if images else 0.0,
        "compression": images * size**2 * 3 / stored if images else 1.0,
    }


def find_damage(
    check: Callable[[int], str | None],
    count: int,
    apply: Callable[[Callable[[int], str | None], Iterable[int]], Iterable[str | None]],
    progress_bar: bool,
) -> list[Damage]:
    """Read trajectories 0 .. `count - 1` and list the damaged ones.

    :param check: reads a trajectory by its number and returns what is wrong with it, or None
    :param count: the number of trajectories
    :param apply: `map`, or that of a thread pool
    """
    damaged = []
    with StageBar(count, "validate", progress_bar) as bar:
        for at in range(0, count, 256):  # in chunks, so that a thread pool does not queue them all
            chunk = range(at, min(at + 256, count))
            for i, reason in zip(chunk, apply(check, chunk), strict=True):
                damaged += [Damage(i, reason)] if reason is not None else []
                bar.update()
    return damaged
