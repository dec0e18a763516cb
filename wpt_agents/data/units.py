"""The units of actions: from a robot's own values to [-1, 1], and whether data and task agree.

All actions of a dataset are in [-1, 1]. What -1 and 1 stand for, the *bounds*, is known for data of
formats that have an action space, or if the user passed `low` and `high`. Actions that were
imported without rescaling may be in other units: a gripper stored as 0 and 1 would be read as half
open and open. So the import warns of such data, and they are compared with the task's Box.
"""

import warnings
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gymnasium import spaces

from wpt_agents.data.trajectory import TOLERANCE, Trajectory

SMALL_PART = 0.2  # of [-1, 1]: a dimension that spans less than a tenth of it is questioned
ENOUGH = 20  # actions; the range of fewer says nothing


def both_limits(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the limits of the actions as arrays, or None if neither is set.

    :raises ValueError: one without the other, or a lowest value above the highest
    """
    if low is None and high is None:
        return None
    if low is None or high is None:
        raise ValueError(
            f"low and high, the limits of the actions, belong together; got low={low} and "
            f"high={high}"
        )
    least = np.atleast_1d(np.asarray(low, np.float64))
    most = np.atleast_1d(np.asarray(high, np.float64))
    comparable = least.shape == most.shape or 1 in (least.size, most.size)
    if comparable and (least > most).any():
        i = int(np.flatnonzero(least > most)[0])
        raise ValueError(f"low is above high in dimension {i}, {low} and {high}; exchange them")
    return least, most


def rescaled(action: np.ndarray, low: Any, high: Any) -> np.ndarray:
    """Map actions from [low, high] to [-1, 1] and clip them; 0 where low and high are equal.

    :param action: (T, A)
    :param low: (A,)
    :param high: (A,)
    :return: (T, A)
    """
    low = np.asarray(low, np.float64)
    high = np.asarray(high, np.float64)
    if action.ndim != 2 or action.shape[1:] != low.shape or low.shape != high.shape:
        raise ValueError(
            f"actions of shape {action.shape} with low of {low.shape} and high of {high.shape} are "
            "not continuous actions (T, A) with a lowest and a highest value for each of the A"
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"the actions' limits {low} to {high} are not finite; pass low and high")
    width = np.where(high > low, high - low, 1.0)
    scaled = np.where(high > low, 2 * (action - low) / width - 1, 0.0)
    return np.clip(scaled, -1, 1).astype(np.float32)


def _row(numbers: Sequence[float] | np.ndarray) -> str:
    return f"[{', '.join(f'{number:.4g}' for number in numbers)}]"


class Ranges:
    """The least and greatest action in each dimension, of data whose units are unknown."""

    def __init__(self) -> None:
        self._ranges: dict[int, tuple[int, np.ndarray, np.ndarray]] = {}

    def add(self, trajectory: Trajectory) -> None:
        """Add a trajectory, unless its bounds are known."""
        if trajectory.bounds is not None:
            return
        action = trajectory.action[:, : trajectory.action_dim]
        count, least, most = self._ranges.get(
            trajectory.action_dim, (0, action.min(0), action.max(0))
        )
        least, most = np.minimum(least, action.min(0)), np.maximum(most, action.max(0))
        self._ranges[trajectory.action_dim] = count + len(action), least, most

    def warn(self, name: object) -> None:
        """Warn of dimensions that never leave [0, 1], or fill a small part of [-1, 1]."""
        for width, (count, least, most) in sorted(self._ranges.items()):
            odd = (least >= 0) | (most - least < SMALL_PART)
            if count < ENOUGH or not odd.any():
                continue
            which = ", ".join(f"{i} ({least[i]:.3g} to {most[i]:.3g})" for i in np.flatnonzero(odd))
            warnings.warn(
                f"{name}: the actions were not rescaled, but of {width} dimensions these never "
                f"leave [0, 1] or fill a small part of [-1, 1]: {which}. If they are in the "
                "environment's own units, import them with the limits of its action space, "
                "low=[...] and high=[...] (--low, --high); low=-1 and high=1 confirm that they are "
                "right",
                stacklevel=3,
            )


def compare_units(dataset: Any, box: spaces.Box, embodiment: str | None = None) -> None:
    """Warn if the data's actions are known to be in other units than the task's Box.

    :param dataset: a TrajectoryDataset, of which only trajectories with actions as wide as the Box
        count
    :param box: the task's action space
    :param embodiment: a robot's name; if there is one, only its trajectories and those without a
        name count
    """
    width = box.shape[0]
    different: dict[tuple[tuple[float, ...], ...], int] = {}
    for bounds, dim, name in zip(
        dataset.bounds, dataset.action_dims, dataset.embodiments, strict=True
    ):
        if bounds is None or dim != width or (embodiment and name not in (None, embodiment)):
            continue
        # low=-1 and high=1 is how users say that their actions need no conversion
        in_no_units = np.array_equal(bounds, [[-1] * width, [1] * width])
        if not in_no_units and not np.allclose(bounds, [box.low, box.high], rtol=1e-3, atol=1e-3):
            key = tuple(tuple(float(x) for x in row) for row in bounds)
            different[key] = different.get(key, 0) + 1
    if different:
        low, high = max(different, key=lambda key: different[key])
        warnings.warn(
            f"Data and task have different units: in {sum(different.values())} trajectories of the "
            f"dataset, -1 and 1 stand for {_row(low)} and {_row(high)}, in the "
            f"task for {_row(box.low)} and {_row(box.high)}. The same action then means another "
            "motion. If it is the same robot, import the data again with low and high of the task",
            stacklevel=3,
        )


def in_units_of(trajectories: Iterable[Trajectory], box: spaces.Box) -> Iterator[Trajectory]:
    """Yield the trajectories with their actions in the units of a task, [-1, 1] over its Box.

    Only actions of unknown units are touched, and of them only dimensions that were evidently
    stored in the Box's own units: the Box has no negative values, and neither have the data, which
    would never use the lower half of the Box if they were in [-1, 1].
    """
    trajectories = list(trajectories)
    dims = _dimensions_of_box([t for t in trajectories if _unknown(t, box)], box)
    if dims.any():
        which = ", ".join(f"{i} ({box.low[i]:.4g} to {box.high[i]:.4g})" for i in dims.nonzero()[0])
        warnings.warn(
            "The data's actions are taken to be in the environment's own units, and rescaled, in "
            f"these dimensions, where they are never negative: {which}. Import the data with low "
            "and high to decide this (low=-1 and high=1 if they are in [-1, 1] already)",
            stacklevel=3,
        )
    for trajectory in trajectories:
        if not dims.any() or not _unknown(trajectory, box):
            yield trajectory
            continue
        action = trajectory.action.copy()
        unpadded = action[:, : trajectory.action_dim]
        unpadded[:, dims] = rescaled(unpadded[:, dims], box.low[dims], box.high[dims])
        yield replace(trajectory, action=action)


def _unknown(trajectory: Trajectory, box: spaces.Box) -> bool:
    return trajectory.bounds is None and trajectory.action_dim == box.shape[0]


def _dimensions_of_box(trajectories: Sequence[Trajectory], box: spaces.Box) -> np.ndarray:
    """Return which dimensions of actions were stored in the Box's own units, (A,) bool."""
    if sum(len(t) for t in trajectories) < ENOUGH:
        return np.zeros(box.shape[0], bool)
    action = np.concatenate([t.action[:, : t.action_dim] for t in trajectories])
    least, most = action.min(0), action.max(0)
    inside = (least >= box.low - TOLERANCE) & (most <= box.high + TOLERANCE)
    positive = (box.low >= 0) & (box.high > box.low) & (least >= 0)
    return np.asarray(inside & positive)
