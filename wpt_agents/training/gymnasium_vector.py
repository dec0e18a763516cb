"""A vector environment of Gymnasium as a VecEnv of Stable-Baselines3."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn

REMEDY = "make it with vector_kwargs={'autoreset_mode': gymnasium.vector.AutoresetMode.SAME_STEP}"


class GymnasiumVecEnv(VecEnv):
    """A Gymnasium vector environment that reports ends of episodes as a VecEnv does.

    A VecEnv resets an environment in the step that ends its episode: it returns the first
    observation of the next one, and the last of the old one in the info. Of Gymnasium's autoreset
    modes SAME_STEP does the same. In NEXT_STEP and DISABLED the last observation is returned, and
    this class resets those that ended, by a mask.

    :param vector: made by `gymnasium.make_vec`, for example
    """

    def __init__(self, vector: VectorEnv) -> None:
        self.vector = vector
        self.mode = _autoreset_mode(vector)
        self._actions: Any = None
        super().__init__(
            vector.num_envs, vector.single_observation_space, vector.single_action_space
        )

    def reset(self) -> Any:
        """Return the first observations; `seed` and `set_options` apply to one reset."""
        seeds: Any = [None if seed is None else int(seed) for seed in self._seeds]
        options = self._options[0]
        if any(other != options for other in self._options):
            raise ValueError("A Gymnasium vector takes the same options for all environments")
        chosen = {"options": options} if options else {}  # not every vector takes any
        obs, infos = self.vector.reset(seed=None if None in seeds else seeds, **chosen)
        self.reset_infos = [_of_one(infos, i) for i in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return deepcopy(obs)

    def step_async(self, actions: np.ndarray) -> None:
        """Begin a step in worker processes; without them it is taken in `step_wait`."""
        if isinstance(self.vector, AsyncVectorEnv):
            self.vector.step_async(actions)
        self._actions = actions

    def step_wait(self) -> VecEnvStepReturn:
        """End the step, and begin new episodes where some ended."""
        if isinstance(self.vector, AsyncVectorEnv):
            obs, rewards, terminated, truncated, vector_infos = self.vector.step_wait()
        else:
            obs, rewards, terminated, truncated, vector_infos = self.vector.step(self._actions)
        obs, rewards = deepcopy(obs), np.array(rewards, np.float32)
        dones = np.logical_or(terminated, truncated)
        infos = [_of_one(vector_infos, i) for i in range(self.num_envs)]
        for i in np.flatnonzero(dones):
            if self.mode == AutoresetMode.SAME_STEP:
                last = infos[i].pop("final_obs", None)  # if it is missing, the agent says so
                final = infos[i].pop("final_info", {})
                self.reset_infos[i] = infos[i]  # what remains is of the reset
                infos[i] = {**final, "terminal_observation": last}
            else:
                infos[i]["terminal_observation"] = _at(obs, i)
            infos[i]["TimeLimit.truncated"] = bool(truncated[i] and not terminated[i])
        if dones.any() and self.mode != AutoresetMode.SAME_STEP:
            first, reset_infos = self.vector.reset(options={"reset_mask": dones})
            obs = deepcopy(first)
            for i in np.flatnonzero(dones):
                self.reset_infos[i] = _of_one(reset_infos, int(i))
        return obs, rewards, dones, infos

    def close(self) -> None:
        """Close the environments."""
        self.vector.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        """Return what each environment renders."""
        images: Any = self.vector.render()
        return [None] * self.num_envs if images is None else list(images)

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """Return an attribute of each environment, or of the vector if it has no environments."""
        inner = self.vector.unwrapped
        if isinstance(inner, SyncVectorEnv):  # its own get_attr would call functions
            values: Sequence[Any] = [env.get_wrapper_attr(attr_name) for env in inner.envs]
        elif isinstance(inner, AsyncVectorEnv):
            values = inner.get_attr(attr_name)
        else:
            values = [getattr(self.vector, attr_name)] * self.num_envs
        return [values[i] for i in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of all environments, as Gymnasium has no way to select some."""
        self._all_of(indices, "set_attr")
        # Gymnasium would distribute the entries of a list or tuple among the environments.
        values = [value] * self.num_envs
        self.vector.unwrapped.set_attr(attr_name, values)  # type: ignore[attr-defined]

    def env_method(
        self, method_name: str, *args: Any, indices: VecEnvIndices = None, **kwargs: Any
    ) -> list[Any]:
        """Call a method of all environments, as Gymnasium has no way to select some."""
        self._all_of(indices, "env_method")
        return list(self.vector.unwrapped.call(method_name, *args, **kwargs))  # type: ignore

    def env_is_wrapped(self, wrapper_class: type, indices: VecEnvIndices = None) -> list[bool]:
        """Return whether each environment has this wrapper; False for those in other processes."""
        envs = getattr(self.vector.unwrapped, "envs", None)
        chosen = list(self._get_indices(indices))
        if not envs or not issubclass(wrapper_class, gym.Wrapper):
            return [False for _ in chosen]
        return [is_wrapped(envs[i], wrapper_class) for i in chosen]

    def _all_of(self, indices: VecEnvIndices, name: str) -> None:
        if list(self._get_indices(indices)) != list(range(self.num_envs)):
            raise ValueError(
                f"{name} of a Gymnasium vector applies to all environments: leave indices out"
            )


def _autoreset_mode(vector: VectorEnv) -> AutoresetMode:
    """Return the autoreset mode; raise a ValueError if first observations come too late."""
    inner, mode = vector.unwrapped, vector.metadata.get("autoreset_mode")
    name = type(inner).__name__
    if mode is None:
        raise ValueError(f"The metadata of this {name} has no autoreset_mode: set it, or {REMEDY}")
    mode = AutoresetMode(mode)
    masked = isinstance(inner, SyncVectorEnv) or (
        isinstance(inner, AsyncVectorEnv) and getattr(inner, "shared_memory", True)
    )
    if mode == AutoresetMode.NEXT_STEP and not masked:
        raise ValueError(
            f"This {name} resets in the step after an episode's end and not by a mask: {REMEDY}"
        )
    return mode


def _at(observations: Any, i: int) -> Any:
    """Return one environment's part of a batch of observations."""
    if isinstance(observations, Mapping):
        return {key: _at(value, i) for key, value in observations.items()}
    return deepcopy(observations[i])


def _of_one(infos: Mapping[str, Any], i: int) -> dict[str, Any]:
    """Return one environment's info; in Gymnasium's arrays, `_key` marks those with a `key`."""
    one = {}
    for key, values in infos.items():
        is_mask = key.startswith("_") and key[1:] in infos
        mask = infos.get(f"_{key}")
        if is_mask or (mask is not None and not mask[i]):
            continue
        if isinstance(values, Mapping):
            one[key] = _of_one(values, i)
        elif isinstance(values, np.ndarray | list | tuple):
            one[key] = values[i]
    return one
