"""Stored trajectories, batches for the RSSM, and the conversion between their timings.

A stored trajectory has Gymnasium's timing: T actions, T rewards, T + 1 images. Action t was taken
at image t, brought reward t and led to image t + 1::

    image   o_0      o_1      o_2   ...  o_T
    action      a_0      a_1        ...
    reward      r_0      r_1        ...

A batch pairs each image with what *led to* it, because h_t = f(h_{t-1}, z_{t-1}, a_{t-1})::

    image       o_0      o_1      o_2   ...
    action      0        a_0      a_1   ...
    reward      0        r_0      r_1   ...
    is_first    True     False    False ...
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

IMAGE_SIZE = 64  # pixels, as in the paper and in every Dreamer
GLANCES = 51  # images of a trajectory that its background is the median of
MOVED = 20  # grey levels of 255 by which a pixel that moves differs from the background
TOLERANCE = 1e-5  # by which an action may overstep a limit, from rounding
# the arrays of a batch, by the names of its fields
STREAMS = ("image", "action", "reward", "is_first", "is_terminal", "reward_known")


@dataclass(frozen=True, repr=False)
class Trajectory:
    """One episode. Action t was taken at image t, brought reward t and led to image t + 1.

    :param image: (T + 1, H, W, 3) uint8
    :param action: (T, A) float32 in [-1, 1], as wide as the embodiment or padded with zeros
    :param reward: (T,) float32, None in reward-free data
    :param terminated: whether the last image is a terminal state (a time limit is not)
    :param action_dim: the embodiment's true action width; A by default
    :param embodiment: the robot's name, if known
    :param task: the task of the behaviour, if known
    :param source: where the trajectory comes from, in words
    :param bounds: (2, action_dim), the values in the robot's own units that -1 and 1 stand for,
        or None if they are unknown
    :raises ValueError: a wrong shape or dtype, NaN or infinity, an action outside [-1, 1]
    """

    image: np.ndarray
    action: np.ndarray
    reward: np.ndarray | None = None
    terminated: bool = False
    action_dim: int = 0
    embodiment: str | None = None
    task: str | None = None
    source: str | None = None
    bounds: np.ndarray | None = None

    def __post_init__(self) -> None:
        image, action = np.asarray(self.image), np.asarray(self.action)
        reward = self.reward
        if reward is not None:
            with np.errstate(over="ignore"):  # to infinity, which is refused below
                reward = np.asarray(reward).astype(np.float32)
        if image.ndim != 4 or image.shape[-1] != 3 or image.dtype != np.uint8:
            remedy = ""
            if image.ndim == 4 and image.dtype.kind == "f":
                white = 255 if (image > 1).any() else 1
                scaled = "image" if white == 255 else "255 * image"
                remedy = f"; np.rint({scaled}).astype(np.uint8) if {white} is white"
            elif image.ndim == 4 and image.shape[1] == 3:
                remedy = "; image.transpose(0, 2, 3, 1)"
            raise ValueError(
                f"Trajectory.image must be (T + 1, H, W, 3) uint8, got {image.shape} {image.dtype}"
                f"{remedy}"
            )
        if action.ndim != 2 or len(action) != len(image) - 1 or action.size == 0:
            raise ValueError(
                f"Trajectory.action must be (T, A) with T = {len(image) - 1} >= 1 for "
                f"{len(image)} images, got {action.shape}"
            )
        if action.dtype.kind not in "fiub":
            raise ValueError(f"Trajectory.action must be numbers, got {action.dtype}")
        check_range(action)
        if reward is not None and (reward.shape != (len(action),) or not np.isfinite(reward).all()):
            odd = reward[~np.isfinite(reward)]
            raise ValueError(
                f"Trajectory.reward must be finite and of shape ({len(action)},), got "
                f"{reward.shape}{f' with {len(odd)} of {odd[0]}' if len(odd) else ''}; pass None "
                "when rewards are unknown"
            )
        if not 0 <= self.action_dim <= action.shape[1]:
            raise ValueError(f"action_dim {self.action_dim} exceeds the width {action.shape[1]}")
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "action", np.asarray(action, np.float32))
        object.__setattr__(self, "action_dim", int(self.action_dim) or action.shape[1])
        if self.bounds is not None:
            bounds = np.asarray(self.bounds, np.float64)
            if bounds.shape != (2, self.action_dim):
                raise ValueError(
                    f"Trajectory.bounds must be (2, {self.action_dim}), lowest and highest value "
                    f"of each action, got {bounds.shape}"
                )
            object.__setattr__(self, "bounds", bounds)
        for name in ("embodiment", "task", "source"):
            if (label := getattr(self, name)) is not None:  # a Path or bytes, for example
                label = label.decode() if isinstance(label, bytes) else str(label)
                object.__setattr__(self, name, label)
        object.__setattr__(self, "terminated", bool(self.terminated))
        object.__setattr__(self, "reward", reward)

    def __len__(self) -> int:
        """The number of actions, T."""
        return len(self.action)

    @cached_property
    def background(self) -> np.ndarray:
        """The background: the median of 51 evenly spaced images, (H, W, 3) uint8."""
        times = np.linspace(0, len(self.image) - 1, min(GLANCES, len(self.image))).round()
        median: np.ndarray = np.median(self.image[times.astype(int)], 0)
        return median.astype(np.uint8)

    def __repr__(self) -> str:
        """A summary without the pixels."""
        names = f"embodiment={self.embodiment!r}, task={self.task!r}"
        rewards = "known" if self.reward is not None else None
        return f"Trajectory(T={len(self)}, {names}, action_dim={self.action_dim}, reward={rewards})"


def check_range(action: np.ndarray) -> None:
    """Raise a ValueError for actions outside [-1, 1], with their range and the remedy.

    :param action: (T, A)
    :raises ValueError: an action that is not finite, or is outside [-1, 1]
    """
    check_finite(action)
    # as floats: the int8 -128 has no absolute value in int8
    least, most = action.min(0).astype(float), action.max(0).astype(float)
    if max(-least.min(), most.max()) > 1 + TOLERANCE:
        i = int(np.argmax(np.maximum(-least, most)))
        low, high = (",".join(f"{x:.4g}" for x in row) for row in (least, most))
        raise ValueError(
            f"Trajectory.action must be in [-1, 1], but dimension {i} runs from {least[i]:.4g} to "
            f"{most[i]:.4g}: rescale it, 2 * (action - low) / (high - low) - 1, by the low and "
            f"high of the environment's action space. An importer does that by low=[{low}], "
            f"high=[{high}], or wider (--low={low} --high={high})"
        )


def check_finite(action: np.ndarray) -> None:
    """Raise a ValueError for actions that are NaN or infinite.

    :param action: (T, A)
    :raises ValueError: an action that is not finite; the message names the first one
    """
    if not np.isfinite(action).all():
        t, i = np.argwhere(~np.isfinite(action))[0]
        raise ValueError(
            f"Trajectory.action must be finite and in [-1, 1], but action {t} is {action[t, i]} in "
            f"dimension {i}; leave that episode out"
        )


@dataclass(frozen=True)
class Batch:
    """(B, T) sequences as the RSSM takes them: each image with the action and reward before it.

    :param image: (B, T, 64, 64, 3) uint8
    :param action: (B, T, A) float32, the action that led to `image`; zeros where `is_first` and in
        the padding
    :param reward: (B, T) float32, the reward of the action that led to `image`; 0 where unknown
    :param is_first: (B, T) bool, where the recurrent state and the previous action are reset
    :param is_terminal: (B, T) bool, whether the image is a terminal state
    :param reward_known: (B, T) bool, where the reward head may learn
    """

    image: Tensor
    action: Tensor
    reward: Tensor
    is_first: Tensor
    is_terminal: Tensor
    reward_known: Tensor

    def __post_init__(self) -> None:
        shapes = {f.name: tuple(getattr(self, f.name).shape[:2]) for f in fields(self)}
        assert len(set(shapes.values())) == 1, shapes

    def to(self, device: torch.device | str) -> "Batch":
        """Return the batch on `device`; from pinned memory, the copy is asynchronous."""
        pinned = self.image.is_pinned()
        return replace(
            self,
            **{f.name: getattr(self, f.name).to(device, non_blocking=pinned) for f in fields(self)},
        )

    def split(self, parts: int) -> list["Batch"]:
        """Split the rows, in their order, into `parts` batches of equally many rows."""
        rows, left = divmod(len(self.image), parts)
        assert left == 0, (len(self.image), parts)
        streams = {f.name: getattr(self, f.name).split(rows) for f in fields(self)}
        rows_of = [{name: stream[i] for name, stream in streams.items()} for i in range(parts)]
        return [replace(self, **row) for row in rows_of]

    def pin(self) -> "Batch":
        """Return the batch in pinned memory."""
        return replace(self, **{f.name: getattr(self, f.name).pin_memory() for f in fields(self)})


@dataclass(frozen=True)
class MarkedBatch(Batch):
    """A batch that marks moving pixels, which differ from their trajectory's background.

    :param moving: (B, T, 64, 64) bool
    """

    moving: Tensor


def moving_pixels(image: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Return where images differ from a background by more than 20 of 255 in some colour.

    :param image: (..., H, W, 3) uint8
    :param background: (H, W, 3) uint8
    :return: (..., H, W) bool
    """
    difference = np.maximum(image, background) - np.minimum(image, background)
    moved = difference > MOVED
    red, green, blue = (moved[..., i] for i in range(3))
    return np.asarray(red | green | blue)


def led_to(trajectory: Trajectory, start: int, stop: int, width: int) -> dict[str, np.ndarray]:
    """Return images start .. stop - 1, each with the action and reward that led to it.

    This is the only place where actions and rewards are shifted against images.

    :param width: the agent's action width, `max_action_dim`; entries past the trajectory's
        `action_dim` become zero
    :return: the fields of a Batch for one sequence: arrays (stop - start, ...)
    """
    length = len(trajectory)
    used = trajectory.action_dim
    assert 0 <= start < stop <= length + 1, (start, stop, length)
    assert used <= width, (used, width)
    images = stop - start
    action = np.zeros((images, width), np.float32)
    reward = np.zeros(images, np.float32)
    is_first, is_terminal, known = np.zeros((3, images), bool)
    is_first[0] = True  # a window's first image starts a new state: no action led to it
    action[1:, :used] = trajectory.action[start : stop - 1, :used]
    if trajectory.reward is not None:
        begin = max(start, 1)  # no reward led to image 0
        reward[begin - start :] = trajectory.reward[begin - 1 : stop - 1]
        known[begin - start :] = True
    # a time limit is no terminal state: its last image is like any other
    is_terminal[-1] = trajectory.terminated and stop == length + 1
    return {
        "image": trajectory.image[start:stop],
        "action": action,
        "reward": reward,
        "is_first": is_first,
        "is_terminal": is_terminal,
        "reward_known": known,
    }


def stack_windows(windows: Sequence[dict[str, np.ndarray]]) -> Batch:
    """Make a Batch of equally long sequences, the results of `led_to`."""
    return Batch(**{k: torch.from_numpy(np.stack([w[k] for w in windows])) for k in STREAMS})
