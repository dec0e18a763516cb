"""Arrays of rows that are split into episodes, for HDF5, .npz and zarr files.

Row t holds observation t and the action taken at it, unless the file is in dm_env's convention
(`step_type`), where row t holds the action that *led to* observation t and an episode's first
action is a placeholder. The observation after an episode's last action exists only if there is also
an array `next_...` of images; without it that action is dropped, and no terminal state is seen.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from wpt_agents.data.importers import keys
from wpt_agents.data.importers.keys import Keys, Table, count, first

FIRST, LAST = 0, 2  # dm_env's step types


@dataclass(frozen=True)
class Cut:
    """The split of a table into episodes.

    :param bounds: the first row of each episode and one past its last
    :param shifted: whether row t holds the action that led to observation t
    :param left_out: the number of episodes that are too short to contain an action
    """

    bounds: tuple[tuple[int, int], ...]
    shifted: bool
    left_out: int


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
    names = [done_key] if done_key is not None else [n for n in keys.ENDS if n in table]
    if done_key is not None and done_key not in table:
        raise ValueError(f"there is no array {done_key!r}; there are: {', '.join(table)}")
    if not names:
        raise ValueError(
            "nothing says where episodes end: needs 'terminals', 'timeouts', 'terminations', "
            "'truncations', 'dones', 'step_type' or 'episode_ends', or done_key (--done-key); "
            f"there are: {', '.join(table)}"
        )
    ends = np.concatenate([_ends(np.ravel(table[name][:]), name, rows) for name in names])
    edges = np.unique(np.concatenate([[0], ends, [rows]]).astype(int)).tolist()
    if shifted is None:
        shifted = "step_type" in names and _first_actions_are_empty(table, columns, edges)
    # without a next image the outcome of an episode's last action is unknown
    shortest = 1 if columns.next_image and not shifted else 2
    bounds = tuple((a, b) for a, b in pairwise(edges) if b - a >= shortest)
    return Cut(bounds, shifted, len(edges) - 1 - len(bounds))


def _ends(flags: np.ndarray, name: str, rows: int) -> np.ndarray:
    """Return one past the last row of each episode."""
    if keys.leaf(name) == "episode_ends" or len(flags) != rows:
        if len(flags) and (np.any(np.diff(flags) <= 0) or flags[-1] > rows):
            raise ValueError(
                f"{name!r} has {len(flags)} entries for {rows} rows, and they are not the growing "
                "numbers at which episodes end"
            )
        return flags
    if keys.leaf(name) == "step_type":
        return np.flatnonzero(flags == LAST) + 1
    return np.flatnonzero(flags) + 1


def _first_actions_are_empty(table: Table, columns: Keys, edges: list[int]) -> bool:
    """Return whether every episode's first action is a placeholder, as in dm_env's convention."""
    action = read_actions(table, columns, 0, edges[-1])[edges[:-1]]
    if not np.nan_to_num(action).any():
        return True
    raise ValueError(
        "'step_type' comes from dm_env, where the action of a row led to its observation and the "
        "first action of an episode is zero, but here it is not: pass shifted=True if it did "
        "(--shifted), or shifted=False if the action was taken at the observation (--no-shifted)"
    )


def read_actions(table: Table, columns: Keys, start: int, stop: int) -> np.ndarray:
    """Return the actions of some rows, (stop - start, A); several arrays are concatenated."""
    if len(columns.actions) == 1:
        return np.asarray(table[columns.actions[0]][start:stop])
    parts = [np.asarray(table[name][start:stop]) for name in columns.actions]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def episode(
    table: Table, columns: Keys, start: int, stop: int, shifted: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, bool]:
    """Return images, actions, rewards and the terminal flag of some rows in our convention."""
    image = np.asarray(table[columns.image][start:stop])
    action = read_actions(table, columns, start, stop)
    reward = None if columns.reward is None else np.asarray(table[columns.reward][start:stop])
    if shifted:
        over = "discount" in table and not np.any(table["discount"][stop - 1 : stop])
        return image, action[1:], None if reward is None else reward[1:], over
    if columns.next_image is None:
        return image, action[:-1], None if reward is None else reward[:-1], False
    last = np.asarray(table[columns.next_image][stop - 1 : stop])
    flag = first(keys.TERMINAL, table)
    over = flag is not None and bool(np.any(table[flag][stop - 1 : stop]))
    return np.concatenate([image, last]), action, reward, over


def whole(
    table: Table, columns: Keys, where: str, shifted: bool | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, bool]:
    """Return the only episode of a table, with as many images as actions or one more."""
    rows = count(table[columns.actions[0]])
    images = count(table[columns.image])
    if images == rows + 1:
        reward: Any = None if columns.reward is None else np.asarray(table[columns.reward][:rows])
        flag = first(keys.TERMINAL, table)
        over = flag is not None and bool(np.any(table[flag][rows - 1 : rows]))
        image = np.asarray(table[columns.image][:])
        return image, read_actions(table, columns, 0, rows), reward, over
    if images != rows:
        raise ValueError(f"{where} has {rows} actions for {images} images")
    return episode(table, columns, 0, rows, bool(shifted))
