"""The usual names of arrays in files, and the lookup of a user's key."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

IMAGES = ("observations", "observation", "obs", "images", "image", "pixels", "img")
ACTIONS = ("actions", "action")
REWARDS = ("rewards", "reward")
# The flags that mark an episode's last action.
TERMINAL = ("terminals", "terminations", "terminated", "terminal")  # the task ended
TIMEOUT = ("timeouts", "truncations", "truncated", "timeout")  # the time limit was reached
EITHER = ("dones", "done")
ENDS = (*TERMINAL, *TIMEOUT, *EITHER, "step_type", "episode_ends")
# The camera names of known programs. The user names any others.
CAMERAS = re.compile(r"(observations/images/.*|obs/.*_(image|rgb)|(img|camera_?\d+(_rgb)?))")
MAIN_CAMERAS = ("agentview_image", "agentview_rgb")  # robomimic's and LIBERO's view of the scene
ENCODED = (b"\xff\xd8", b"\x89PNG")  # the first bytes of JPEG and PNG files

Table = Mapping[str, Any]  # arrays by name: of NumPy, h5py or zarr


@dataclass(frozen=True)
class Keys:
    """The names of the arrays that make up an episode."""

    image: str
    actions: tuple[str, ...]
    reward: str | None
    next_image: str | None
    terminal: str | None  # the flag that marks a terminal state
    others: tuple[str, ...] = field(default=(), compare=False)  # cameras that were not chosen


def leaf(name: str) -> str:
    """Return the last part of a path."""
    return name.rsplit("/", 1)[-1]


def match(key: str, names: Iterable[str]) -> str | None:
    """Return the name that `key` refers to: itself, or the only name that ends with it."""
    names = list(names)
    if key in names:
        return key
    ending = [n for n in names if n.endswith("/" + key) and not n.startswith("next_")]
    return ending[0] if len(ending) == 1 else None


def first(words: Iterable[str], names: Iterable[str]) -> str | None:
    """Return the first of `words` that is a name."""
    names = set(names)
    return next((word for word in words if word in names), None)


def count(array: Any) -> int:
    """Return the number of rows; some libraries' arrays do not support `len`."""
    return int(array.shape[0]) if array.shape else 0


def is_images(array: Any) -> bool:
    """Return whether an array holds images: (N, H, W, C), (N, C, H, W), grayscale, or encoded."""
    dims = len(array.shape)
    return dims == 4 or (dims == 3 and array.dtype == np.uint8) or is_encoded(array)


def is_colour(array: Any) -> bool:
    """Return whether an array of images is one of colour images, not of depths or masks."""
    return is_encoded(array) or (len(array.shape) == 4 and 3 in (array.shape[1], array.shape[3]))


def is_encoded(array: Any) -> bool:
    """Return whether each row is a PNG or JPEG file: bytes, or (N, L) uint8 padded with zeros."""
    dims = len(array.shape)
    by_row = (dims == 2 and array.dtype == np.uint8) or (dims == 1 and array.dtype.kind in "OSV")
    return by_row and count(array) > 0 and as_bytes(array[:1][0]).startswith(ENCODED)


def as_bytes(row: Any) -> bytes:
    """Return an encoded image as bytes; anything else becomes no bytes."""
    if isinstance(row, np.ndarray | np.void):
        return row.tobytes()
    return row if isinstance(row, bytes) else b""


def find_keys(
    table: Table,
    image_key: str | None,
    action_keys: tuple[str, ...],
    terminal_key: str | None = None,
) -> Keys:
    """Find images, actions and rewards by the user's keys, or by the usual words.

    :param terminal_key: the flag that marks a terminal state
    :raises ValueError: if they are missing or ambiguous; lists the arrays
    """
    try:
        image, others = _find_images(table, image_key)
    except ValueError as error:
        # Unusual names of actions hide the episodes' groups, and with them the images.
        try:
            find_actions(table, action_keys)
        except ValueError as missing:
            raise ValueError(f"{error}. Besides, {missing}") from error
        raise
    terminal = first(TERMINAL, table) if terminal_key is None else match(terminal_key, table)
    if terminal_key is not None and terminal is None:
        raise ValueError(f"there is no array {terminal_key!r}; there are: {', '.join(table)}")
    head, _, tail = image.partition("/")
    next_image = f"next_{head}/{tail}" if tail else f"next_{head}"
    return Keys(
        image,
        find_actions(table, action_keys),
        first(REWARDS, table),
        next_image if next_image in table else None,
        terminal,
        others,
    )


def find_actions(table: Table, action_keys: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of the action arrays, in the order of the keys.

    :raises ValueError: if one is missing; suggests similar names
    """
    if not action_keys:
        name = first(ACTIONS, table)
        if name is None:
            parts = [n for n in table if re.match(r"actions?([/_]|$)", n)]
            what = f"pass action_key, one or several of: {', '.join(parts or table)}"
            raise ValueError(f"there is no array 'actions' or 'action'; {what} (--action-key)")
        return (name,)
    names = [match(key, table) for key in action_keys]
    if None in names:
        missing = action_keys[names.index(None)]
        raise ValueError(f"there is no array {missing!r} of actions; there are: {', '.join(table)}")
    return tuple(name for name in names if name is not None)


def _find_images(table: Table, image_key: str | None) -> tuple[str, tuple[str, ...]]:
    pictures = [name for name, array in table.items() if is_images(array)]
    pictures = [name for name in pictures if not name.startswith("next_")]
    there = f"there are images in: {', '.join(pictures)}" if pictures else "there are no images"
    ask = f"{there}; pass image_key (--image-key)" if pictures else f"{there}; render the states"
    if image_key is not None:
        name = match(image_key, table)
        if name is None:
            raise ValueError(f"needs an array {image_key!r}; there are: {', '.join(table)}; {ask}")
        return name, ()
    # the usual names come first; cameras are searched only if there is none
    name = first(IMAGES, table)
    if name is not None and (name in pictures or name not in IMAGES[:3] or not pictures):
        return name, ()
    if name is not None:
        array = table[name]
        raise ValueError(f"{name!r} is {array.shape} {array.dtype}, not images; {ask}")
    cameras = [name for name in pictures if CAMERAS.fullmatch(name)]
    main = [name for name in cameras if leaf(name) in MAIN_CAMERAS]
    for choice in (cameras, main):
        if len(choice) == 1:
            colour = [name for name in pictures if is_colour(table[name])]
            return choice[0], tuple(name for name in colour if name != choice[0])
    raise ValueError(f"the images have no usual name; {ask}" if pictures else ask)


def natural(name: object) -> list[tuple[int, str | int]]:
    """Return a sort key that puts demo_2 before demo_10."""
    parts = re.split(r"(\d+)", str(name))
    return [(1, int(part)) if part.isdigit() else (0, part) for part in parts]


def by_group(table: Table, action_keys: tuple[str, ...]) -> tuple[dict[str, Table], list[str]]:
    """Find the groups that are one episode each, such as data/demo_0.

    One of them has a name that ends with a number; the others are beside it, as data/demo_1 is.

    :return: the groups with actions, in numeric order, and the names of those with images alone
    """
    leaves = [leaf(key) for key in action_keys] or list(ACTIONS)

    def acts(group: Table) -> bool:
        return any(leaf(name) in leaves or name.split("/")[0] in leaves for name in group)

    numbered = _grouped(table, r"((?:[^/]*\D/)*[^/]*\d)/(.+)")
    parents = {group.rpartition("/")[0] for group, arrays in numbered.items() if acts(arrays)}
    groups: dict[str, dict[str, Any]] = {}
    for parent in parents:
        start = re.escape(f"{parent}/" if parent else "")
        groups |= _grouped(table, rf"({start}[^/]+)/(.+)")
    names = sorted(groups, key=natural)
    idle = [n for n in names if not acts(groups[n]) and any(map(is_images, groups[n].values()))]
    return {name: groups[name] for name in names if acts(groups[name])}, idle


def _grouped(table: Table, pattern: str) -> dict[str, dict[str, Any]]:
    """Return the arrays of each group, by the pattern of the group's name and of an array in it."""
    groups: dict[str, dict[str, Any]] = {}
    for name, array in table.items():
        matched = re.match(pattern, name)
        if matched:
            groups.setdefault(matched[1], {})[matched[2]] = array
    return groups


def within(key: str, groups: Iterable[str]) -> str:
    """Remove the episode's group from a key: a key for demo_0 applies to all episodes."""
    return next((key[len(g) + 1 :] for g in groups if key.startswith(g + "/")), key)
