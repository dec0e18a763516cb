"""Conversion of observations to the input of the networks, images of (n, 64, 64, 3) uint8."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from wpt_agents.data.images import resized
from wpt_agents.data.trajectory import IMAGE_SIZE
from wpt_agents.model.behavior_cloning import FRAMES

IMAGE_SPACE = spaces.Box(0, 255, (IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8)
Observation = np.ndarray | Mapping[str, np.ndarray]
State = tuple[np.ndarray, ...]  # the recurrent state of acting, which the caller keeps
CHANNELS = {1: "grayscale", 3: "colour", 4: "RGBA"}


def channel_axis(shape: tuple[int, ...]) -> int | None:
    """Return the axis of an image's 1, 3 or 4 channels, 2 or 0, or None if it is no image.

    :param shape: the shape of one image; 3 channels take precedence over 1 and 4
    """
    if len(shape) != 3:
        return None
    axes = [axis for channels in ((3,), (1, 4)) for axis in (2, 0) if shape[axis] in channels]
    return axes[0] if axes else None


def image_keys(shapes: Mapping[str, tuple[tuple[int, ...], Any]]) -> list[str]:
    """Return the entries of a dictionary that are images: those in colour, or else the others.

    :param shapes: for each entry the shape of one observation, and its dtype
    """
    channels = {}
    for key, (shape, dtype) in shapes.items():
        axis = channel_axis(shape)
        if axis is not None and dtype == np.uint8:
            channels[key] = shape[axis]
    colour = [key for key, n in channels.items() if n == 3]
    return colour or list(channels)


def to_images(observation: Observation, image_key: str | None = None) -> tuple[np.ndarray, bool]:
    """Convert observations to (n, 64, 64, 3) uint8, and return whether there was a batch axis.

    Takes (H, W, C) and (C, H, W), one or a batch. A single channel is repeated, a fourth (the
    transparency) is left out, and other sizes are resized.

    :param image_key: the entry to take from a dictionary; its only image if None
    :raises ValueError: anything that is no uint8 image, such as the tuple that `reset` returns
    """
    if isinstance(observation, tuple) and any(
        isinstance(part, Mapping) for part in observation[1:]
    ):
        raise ValueError(
            "An observation must be an image, got a tuple that ends with a dictionary, as "
            "Gymnasium's reset and step return it: take its first entry, for example "
            "`obs, info = env.reset()`"
        )
    if isinstance(observation, Mapping):
        observation = observation[_key_of(observation, image_key)]
    observation = np.asarray(observation)
    batched = observation.ndim == 4
    images = observation if batched else observation[None]
    axis = channel_axis(images.shape[1:])
    if axis is None or images.dtype != np.uint8:
        raise ValueError(
            f"An observation must be an image, (H, W, 3) uint8 or a batch of them, got "
            f"{observation.shape} {observation.dtype}{_range(observation)}; "
            f"{_remedy(observation, axis is not None)}"
        )
    if axis == 0:
        images = images.transpose(0, 2, 3, 1)
    if images.shape[-1] != 3:
        images = np.repeat(images, 3, -1) if images.shape[-1] == 1 else images[..., :3]
    if images.shape[1:3] != (IMAGE_SIZE, IMAGE_SIZE):
        images = resized(images, IMAGE_SIZE)
    return np.require(images, requirements=("C", "W")), batched


def _remedy(observation: np.ndarray, shaped: bool) -> str:
    """Return the advice how to convert the values of an observation to an image.

    :param shaped: whether it has the shape of an image, or of a batch
    """
    if not shaped and observation.ndim == 2 and min(observation.shape) >= 16:
        return "repeat a grayscale image, np.repeat(image[..., None], 3, axis=-1)"
    if not shaped or observation.dtype.kind not in "fiu":
        return "render the environment to pixels"
    small = observation.dtype.kind == "f" and observation.size and observation.max() <= 1
    return f"convert it, np.rint({'255 * image' if small else 'image'}).astype(np.uint8)"


def _key_of(observation: Mapping[str, Any], image_key: str | None) -> str:
    arrays = {key: np.asarray(value) for key, value in observation.items()}
    images = _images_in(arrays) if image_key is None else [image_key]
    if len(images) != 1 or images[0] not in arrays:
        entries = ", ".join(f"{key!r} {x.shape} {x.dtype}" for key, x in arrays.items())
        raise ValueError(
            "An observation must be an image, (H, W, 3) uint8 or a batch of them, got a dictionary "
            f"of {entries}: pass the image alone"
        )
    return images[0]


def _images_in(arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Return the entries that are images, or batches of them; not both.

    In a batch, (n, 64, 64) may be masks of n environments, and look like the channels of an image.
    """
    batched = len({x.shape[:1] for x in arrays.values()}) == 1
    for dims in (4, 3) if batched else (3, 4):
        images = image_keys(
            {k: (x.shape[-3:], x.dtype) for k, x in arrays.items() if x.ndim == dims}
        )
        if images:
            return images
    return []


def _range(observation: np.ndarray) -> str:
    """Return the range of values for a message, or nothing if they are no numbers."""
    if observation.size == 0 or not np.issubdtype(observation.dtype, np.number):
        return ""
    return f" with values from {observation.min():.4g} to {observation.max():.4g}"


def check_episode_start(episode_start: Any, n: int) -> np.ndarray:
    """Return one bool for each of n environments, all False for None.

    :param episode_start: n bools, or None
    :raises ValueError: another number of bools
    """
    first = np.zeros(n, bool) if episode_start is None else np.array(episode_start, bool)
    if first.shape == () and n == 1:
        return first[None]
    if first.shape != (n,):
        raise ValueError(
            f"episode_start has the shape {first.shape}, but the observation is of {n} "
            f"environments: pass {n} bools, or None where no episode begins"
        )
    return first


def check_state(state: Any, shapes: tuple[tuple[int, ...], ...], n: int) -> None:
    """Raise a ValueError for the recurrent state of another model.

    :param state: the state to check
    :param shapes: the shapes of this model's arrays, without the axis of the environments
    :param n: the number of environments
    :raises ValueError: another kind of state, or one of another number of environments
    """
    remedy = "pass the state that this model's own predict returned, or None"
    if not isinstance(state, tuple | list) or len(state) != len(shapes):
        what = f"{type(state).__name__} of {len(state)}" if hasattr(state, "__len__") else state
        raise ValueError(f"The state is a tuple of {len(shapes)} arrays, got {what}: {remedy}")
    got = [np.shape(part) for part in state]
    if [shape[1:] for shape in got] != list(shapes):
        expected = ", ".join(str((n, *shape)) for shape in shapes)
        raise ValueError(
            f"The state's arrays have the shapes {', '.join(map(str, got))}, this model's are "
            f"{expected}: {remedy}"
        )
    lengths = {shape[0] for shape in got}
    if lengths != {n}:
        raise ValueError(
            f"The state is of {lengths.pop()} environments, the observation of {n}: pass "
            "state=None where all episodes begin"
        )


def stack_frames(
    image: np.ndarray, frames: np.ndarray | None, episode_start: np.ndarray | None
) -> np.ndarray:
    """Return the last three images of n episodes, repeating the first one where an episode begins.

    :param image: (n, 64, 64, 3), the newest
    :param frames: (n, F, 64, 64, 3), as returned at the step before, or None
    :param episode_start: (n,) bool
    """
    if frames is None:
        return np.repeat(image[:, None], FRAMES, 1)
    check_state((frames,), ((FRAMES, *image.shape[1:]),), len(image))
    first = check_episode_start(episode_start, len(image))
    moved: np.ndarray = np.concatenate([frames[:, 1:], image[:, None]], 1)
    moved[first] = image[first, None]
    return moved
