"""Arrays of rows that are split into episodes, for HDF5, .npz and zarr files.

Row t holds observation t and the action taken at it, unless the file is in the convention of dm_env
(`step_type`) or Dreamer (`is_first`, `reset`), where row t holds the action that *led to*
observation t and an episode's first action is a placeholder. The observation after an episode's
last action exists only if there is also an array `next_...` of images, or one image more than
actions; without it that action is dropped, and no terminal state is seen.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from wpt_agents.data.importers import keys
from wpt_agents.data.importers.keys import Keys, Table, count, first

FIRST, LAST = 0, 2  # dm_env's step types
MARKS = ("step_type", "is_first", "reset")  # of files whose actions led to their observation
CHUNK = 64  # images that are read at once
EXAMINED = 100  # episodes whose first actions are read

Pieces = Sequence[tuple[Any, int, int]]  # arrays of images, and the rows to take of them


@dataclass(frozen=True)
class Cut:
    """The split of a table into episodes.

    :param bounds: the first row of each episode and one past its last
    :param shifted: whether row t holds the action that led to observation t
    :param left_out: the number of episodes that are too short to contain an action
    :param doubtful: whether `shifted` is False although each episode begins with a zero action
    """

    bounds: tuple[tuple[int, int], ...]
    shifted: bool
    left_out: int
    doubtful: bool


def length(table: Table, columns: Keys) -> int:
    """Return the number of rows, which is the number of actions.

    :raises ValueError: if the numbers of images and actions differ
    """
    rows = count(table[columns.actions[0]])
    images = count(table[columns.image])
    if rows != images:
        raise ValueError(
            f"{columns.actions[0]!r} has {rows} rows and {columns.image!r} {images}; "
            "in files of many episodes they must be equally many"
        )
    return rows


def cut(table: Table, columns: Keys, done_key: str | None, shifted: bool | None) -> Cut:
    """Find the ends of episodes by the user's key or the usual flags.

    :raises ValueError: if there is no such flag, or the timing of `step_type` is ambiguous
    """
    rows = length(table, columns)
    names = _flags(table, done_key)
    begins = starts(table, rows)
    if not names and not len(begins):
        raise ValueError(
            "nothing says where episodes end: needs 'terminals', 'timeouts', 'terminations', "
            "'truncations', 'dones', 'step_type' or 'episode_ends', or done_key (--done-key); "
            f"there are: {', '.join(table)}. If these rows are one episode, add the array "
            f"episode_ends = [{rows}] to the file"
        )
    # A recorder that was stopped leaves episodes without an end, before the start of the next.
    ends = np.concatenate([begins, *(_ends(np.ravel(table[n][:]), n, rows) for n in names)])
    # Flags leave an unfinished episode at the end; numbers name all episodes.
    if not names or any(_is_flag(table[name], name, rows) for name in names):
        ends = np.append(ends, rows)
    elif rows > (last := int(ends.max(initial=0))):
        warnings.warn(
            f"The {rows - last} rows after the last of {names[0]!r} belong to no episode, and are "
            "left out",
            stacklevel=5,
        )
    edges = np.unique(np.append(0, ends).astype(int)).tolist()
    doubtful = False
    if shifted is None:
        empty, acts = _beginnings(table, columns, edges[:-1])
        shifted = _led_to(table, empty)
        doubtful = empty and acts and not shifted
    # without a next image the outcome of an episode's last action is unknown
    shortest = 1 if columns.next_image and not shifted else 2
    bounds = tuple((a, b) for a, b in pairwise(edges) if b - a >= shortest)
    return Cut(bounds, shifted, len(edges) - 1 - len(bounds), doubtful)


def starts(table: Table, rows: int) -> np.ndarray:
    """Return the rows that are marked as the first of an episode, if the first row is."""
    marked = [np.zeros(0, int)]
    for name in MARKS:
        if name in table and count(table[name]) == rows:
            marks = np.ravel(table[name][:])
            first_rows = np.flatnonzero(marks == FIRST if name == "step_type" else marks)
            marked += [first_rows] if 0 in first_rows else []
    return np.concatenate(marked)


def is_one_episode(table: Table, columns: Keys, done_key: str | None) -> bool:
    """Return whether there is one more image than actions, and no flag before the end."""
    rows = count(table[columns.actions[0]])
    if count(table[columns.image]) != rows + 1:
        return False
    flags = {name: np.ravel(table[name][:]) for name in _flags(table, done_key)}
    return not any((_flagged(array, name) < rows).any() for name, array in flags.items())


def _flags(table: Table, done_key: str | None) -> list[str]:
    """Return the names of the flags that mark the ends of episodes.

    :raises ValueError: if the user's is not there
    """
    if done_key is None:
        return [name for name in keys.ENDS if name in table]
    if done_key not in table:
        raise ValueError(f"there is no array {done_key!r}; there are: {', '.join(table)}")
    return [done_key]


def _ends(flags: np.ndarray, name: str, rows: int) -> np.ndarray:
    """Return one past the last row of each episode."""
    if not _is_flag(flags, name, rows):
        if len(flags) and (np.any(np.diff(flags) <= 0) or flags[-1] > rows):
            raise ValueError(
                f"{name!r} has {len(flags)} entries for {rows} rows, and they are not the growing "
                "numbers at which episodes end"
            )
        return flags
    return _flagged(flags, name)


def _is_flag(array: Any, name: str, rows: int) -> bool:
    """Return whether an array has a flag for each row, instead of the numbers of last rows."""
    return keys.leaf(name) != "episode_ends" and count(array) == rows


def _flagged(flags: np.ndarray, name: str) -> np.ndarray:
    """Return one past each flagged row."""
    if keys.leaf(name) == "episode_ends":
        return flags
    return np.flatnonzero(flags == LAST if keys.leaf(name) == "step_type" else flags) + 1


def _beginnings(table: Table, columns: Keys, starts: list[int]) -> tuple[bool, bool]:
    """Return whether all first actions of episodes are zero or NaN, and whether second are not.

    :param starts: the first row of each episode
    """
    pairs = [read_actions(table, columns, row, row + 2) for row in starts[:EXAMINED]]
    if any(pair.dtype.kind not in "fiub" for pair in pairs):
        return False, False  # no numbers, which are refused later
    empty = not any(np.nan_to_num(pair[:1]).any() for pair in pairs)
    return empty, any(np.nan_to_num(pair[1:]).any() for pair in pairs)


def _led_to(table: Table, empty: bool) -> bool:
    """Return whether the action of a row led to its observation, if the user has not decided.

    :param empty: whether the first actions of episodes are zero, as placeholders are
    """
    mark = first(MARKS, table)
    problem = None
    if mark == "step_type" and not empty:
        problem = "is zero, but here it is not"
    elif mark is not None and mark != "step_type" and not np.any(table[mark][:]):
        problem = f"is zero, but no row is marked as the first: these are parts ({mark})"
    if problem is not None:
        raise ValueError(
            f"{mark!r} comes from dm_env or Dreamer, where the action of a row led to its "
            f"observation and the first action of an episode {problem}: pass shifted=True if it "
            "did (--shifted), or shifted=False if the action was taken at the observation "
            "(--no-shifted)"
        )
    return empty and mark is not None


def between_images(
    actions: Sequence[np.ndarray], images: int, shifted: bool | None, name: str
) -> slice:
    """Return the rows of the actions between the images of an episode whose actions led to images.

    Row t holds the action that led to image t, and the first one is a placeholder, unless there is
    an action fewer than images, or the user has decided otherwise.

    :param shifted: what the user has decided, if anything
    :raises ValueError: if the first action should be a placeholder but is not
    """
    if len(actions[0]) < images:
        return slice(0, images - 1)
    if shifted is None and any(np.nan_to_num(np.asarray(action[0])).any() for action in actions):
        raise ValueError(
            f"{name}: in this format the action of a row led to its image, and the first action of "
            "an episode is zero or NaN, but here it is not: pass shifted=True if it did "
            "(--shifted), or shifted=False if the action was taken at the image (--no-shifted)"
        )
    return slice(0, images - 1) if shifted is False else slice(1, None)


def read_actions(table: Table, columns: Keys, start: int, stop: int) -> np.ndarray:
    """Return the actions of some rows, (stop - start, A); several arrays are concatenated."""
    if len(columns.actions) == 1:
        return np.asarray(table[columns.actions[0]][start:stop])
    parts = [np.asarray(table[name][start:stop]) for name in columns.actions]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def read_images(pieces: Pieces, convert: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Return the images of an episode, read and converted in parts, as they may be large.

    :param convert: n images -> (n, S, S, 3) uint8
    """
    parts = []
    for array, start, stop in pieces:
        # A compressed chunk, of HDF5 or zarr, is decompressed for each access to it.
        rows = max(CHUNK, (getattr(array, "chunks", None) or (0,))[0])
        for at in range(start, stop, rows):
            parts.append(convert(np.asarray(array[at : min(at + rows, stop)])))
    if not parts:
        raise ValueError("there are no images")
    return np.concatenate(parts)


def episode(
    table: Table, columns: Keys, start: int, stop: int, shifted: bool
) -> tuple[Pieces, np.ndarray, np.ndarray | None, bool]:
    """Return images, actions, rewards and the terminal flag of some rows in our convention."""
    image = [(table[columns.image], start, stop)]
    action = read_actions(table, columns, start, stop)
    reward = None if columns.reward is None else np.asarray(table[columns.reward][start:stop])
    if shifted:
        over = _is_flagged(table, columns, stop - 1)
        if "discount" in table:
            over = not np.any(table["discount"][stop - 1 : stop])
        elif "is_terminal" in table:
            over = bool(np.any(table["is_terminal"][stop - 1 : stop]))
        return image, action[1:], None if reward is None else reward[1:], over
    if columns.next_image is None:
        return image, action[:-1], None if reward is None else reward[:-1], False
    image.append((table[columns.next_image], stop - 1, stop))
    return image, action, reward, _is_flagged(table, columns, stop - 1)


def _is_flagged(table: Table, columns: Keys, row: int) -> bool:
    """Return whether a row is marked as leading to a terminal state."""
    return columns.terminal is not None and bool(np.any(table[columns.terminal][row : row + 1]))


def whole(
    table: Table, columns: Keys, shifted: bool | None
) -> tuple[Pieces, np.ndarray, np.ndarray | None, bool]:
    """Return the only episode of a table, with as many images as actions or one more."""
    rows = count(table[columns.actions[0]])
    images = count(table[columns.image])
    if images == rows + 1:
        reward: Any = None if columns.reward is None else np.asarray(table[columns.reward][:])
        flags = 0 if columns.terminal is None else count(table[columns.terminal])
        over = _is_flagged(table, columns, flags - 1)  # there may be a flag for each image
        image = [(table[columns.image], 0, images)]
        return image, read_actions(table, columns, 0, rows), reward, over
    if images != rows:
        raise ValueError(f"{rows} actions for {images} images")
    if shifted is None:
        shifted = _led_to(table, _beginnings(table, columns, [0])[0])
    return episode(table, columns, 0, rows, shifted)
