"""Small wrappers, each named by a verb: CheckAction, RepeatAction, PadAction, SeePixels."""

from copy import copy, deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs


class CheckAction(gym.ActionWrapper, RecordConstructorArgs):
    """Raise an error for an action of the wrong shape, outside the Box or not finite."""

    def __init__(self, env: gym.Env) -> None:
        RecordConstructorArgs.__init__(self)
        gym.ActionWrapper.__init__(self, env)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the same action in the dtype of the Box; whole numbers are rounded.

        :param action: (A,)
        :raises ValueError: if the action is invalid
        """
        box = self.action_space
        assert isinstance(box, spaces.Box), box
        whole = np.issubdtype(box.dtype, np.integer)
        action = np.asarray(action, np.float64 if whole else box.dtype)
        if action.shape != box.shape:
            raise ValueError(f"The action has the shape {action.shape}, but it must be {box.shape}")
        if not np.isfinite(action).all():
            raise ValueError(f"The action contains NaN or infinity: {action}")
        if np.any(action < box.low - 1e-6) or np.any(action > box.high + 1e-6):
            raise ValueError(
                f"The action {action} lies outside [{box.low.min()}, {box.high.max()}]: "
                "`action = numpy.clip(action, env.action_space.low, env.action_space.high)`"
            )
        return np.rint(action).astype(box.dtype) if whole else action


class PadAction(gym.ActionWrapper, RecordConstructorArgs):
    """Widen the action space to `size`, and pass the leading entries to the environment."""

    def __init__(self, env: gym.Env, size: int) -> None:
        RecordConstructorArgs.__init__(self, size=size)
        gym.ActionWrapper.__init__(self, env)
        box = env.action_space
        if not isinstance(box, spaces.Box) or len(box.shape) != 1:
            raise ValueError(f"Only actions in a flat Box can be padded, not in {box}")
        (width,) = box.shape
        if size < width:
            raise ValueError(
                f"pad_action_to={size} is narrower than the task's {width} actions: "
                f"pass {width} or more, or None"
            )
        self._width = width
        pad = np.ones(size - width, box.dtype)
        lowest = 0 * pad if np.issubdtype(box.dtype, np.unsignedinteger) else -pad
        low, high = np.concatenate([box.low, lowest]), np.concatenate([box.high, pad])
        self.action_space = spaces.Box(low, high, dtype=box.dtype.type)

    def action(self, action: np.ndarray) -> np.ndarray:
        """Return the entries that the environment has."""
        return action[: self._width]


class RepeatAction(gym.Wrapper, RecordConstructorArgs):
    """Apply each action `times` times, sum the rewards, and stop when the episode ends."""

    def __init__(self, env: gym.Env, times: int) -> None:
        RecordConstructorArgs.__init__(self, times=times)
        gym.Wrapper.__init__(self, env)
        if times < 1 or times != int(times):
            raise ValueError(f"action_repeat={times}: pass a whole number, 1 or more")
        self.times = int(times)
        self.metadata = dict(env.metadata)
        if "render_fps" in env.metadata:
            self.metadata["render_fps"] = env.metadata["render_fps"] / times

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take one step of the agent; return the last observation, the rewards' sum and info."""
        total = 0.0
        for _ in range(self.times):
            # a copy, since some environments scale the action in place
            obs, reward, terminated, truncated, info = self.env.step(copy(action))
            total += float(reward)
            if terminated or truncated:
                break
        return obs, total, terminated, truncated, info


class SeePixels(gym.Wrapper, RecordConstructorArgs):
    """Replace the observation with an image, which is drawn once after each step.

    The environment underneath must have `look(size)`, which returns (size, size, 3) uint8.

    :param state_in_info: put the observation underneath into `info["state"]`
    :param render_size: side of what `render()` returns; the last observation if None
    """

    def __init__(
        self,
        env: gym.Env,
        image_size: int = 64,
        state_in_info: bool = False,
        render_size: int | None = None,
    ) -> None:
        RecordConstructorArgs.__init__(
            self, image_size=image_size, state_in_info=state_in_info, render_size=render_size
        )
        gym.Wrapper.__init__(self, env)
        if min(image_size, render_size or image_size) < 1:
            raise ValueError(f"{image_size=}, {render_size=} are not allowed: pass 1 or more")
        self._image_size, self._render_size = image_size, render_size or image_size
        self._state_in_info = state_in_info
        self._image: np.ndarray | None = None
        self.observation_space = spaces.Box(0, 255, (image_size, image_size, 3), np.uint8)

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """Start an episode and return its first image."""
        state, info = self.env.reset(**kwargs)
        return self._seen(state, info)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Take a step and return the image after it."""
        state, reward, terminated, truncated, info = self.env.step(action)
        image, info = self._seen(state, info)
        return image, float(reward), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """Return the last image, at `render_size`."""
        if self.render_mode is None:
            return None
        if self._render_size == self._image_size and self._image is not None:
            return self._image.copy()
        return self.get_wrapper_attr("look")(self._render_size)

    def _seen(self, state: Any, info: dict[str, Any]) -> tuple[np.ndarray, dict[str, Any]]:
        if self._state_in_info:
            info = info | {"state": deepcopy(state)}  # the environment may write into it later
        self._image = self.get_wrapper_attr("look")(self._image_size)
        return self._image.copy(), info


def dress(
    env: gym.Env,
    *,
    image_size: int,
    action_repeat: int,
    pad_action_to: int | None,
    state_in_info: bool,
    render_size: int | None,
) -> gym.Env:
    """Wrap an environment that has `look`: repeat actions, see pixels, pad and check actions."""
    env = RepeatAction(env, action_repeat)
    env = SeePixels(env, image_size, state_in_info, render_size)
    if pad_action_to is not None:
        env = PadAction(env, pad_action_to)
    return CheckAction(env) if isinstance(env.action_space, spaces.Box) else env
