"""What every reader of a foreign format shares: its options, image and action conversion."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator
from importlib import import_module
from typing import Any

import numpy as np

from wpt_agents.data.images import resized
from wpt_agents.data.trajectory import IMAGE_SIZE, Trajectory


class Episodes(ABC):
    """Somebody's episodes in a fixed order, each read and converted when asked for.

    One of a single image holds no action and is left out, aloud.

    :param image_size: height and width to resize to
    :param rewards: whether to keep the rewards; pre-training needs none
    :param embodiment: the robot's name, for all
    :param task: what the behaviour was after, for all
    """

    def __init__(
        self,
        image_size: int = IMAGE_SIZE,
        rewards: bool = False,
        embodiment: str | None = None,
        task: str | None = None,
    ) -> None:
        self.image_size, self.rewards = image_size, rewards
        self.embodiment, self.task = embodiment, task

    @abstractmethod
    def __len__(self) -> int:
        """The number of episodes."""

    @abstractmethod
    def __getitem__(self, i: int) -> Trajectory:
        """Episode `i`, 0 <= i < len.

        :raises ValueError: it cannot be read or converted; names the file and the remedy
        """

    def __iter__(self) -> Iterator[Trajectory]:
        return (self[i] for i in range(len(self)))

    def _trajectory(
        self,
        image: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray | None,
        source: str,
        **labels: Any,
    ) -> Trajectory:
        """Checks and converts; time is the caller's: (T + 1, ...), (T, A) and (T,)."""
        try:
            return Trajectory(
                image=as_images(image, self.image_size),
                action=np.ascontiguousarray(action, np.float32),
                reward=None if reward is None or not self.rewards else np.ravel(reward),
                source=source,
                **{"embodiment": self.embodiment, "task": self.task, **labels},
            )
        except ValueError as error:
            raise ValueError(f"{source}: {error}") from error


def warn_left_out(count: int, source: object) -> None:
    """Says how many episodes of a single image a reader leaves out."""
    if count:
        warnings.warn(
            f"{source}: {count} episode{'s' * (count > 1)} of a single image left out, for want of "
            "an action that led anywhere",
            stacklevel=3,
        )


def needs(module: str, what: str) -> Any:
    """Imports an optional package, or says how to get it."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.split(".")[0]
        raise ImportError(f"Reading {what} needs {package}: pip install {package}") from error


def as_images(image: np.ndarray, size: int) -> np.ndarray:
    """Colour images, channels first or last, resized; of stacked frames, the newest.

    :param image: (N, H, W, 3 k) or (N, 3 k, H, W) uint8
    :return: (N, size, size, 3) uint8; not square is squeezed
    """
    if image.ndim != 4 or image.dtype != np.uint8:
        raise ValueError(
            f"the observations are {image.shape} {image.dtype}, not (N, H, W, 3) uint8 images; "
            "name the images' key, or render the states first"
        )
    if image.shape[1] < min(image.shape[2:]):
        image = image.transpose(0, 2, 3, 1)
    if image.shape[-1] % 3:
        raise ValueError(f"the images have {image.shape[-1]} channels, colour needs 3")
    image = image[..., -3:]
    if image.shape[1:3] == (size, size):
        return np.ascontiguousarray(image)
    return np.concatenate([resized(image[at : at + 64], size) for at in range(0, len(image), 64)])


def both_limits(low: Any, high: Any) -> tuple[np.ndarray, np.ndarray] | None:
    """The actions' limits as arrays, None where neither is given.

    :raises ValueError: one without the other
    """
    if low is None and high is None:
        return None
    if low is None or high is None:
        raise ValueError(
            f"low and high, the actions' limits, belong together; got low={low} and high={high}"
        )
    return np.asarray(low, np.float64), np.asarray(high, np.float64)


def rescaled(action: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Actions of the range `low` to `high`, clipped to it, in [-1, 1]; 0 where both are equal.

    :param action: (T, A)
    :param low: (A,)
    :param high: (A,)
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    if action.ndim != 2 or action.shape[1:] != low.shape or low.shape != high.shape:
        raise ValueError(
            f"actions of {action.shape} with limits of {low.shape} and {high.shape} are not "
            "continuous actions (T, A) with limits (A,)"
        )
    if not (np.isfinite(low).all() and np.isfinite(high).all()):
        raise ValueError(f"the actions' limits {low} to {high} are not finite; give low and high")
    width = np.where(high > low, high - low, 1.0)
    scaled = np.where(high > low, 2 * (action - low) / width - 1, 0.0)
    return np.clip(scaled, -1, 1).astype(np.float32)
