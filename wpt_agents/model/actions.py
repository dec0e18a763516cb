"""Actions between the agent's [-1, 1] and the bounds of an environment."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces


def to_bounds(action: np.ndarray, space: spaces.Box) -> np.ndarray:
    """Map [-1, 1] onto the bounds of a Box; whole numbers are rounded.

    :param action: (n, A) in [-1, 1], where A is at least the width of the Box; further entries are
        padding
    :return: (n, width) of the dtype of the Box
    """
    low, high = space.low, space.high
    whole = np.issubdtype(space.dtype, np.integer)
    if whole:  # in int8, 127 - (-128) would overflow
        low, high = low.astype(np.float64), high.astype(np.float64)
    action = action[:, : len(low)].clip(-1, 1)
    action = low + 0.5 * (action + 1) * (high - low)
    if whole:  # cutting off the fraction would reach the highest value at 1.0 alone
        action = np.rint(action)
    return action.clip(low, high).astype(space.dtype)  # rounding may overstep


def space_as_dict(space: spaces.Box) -> dict[str, Any]:
    """Return the bounds and the dtype of a Box in the form in which a model file stores them."""
    return {"low": space.low.tolist(), "high": space.high.tolist(), "dtype": space.dtype.name}


def space_from_dict(fields: Mapping[str, Any]) -> spaces.Box:
    """Make the Box that `space_as_dict` described; files of version 0.1 lack the dtype."""
    dtype = np.dtype(fields.get("dtype", "float32"))
    low, high = np.array(fields["low"], dtype), np.array(fields["high"], dtype)
    return spaces.Box(low, high, dtype=dtype.type)
