"""Checks of an environment's spaces, whose errors contain a line of code that helps."""

import warnings
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from wpt_agents.data.images import middle, resize_message
from wpt_agents.data.trajectory import IMAGE_SIZE
from wpt_agents.model.observations import CHANNELS, channel_axis

IMAGE_SHAPE = (IMAGE_SIZE, IMAGE_SIZE, 3)
HUGE = 1e9  # bounds beyond this are stand-ins for infinity, such as those of float32 or int32

RENDER = (
    "make it with render_mode='rgb_array' and take its pictures: `env = wpt_envs.pixels(env)`, or "
    "`env = gymnasium.wrappers.AddRenderObservation(env)`"
)


def check_spaces(env: VecEnv, max_action_dim: int | None = None, trained: bool = False) -> None:
    """Raise a ValueError for spaces that an agent cannot use; warn if images are changed.

    :param max_action_dim: the largest number of actions, or None for any
    :param trained: whether a new model with another `max_action_dim` must be trained first
    """
    check_observations(env)
    check_actions(env.action_space, max_action_dim, trained)


# ------------------------------------------------------------------------------- observations


def check_observations(env: VecEnv) -> None:
    """Raise a ValueError for observations that are no images, naming a wrapper or the remedy."""
    space = env.observation_space
    if not is_image(space):
        raise ValueError(
            "The agent sees images, a Box of (64, 64, 3) uint8, but the environment's observations "
            f"are {space}: {_culprit(env) or observation_remedy(space)}"
        )
    shape: Any = space.shape
    axis = channel_axis(shape)
    assert axis is not None, shape
    if shape[axis] != 3:
        culprit = _culprit(env, 3)
        if culprit:
            raise ValueError(f"The agent sees in colour, but observations are {space}: {culprit}")
        if shape[axis] == 4 and (culprit := _culprit(env, 1)):  # four grayscale images, not RGBA
            raise ValueError(f"The agent sees one image, but observations are {space}: {culprit}")
        how = {1: "repeated to three channels", 4: "taken without their transparency"}[shape[axis]]
        warnings.warn(f"{CHANNELS[shape[axis]]} observations, {shape}, are {how}", stacklevel=4)
    height, width = (shape[0], shape[1]) if axis == 2 else (shape[1], shape[2])
    if (height, width) != (IMAGE_SIZE, IMAGE_SIZE):
        cut = _crop(height, width, shape[axis], channels_last=axis == 2)
        warnings.warn(resize_message(height, width, IMAGE_SIZE, cut=cut), stacklevel=4)


def is_image(space: spaces.Space[Any], channels: int | None = None) -> bool:
    """Return whether a space is of uint8 images, with this number of channels unless it is None."""
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    axis = channel_axis(space.shape)
    return axis is not None and channels in (None, space.shape[axis])


def _layers(env: VecEnv) -> Iterator[Any]:
    """Yield the environment and what it wraps in this process, from the outside to the inside."""
    layer: Any = env
    while True:
        yield layer
        if isinstance(layer, VecEnvWrapper):
            layer = layer.venv
        elif isinstance(layer, gym.Wrapper):
            layer = layer.env
        elif getattr(layer, "envs", None):
            layer = layer.envs[0]
        else:
            return


def _culprit(env: VecEnv, channels: int | None = None) -> str | None:
    """Return the advice to leave out the wrapper that changes the images, or None."""
    layers = list(_layers(env))
    for outer, inner in pairwise(layers):
        if is_image(inner.observation_space, channels) and outer.observation_space != (
            inner.observation_space
        ):
            name = type(outer).__name__
            inside = f"underneath it are {inner.observation_space}"
            if name == "VecNormalize":
                return f"VecNormalize makes floats of images; give it norm_obs=False: {inside}"
            if channels == 3:
                return f"{name} takes the colour away; leave it out: {inside}"
            if "Stack" in name:
                inside += ". No stack of frames is needed, as the agent has a memory"
            return f"{name} makes this of the images; leave it out: {inside}"
    return None


def observation_remedy(space: spaces.Space[Any]) -> str:
    """Return the line of code that turns observations of this space into images."""
    if isinstance(space, spaces.Dict):
        keys = ", ".join(map(repr, space.spaces))
        return f"no entry of {keys} is a uint8 image; {RENDER}"
    if not isinstance(space, spaces.Box) or space.dtype is None:
        return f"they are no array; {RENDER}"
    if is_image(spaces.Box(0, 255, space.shape, np.uint8)):
        return _pixel_values(space)
    shape = space.shape
    if len(shape) == 4 and channel_axis(shape[1:]) is not None and space.dtype == np.uint8:
        return "they are stacks of images; take the newest: " + _observe(
            "images", "images[-1]", shape[1:]
        )
    if len(shape) == 3 and space.dtype == np.uint8 and shape[2] % 3 == 0:
        return "they are images stacked by their channels; take the newest: " + _observe(
            "images", "images[..., -3:]", (*shape[:2], 3)
        )
    if len(shape) == 3 and space.dtype == np.uint8 and shape[0] % 3 == 0:
        return "they are images stacked by their channels; take the newest: " + _observe(
            "images", "images[-3:]", (3, *shape[1:])
        )
    if len(shape) == 2 and space.dtype == np.uint8 and min(shape) > 1:
        return "they are grayscale images without an axis for the channel; add one: " + _observe(
            "image", "image[..., None]", (*shape, 1)
        )
    return f"they are no images; {RENDER}"


def _pixel_values(space: spaces.Box) -> str:
    """Return the line of code that turns values of this dtype and these bounds into bytes."""
    low, high = float(space.low.min()), float(space.high.max())
    if (low, high) == (0, 255):
        formula, what = "image.round().astype('uint8')", f"bytes stored as {space.dtype}"
    elif np.isfinite([low, high]).all() and high > low:
        shifted = "image" if low == 0 else f"(image - {low:g})"
        formula = f"({255 / (high - low):g} * {shifted}).round().clip(0, 255).astype('uint8')"
        what = f"{space.dtype} images in [{low:g}, {high:g}]"
    else:
        formula = "(255 * image).round().clip(0, 255).astype('uint8')"
        what = f"{space.dtype} images without bounds; if their values are in [0, 1]"
    return f"they are {what}; convert them: " + _observe("image", formula, space.shape)


def _observe(name: str, formula: str, shape: tuple[int, ...]) -> str:
    return (
        f"`env = gymnasium.wrappers.TransformObservation(env, lambda {name}: {formula}, "
        f"gymnasium.spaces.Box(0, 255, {shape}, 'uint8'))` around each single environment"
    )


def _crop(height: int, width: int, channels: int, channels_last: bool) -> str:
    """Return the line of code that cuts out the middle square of observations."""
    rows, columns = middle(height, width)
    side = min(height, width)
    cut = f"{rows.start}:{rows.stop}, {columns.start}:{columns.stop}"
    if channels_last:
        return _observe("image", f"image[{cut}]", (side, side, channels))
    return _observe("image", f"image[:, {cut}]", (channels, side, side))


# ------------------------------------------------------------------------------------ actions


def check_actions(
    space: spaces.Space[Any], max_action_dim: int | None, trained: bool = False
) -> None:
    """Raise a ValueError for actions that are no flat, bounded Box, or too many."""
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(
            f"The agent acts in a one-dimensional Box, the environment takes {space}: "
            f"{action_remedy(space)}"
        )
    bounds = np.abs(np.concatenate([space.low, space.high]).astype(np.float64))
    if not (bounds < HUGE).all():
        raise ValueError(
            f"The action space must have finite bounds, it is {space}: say how far the actions "
            f"reach, for example from -1 to 1, by {_act('action', space.shape[0])}. "
            "gymnasium's ClipAction also hides the bounds; leave it out, as the agent keeps to them"
        )
    width = space.shape[0]
    if max_action_dim is not None and width > max_action_dim:
        remedy = "train a new one" if trained else "make it"
        raise ValueError(
            f"The environment has {width} actions, the model was made for at most max_action_dim="
            f"{max_action_dim}: {remedy} with max_action_dim={width}"
        )


def action_remedy(space: spaces.Space[Any]) -> str:
    """Return the line of code that turns actions of this space into a flat Box."""
    if isinstance(space, spaces.Box):
        formula = f"action.reshape({space.shape})"
        bounds = "gymnasium.spaces.Box(env.action_space.low.ravel(), env.action_space.high.ravel()"
        return f"flatten it by {_act(formula, box=f'{bounds}, dtype={space.dtype.name!r})')}"
    if isinstance(space, spaces.Discrete):
        start = f" + {space.start}" if space.start else ""
        choice = _act(f"int(action.argmax()){start}", int(space.n))
        return f"wrap it so that the largest of {space.n} numbers decides, by {choice}"
    if isinstance(space, spaces.MultiBinary) and len(space.shape) == 1:
        bits = _act("(action > 0).astype('int8')", space.shape[0])
        return f"wrap it so that positive numbers switch on, by {bits}"
    if isinstance(space, spaces.MultiDiscrete) and len(space.shape) == 1:
        tops = f"numpy.array({(space.nvec - 1).tolist()})"
        formula = f"((action + 1) / 2 * {tops}).round().astype('int64')"
        if space.start.any():
            formula += f" + numpy.array({space.start.tolist()})"
        return f"wrap it so that each number is rounded, by {_act(formula, space.shape[0])}"
    parts = spaces.flatten_space(space) if space.is_np_flattenable else None
    members = _members(space)
    if isinstance(parts, spaces.Box) and all(isinstance(member, spaces.Box) for member in members):
        formula = "gymnasium.spaces.unflatten(space, action)"
        box = "gymnasium.spaces.flatten_space(env.action_space)"
        return f"flatten it by {_act(formula, box=box, more=', space=env.action_space')}"
    return "wrap it with gymnasium.wrappers.TransformAction so that it takes a one-dimensional Box"


def _members(space: spaces.Space[Any]) -> list[spaces.Space[Any]]:
    if isinstance(space, spaces.Dict):
        return list(space.spaces.values())
    return list(space.spaces) if isinstance(space, spaces.Tuple) else []


def _act(formula: str, width: int = 0, box: str = "", more: str = "") -> str:
    box = box or f"gymnasium.spaces.Box(-1.0, 1.0, ({width},))"
    return f"`env = gymnasium.wrappers.TransformAction(env, lambda action{more}: {formula}, {box})`"
