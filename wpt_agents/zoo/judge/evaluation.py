"""Evaluate a policy: its returns over seeded episodes, and a video of one of them."""

import math
from collections.abc import Mapping
from contextlib import closing
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.collect.behaviours import Act
from wpt_agents.zoo.collect.policies import executed
from wpt_agents.zoo.judge.untrained import State
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.terminal import progress
from wpt_agents.zoo.vec_envs import Wrap, make_vec_env, unwrapped

PARALLEL = 50  # simulators at once in an evaluation, to bound the memory


def episode_steps(task: str, env: Mapping[str, Any]) -> int | None:
    """Return the number of `env.step` calls in an episode of the task, None if unknown."""
    row = wpt_envs.TASKS.get(task)
    if row is None:
        return None
    return math.ceil(row.frames / env.get("action_repeat", row.action_repeat))


def evaluate(
    policy: PolicyPredictor,
    task: str,
    env: Mapping[str, Any],
    episodes: int,
    seed: int,
    label: str = "",
    wrap: Wrap = unwrapped,
) -> Score:
    """Play `episodes` episodes, up to `PARALLEL` at once, each with its own seed.

    Policies that are evaluated with the same `seed` start from the same initial states.

    :param wrap: the wrapper that the policy needs around its environments
    :return: the score of the episodes in the order of their seeds, `seed`, `seed + 1`, ...
    """
    returns: list[float] = []
    successes: dict[int, bool] = {}  # by episode: those of a batch may end in any order
    successes_any: dict[int, bool] = {}
    first, ended = 0, list[int]()  # of a batch: its first episode, and those that have ended
    steps = episode_steps(task, env)
    with progress(steps and steps * episodes, f"evaluate {label}".strip(), "steps") as bar:

        def watch(local: dict[str, Any], _: dict[str, Any]) -> None:
            bar.update(1)
            if not local["done"]:
                return
            episode, info = first + local["i"], local["info"]
            ended.append(episode)
            if "is_success" in info:
                successes[episode] = bool(info["is_success"])
            if "success_any" in info:
                successes_any[episode] = bool(info["success_any"])

        for first in range(0, episodes, PARALLEL):
            ended.clear()
            number = min(PARALLEL, episodes - first)
            venv = make_vec_env(task, env, seed + first, number)
            with closing(wrap(venv)) as wrapped:
                earned, _ = evaluate_policy(
                    policy, wrapped, number, callback=watch, return_episode_rewards=True
                )
            returns += np.asarray(earned, float)[np.argsort(ended)].tolist()
    reached, ever = ([by[i] for i in sorted(by)] for by in (successes, successes_any))
    return Score(tuple(returns), tuple(reached), tuple(ever))


class NoisyPolicy:
    """A policy with Gaussian noise on its actions, to see how precise they have to be.

    As in training, the policy's recurrent state is that of the actions with noise.

    :param policy: its actions are in [-1, 1], as those of all tasks of the zoo
    :param std: standard deviation of the noise; actions are clipped to [-1, 1] afterwards
    :param seed: seed of the noise
    """

    def __init__(self, policy: PolicyPredictor, std: float, seed: int) -> None:
        self.policy, self.std = policy, std
        self.rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return the policy's action with noise, and its next state."""
        action, state = self.policy.predict(observation, state, episode_start, deterministic)
        noise = self.std * self.rng.standard_normal(action.shape)
        noisy = np.clip(action + noise, -1, 1).astype(action.dtype)
        return noisy, executed(self.policy, state, noisy)


def acting(policy: PolicyPredictor) -> Act:
    """Return a function for `record` that keeps the policy's recurrent state in an episode."""
    state: State | None = None

    def act(obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
        nonlocal state
        start = np.array([step == 0])
        action, state = policy.predict(obs[None], state, start, deterministic=True)
        return action[0]

    return act


def film(
    policy: PolicyPredictor,
    task: str,
    env: Mapping[str, Any],
    seed: int,
    size: int = 256,
    wrap: Wrap = unwrapped,
) -> tuple[Trajectory, list[np.ndarray], float]:
    """Play one episode and render it.

    :param wrap: the wrapper that the policy needs around its environment
    :return: the episode, its frames at `size`, and the frame rate of real time
    """
    made = gym.make(task, render_mode="rgb_array", render_size=size, **env)
    filmed = Remembering(made)
    single: VecEnv = DummyVecEnv([lambda: filmed])
    act = acting(policy)
    frames: list[np.ndarray] = []
    actions: list[np.ndarray] = []
    rewards: list[float] = []
    with closing(wrap(single)) as venv:
        assert isinstance(venv.action_space, spaces.Box)
        venv.seed(seed)
        obs: Any = venv.reset()
        done = False
        while not done:
            frames.append(np.asarray(filmed.render()))
            actions.append(np.asarray(act(obs[0], {}, len(actions)), np.float32))
            obs, reward, dones, (info,) = venv.step(actions[-1][None])
            rewards.append(reward[0])
            done = bool(dones[0])
    images = filmed.images[:-1]  # without the image of the automatic reset
    terminated = not info["TimeLimit.truncated"]
    trajectory = Trajectory(
        np.stack(images), np.stack(actions), np.array(rewards, np.float32), terminated
    )
    return trajectory, frames, float(made.metadata.get("render_fps", 25))


class Remembering(gym.ObservationWrapper):
    """Record every image of the environment, regardless of outer wrappers."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.images: list[np.ndarray] = []

    def observation(self, observation: np.ndarray) -> np.ndarray:
        """Record and return the image."""
        self.images.append(observation)
        return observation
