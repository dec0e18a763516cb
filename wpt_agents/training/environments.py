"""Convert anything that an agent accepts as an environment to a VecEnv of Stable-Baselines3."""

import warnings
from collections.abc import Callable, Sequence
from copy import deepcopy
from importlib import import_module
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import SyncVectorEnv, VectorEnv
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecEnv,
    VecEnvWrapper,
    VecExtractDictObs,
    VecMonitor,
)
from stable_baselines3.common.vec_env.patch_gym import _patch_env

from wpt_agents.model.observations import image_keys
from wpt_agents.training.gymnasium_vector import GymnasiumVecEnv

# Namespaces of ids, and the package that registers them as soon as it is imported. A name is no
# import, so that the agent goes on to know no task.
REGISTERED_BY = {"wpt": "wpt_envs", "gym_pusht": "gym_pusht", "gym_aloha": "gym_aloha"}

ACCEPTED = (
    "an id, a Gymnasium environment, a function that makes one, a list of these, a "
    "gymnasium.vector environment or a VecEnv of Stable-Baselines3"
)


def as_vec_env(env: Any, image_key: str | None = None, monitor: bool = True) -> VecEnv:
    """Make a VecEnv from any environment; its observations are copies.

    :param env: an id, a Gymnasium environment, a function that makes one, a list of these, a
        `gymnasium.vector` environment or a VecEnv
    :param image_key: the entry of Dict observations to use; their only image if None
    :param monitor: record each episode's return and length
    """
    if isinstance(env, VectorEnv):
        if isinstance(env.unwrapped, SyncVectorEnv):
            env.unwrapped.envs = [_owning(part) for part in env.unwrapped.envs]
        vec_env: VecEnv = GymnasiumVecEnv(env)
        vec_env = VecMonitor(vec_env) if monitor else vec_env
    elif isinstance(env, VecEnv):
        vec_env = env
        _own_observations(vec_env)
    else:
        several = list(env) if isinstance(env, Sequence) and not isinstance(env, str) else [env]
        vec_env = _side_by_side([_monitored(make(part), monitor) for part in several])
    if isinstance(vec_env.observation_space, spaces.Dict):
        key = _image_key(vec_env.observation_space, image_key)
        vec_env = VecExtractDictObs(vec_env, key) if key is not None else vec_env
    elif image_key is not None and image_key not in _extracted(vec_env):
        raise ValueError(
            f"image_key={image_key!r} chooses from Dict observations, but the environment's are "
            f"{vec_env.observation_space}: leave image_key out, or pass image_key=None if it comes "
            "from a model file"
        )
    return vec_env


def _extracted(env: VecEnv) -> list[str]:
    """Return the entries of Dict observations that wrappers select, as in `model.get_env()`."""
    keys = []
    while isinstance(env, VecEnvWrapper):
        keys += [env.key] if isinstance(env, VecExtractDictObs) else []
        env = env.venv
    return keys


def make(env: Any) -> gym.Env:
    """Make one Gymnasium environment from an id, a spec, or a function or class that makes it.

    :raises ValueError: anything else, with what to write instead
    """
    if isinstance(env, gym.Env):
        return env
    if isinstance(env, str):
        return _make_id(env)
    if isinstance(env, EnvSpec):
        return gym.make(env)
    if hasattr(env, "action_spec") and hasattr(env, "observation_spec"):
        return _refuse_dm_env(env)
    if callable(env):
        return make(env())
    if any(base.__module__.split(".")[0] == "gym" for base in type(env).__mro__):
        return _patch_env(env)  # OpenAI Gym, by way of Shimmy
    raise ValueError(f"This {type(env).__name__} is not an environment: pass {ACCEPTED}")


def _make_id(env_id: str) -> gym.Env:
    namespace = env_id.split("/")[0] if "/" in env_id and ":" not in env_id else None
    known = {spec.namespace for spec in gym.registry.values()}
    if namespace in REGISTERED_BY and namespace not in known:
        # as `gym.make("module:id")` does, for names that are known
        import_module(REGISTERED_BY[namespace])
    try:
        made = maybe_make_env(env_id, verbose=0)
    except gym.error.NamespaceNotFound as error:
        remedy = f"import the package that registers it, or name it in the id: 'package:{env_id}'"
        raise gym.error.NamespaceNotFound(f"{error} If so, {remedy}") from error
    assert isinstance(made, gym.Env), made
    return made


def _refuse_dm_env(env: Any) -> gym.Env:
    name = type(env).__name__
    if hasattr(env, "physics"):
        raise ValueError(
            f"This {name} is a dm_env. Wrap it with Shimmy (pip install 'shimmy[dm-control]'): "
            "`env = wpt_envs.pixels(shimmy.DmControlCompatibilityV0(env, render_mode='rgb_array', "
            "render_kwargs={'height': 64, 'width': 64}))`"
        )
    raise ValueError(
        f"This {name} is a dm_env. Write a gymnasium.Env around it, as Shimmy does for dm_control, "
        "whose observations are its images"
    )


def _monitored(env: gym.Env, monitor: bool) -> gym.Env:
    return _owning(Monitor(env) if monitor and not is_wrapped(env, Monitor) else env)


def _side_by_side(envs: list[gym.Env]) -> VecEnv:
    if not envs:
        raise ValueError(f"An empty list has no environment: pass {ACCEPTED}")
    # two places of one list must not step the same simulator
    if len({id(env.unwrapped) for env in envs}) < len(envs):
        raise ValueError(
            "The list holds the same environment twice, whose episodes would mix: make one for "
            "each place, for example by [make_env() for _ in range(4)]"
        )
    for place, env in enumerate(envs):
        for name in ("observation_space", "action_space"):
            first, other = getattr(envs[0], name), getattr(env, name)
            if first != other:
                raise ValueError(
                    f"All environments of a list must have one {name}: number 0 has {first}, "
                    f"number {place} {other}"
                )
    functions: list[Callable[[], gym.Env]] = [lambda env=env: env for env in envs]  # type: ignore
    return DummyVecEnv(functions)


OF_WRAPPERS = vars(gym.Wrapper(gym.Env())).keys()  # what Gymnasium's wrappers keep themselves


class OwnObservation(gym.ObservationWrapper):
    """A wrapper that copies observations, as some environments reuse one array for all.

    It also checks images, because a DummyVecEnv copies them into its uint8 array without a check:
    floats in [0, 1] would become black, and a grayscale image would fill all three channels.
    """

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute where it is defined, so that `DummyVecEnv.set_attr` has an effect."""
        if name in OF_WRAPPERS:
            super().__setattr__(name, value)
        else:
            self.env.set_wrapper_attr(name, value)

    def __getattr__(self, name: str) -> Any:
        """Find an attribute where it is defined, for code that accesses `DummyVecEnv.envs`."""
        if name == "env" or name.startswith("__"):  # not there yet while a copy is made
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        return getattr(self.env, name)

    def observation(self, observation: Any) -> Any:
        """Return a copy."""
        if isinstance(self.observation_space, spaces.Dict):
            for key, space in self.observation_space.spaces.items():
                if key in observation:
                    check_image(observation[key], space, f"The entry {key!r} of an observation")
        else:
            check_image(observation, self.observation_space, "An observation")
        return observation.copy() if isinstance(observation, np.ndarray) else deepcopy(observation)


def check_image(image: Any, space: spaces.Space[Any], name: str) -> None:
    """Raise a ValueError for an image that does not match its space.

    :param image: an observation
    :param space: its space; spaces that are not of images are not checked
    :param name: what to call the observation in the message
    """
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return
    array = np.asarray(image)
    if array.shape == space.shape and array.dtype == np.uint8:
        return
    whole = np.issubdtype(array.dtype, np.integer)
    if array.shape != space.shape or not whole or array.min() < 0 or array.max() > 255:
        numbers = array.size > 0 and np.issubdtype(array.dtype, np.number)
        values = f" from {array.min():.4g} to {array.max():.4g}" if numbers else ""
        raise ValueError(
            f"{name} must be {space.shape} uint8 by the environment's observation_space, and is "
            f"{array.shape} {array.dtype}{values}; nothing of this episode was stored: correct the "
            "environment's observation, or its observation_space"
        )


def _owning(env: gym.Env) -> gym.Env:
    return env if is_wrapped(env, OwnObservation) else OwnObservation(env)


def _own_observations(env: VecEnv) -> None:
    """Let the environments of a DummyVecEnv copy, as it resets before it reports the last image."""
    inner = innermost(env)
    if isinstance(inner, DummyVecEnv):
        inner.envs = [_owning(part) for part in inner.envs]


def innermost(env: VecEnv | None) -> VecEnv | None:
    """Return the VecEnv inside of all wrappers."""
    while isinstance(env, VecEnvWrapper):
        env = env.venv
    return env


def _image_key(space: spaces.Dict, image_key: str | None) -> str | None:
    """Return the entry to use, or None if there is none; warn of entries that are left out."""
    boxes = {key: box for key, box in space.spaces.items() if isinstance(box, spaces.Box)}
    images = image_keys({key: (box.shape, box.dtype) for key, box in boxes.items()})
    if image_key is not None:
        if image_key not in space.spaces:
            names = ", ".join(map(repr, space.spaces))
            raise ValueError(f"No entry {image_key!r} in the Dict observations. There are: {names}")
        return image_key
    if len(images) > 1:
        names = ", ".join(map(repr, images))
        raise ValueError(
            f"The Dict observations hold {len(images)} images, {names}: choose one by "
            f"image_key={images[0]!r}, or by wpt_envs.pixels(env, image_key={images[0]!r})"
        )
    if images:
        others = ", ".join(repr(key) for key in space.spaces if key != images[0])
        warnings.warn(
            f"Of the Dict observations the agent sees {images[0]!r}"
            + f", not {others}" * bool(others),
            stacklevel=4,
        )
    return images[0] if images else None
