"""How good a policy is: returns over seeded episodes, their mean and its 95 % interval."""

from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.collect.behaviours import Act
from wpt_agents.zoo.collect.episodes import record
from wpt_agents.zoo.judge.untrained import State
from wpt_agents.zoo.result import Score
from wpt_agents.zoo.terminal import progress

EPISODE = 2  # a purpose in a seed's derivation, beside `plan.EVALUATION`


class EpisodeSeeds(gym.Wrapper):
    """Seeds each reset by the number of the episode, so that an episode depends on none before it.

    A seed given to `reset` is that of episode 0, and those of all others are derived from it.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.seed, self.episode = 0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins the next episode."""
        self.seed = self.seed if seed is None else seed
        return self.env.reset(seed=self.next_seed(), options=options)

    def next_seed(self) -> int:
        """The seed of the next episode, which counts as begun."""
        drawn = np.random.SeedSequence([self.seed, EPISODE, self.episode]).generate_state(1)
        self.episode += 1
        return int(drawn[0] >> 1) if self.episode > 1 else self.seed

    def go_to_episode(self, number: int) -> None:
        """The next reset begins episode `number`."""
        self.episode = number


def make_vec_env(
    task: str,
    env: Mapping[str, Any],
    seed: int,
    n_envs: int = 1,
    monitor: str | None = None,
    workers: bool = False,
) -> VecEnv:
    """Seeded copies of a task, each under SB3's Monitor.

    :param monitor: the file of its episodes, which is continued if it is there
    :param workers: give each a process of its own
    """
    anew = monitor is None or not Path(monitor).exists()
    row = wpt_envs.TASKS.get(task)
    told = ("is_success",) if row is not None and row.metric == "success" else ()

    def make() -> gym.Env:
        import wpt_envs  # noqa: F401  # a worker process knows the ids from it

        made = EpisodeSeeds(gym.make(task, **env))
        return Monitor(made, monitor, info_keywords=told, override_existing=anew)

    venv = SubprocVecEnv([make] * n_envs) if workers else DummyVecEnv([make] * n_envs)
    venv.seed(seed)
    return venv


def episode_steps(task: str, env: Mapping[str, Any]) -> int | None:
    """How many calls of `env.step` an episode of the task lasts, when known."""
    row = wpt_envs.TASKS.get(task)
    return row.frames // env.get("action_repeat", 2) if row else None


def evaluate(
    policy: PolicyPredictor,
    task: str,
    env: Mapping[str, Any],
    episodes: int,
    seed: int,
    label: str = "",
) -> Score:
    """Returns over `episodes` episodes, each with its own seed, all played side by side.

    Policies evaluated with one `seed` meet the same initial states.
    """
    successes: list[bool] = []
    venv = make_vec_env(task, env, seed, episodes)
    steps = episode_steps(task, env)
    with (
        closing(venv),
        progress(steps and steps * episodes, f"evaluate {label}".strip(), "steps") as bar,
    ):

        def watch(local: dict[str, Any], _: dict[str, Any]) -> None:
            bar.update(1)
            if local["done"] and "is_success" in local["info"]:
                successes.append(bool(local["info"]["is_success"]))

        returns, _ = evaluate_policy(
            policy, venv, episodes, callback=watch, return_episode_rewards=True
        )
    return Score(np.asarray(returns, float).tolist(), successes)


def acting(policy: PolicyPredictor) -> Act:
    """A policy as `record` plays it: remembers the recurrent state within an episode."""
    state: State | None = None

    def act(obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
        nonlocal state
        start = np.array([step == 0])
        action, state = policy.predict(obs[None], state, start, deterministic=True)
        return action[0]

    return act


def film(
    policy: PolicyPredictor, task: str, env: Mapping[str, Any], seed: int, size: int = 256
) -> tuple[Trajectory, list[np.ndarray], float]:
    """One episode, its pictures at `size`, and the frames a second that make it real time."""
    frames: list[np.ndarray] = []
    act = acting(policy)
    with closing(gym.make(task, render_mode="rgb_array", render_size=size, **env)) as filmed:

        def act_and_look(obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
            frames.append(np.asarray(filmed.render()))
            return act(obs, info, step)

        trajectory = record(filmed, act_and_look, seed)
        return trajectory, frames, float(filmed.metadata.get("render_fps", 25))
