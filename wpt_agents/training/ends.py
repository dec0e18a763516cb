"""Ends of episodes: the time limit of an environment, and the last observation."""

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from wpt_agents.training.environments import innermost
from wpt_agents.training.gymnasium_vector import GymnasiumVecEnv

REPEATS = {  # wrappers that repeat actions, and their attribute with the number of repeats
    "RepeatAction": "times",  # of wpt_envs
    "MaxAndSkipEnv": "_skip",  # of Stable-Baselines3
    "MaxAndSkipObservation": "_skip",  # of Gymnasium, as the next one
    "AtariPreprocessing": "frame_skip",
}


def time_limit(env: VecEnv | None) -> int | None:
    """Return the steps after which the environment ends an episode, if it says so.

    Environments in other processes do not tell whether an action repeat divides their limit.
    """
    assert env is not None
    inner = innermost(env)
    vector = inner.vector.unwrapped if isinstance(inner, GymnasiumVecEnv) else inner
    if isinstance(vector, DummyVecEnv | SyncVectorEnv):
        return _limit(vector.envs[0])
    spec = env.get_attr("spec")[0] if env.has_attr("spec") else None
    return getattr(spec, "max_episode_steps", None)


def _limit(env: gym.Env) -> int | None:
    """Return the steps of an episode, counted outside of all wrappers."""
    wrappers: list[gym.Wrapper] = []
    while isinstance(env, gym.Wrapper):
        wrappers.append(env)
        env = env.env
    # The wrapper says the same as the spec, and where it counts.
    counted = any(isinstance(wrapper, TimeLimit) for wrapper in wrappers)
    limit = None if counted else getattr(env.spec, "max_episode_steps", None)
    for wrapper in reversed(wrappers):
        if isinstance(wrapper, TimeLimit):
            most = wrapper._max_episode_steps
            limit = most if limit is None else min(limit, most)
        elif limit is not None and (name := REPEATS.get(type(wrapper).__name__)):
            limit = math.ceil(limit / getattr(wrapper, name))
    return limit


def last_observation(
    env: VecEnv | None, infos: Sequence[Mapping[str, Any]], i: int, first: np.ndarray
) -> np.ndarray:
    """Return the last observation of environment i, from before the VecEnv reset it.

    Stable-Baselines3 names it `terminal_observation`, Gymnasium `final_obs`, before 1.0
    `final_observation`.

    :param first: the first observation after the reset; if both are equal, a warning says so
    :raises ValueError: the info lacks the last observation
    """
    names = ("terminal_observation", "final_obs", "final_observation")
    last = next((infos[i][name] for name in names if infos[i].get(name) is not None), None)
    if last is None:
        raise ValueError(
            f"Environment {i} of the {type(env).__name__} ended an episode without its last "
            "observation: a VecEnv puts it into infos[i]['terminal_observation'] before it resets, "
            "as DummyVecEnv of Stable-Baselines3 does"
        )
    if not isinstance(innermost(env), DummyVecEnv) and np.array_equal(last, first):
        warnings.warn(
            f"Environment {i} showed the same image at the end of an episode and at the start of "
            "the next. If it draws all images into one array, the last image is lost: let it "
            "return observation.copy(), as the agent cannot copy in another process",
            stacklevel=2,
        )
    observation: np.ndarray = last
    return observation
