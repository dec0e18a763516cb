"""Seeded copies of a task, whose episodes do not depend on those before them."""

import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

Wrap = Callable[[VecEnv], VecEnv]
EPISODE = 2  # distinguishes these seeds from those of `plan.runs.EVALUATION`


def unwrapped(venv: VecEnv) -> VecEnv:
    """Return the environments themselves, for agents that need no wrapper."""
    return venv


class EpisodeSeeds(gym.Wrapper):
    """Seed each reset with the number of the episode, so that episodes are independent.

    A seed passed to `reset` is that of episode 0; the seeds of all others are derived from it.
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.seed = 0
        self.episode = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start the next episode."""
        self.seed = self.seed if seed is None else seed
        return self.env.reset(seed=self.next_seed(), options=options)

    def next_seed(self) -> int:
        """Return the seed of the next episode, and count that episode as started."""
        drawn = np.random.SeedSequence([self.seed, EPISODE, self.episode]).generate_state(1)
        self.episode += 1
        return int(drawn[0] >> 1) if self.episode > 1 else self.seed

    def go_to_episode(self, number: int) -> None:
        """Make the next reset start episode `number`."""
        self.episode = number


def make_vec_env(
    task: str,
    env: Mapping[str, Any],
    seed: int,
    n_envs: int = 1,
    monitor: str | None = None,
    workers: bool = False,
) -> VecEnv:
    """Make seeded copies of a task, each under SB3's Monitor.

    :param monitor: the Monitor file, which is continued if it exists
    :param workers: whether to run each copy in its own process
    """
    new = monitor is None or not Path(monitor).exists()
    row = wpt_envs.TASKS.get(task)
    logged = ("is_success",) if row is not None and row.metric == "success" else ()

    def make() -> gym.Env:
        import wpt_envs  # noqa: F401  # registers the ids in worker processes

        if workers:  # a terminal sends Ctrl-C to them, too, and the episode is yet to be completed
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        made = EpisodeSeeds(gym.make(task, **env))
        return Monitor(made, monitor, info_keywords=logged, override_existing=new)

    venv = SubprocVecEnv([make] * n_envs) if workers else DummyVecEnv([make] * n_envs)
    venv.seed(seed)
    return venv
