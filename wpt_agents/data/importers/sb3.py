"""Replay buffers of Stable-Baselines3: a ring of transitions for each of several environments.

Action t was taken at observation t, and is in [-1, 1] already: SB3 stores it rescaled. With
`optimize_memory_usage` the observation after an episode's last action is overwritten, so that
action is dropped, and no terminal state is seen.
"""

import os
import pickle
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl

from wpt_agents.data.importers.episodes import Episodes, warn_left_out
from wpt_agents.data.trajectory import Trajectory


class SB3Episodes(Episodes):
    """A replay buffer's episodes, environment by environment, oldest first.

    :param buffer: in memory, or a file of `model.save_replay_buffer`
    :param trust: load a file; SB3's files are pickles, which can run any code
    :param options: those of `Episodes`; `image_key` chooses from dictionary observations
    """

    def __init__(
        self,
        buffer: ReplayBuffer | str | os.PathLike[str],
        trust: bool = False,
        **options: Any,
    ) -> None:
        super().__init__(**options)
        self._refuse_done_key("SB3")
        if self.action_keys:
            raise ValueError(
                "SB3's replay buffers have only one array of actions; leave action_key out"
            )
        if isinstance(buffer, str | os.PathLike):
            buffer = _load(buffer, trust)
        if not isinstance(buffer, ReplayBuffer):
            raise ValueError(f"Expected a ReplayBuffer of SB3, got {type(buffer).__name__}")
        if not isinstance(buffer.action_space, spaces.Box):
            raise ValueError(f"The buffer's actions are {buffer.action_space}; they must be a Box")
        self._buffer = buffer
        # SB3 stores actions of several axes as one
        self._limits = np.ravel(buffer.action_space.low), np.ravel(buffer.action_space.high)
        self._overwritten = bool(getattr(buffer, "optimize_memory_usage", False))
        first = buffer.pos if buffer.full else 0
        # from the oldest row: in a full ring it is the one to be overwritten next
        self._rows = (first + np.arange(buffer.size())) % buffer.buffer_size
        if self._overwritten and buffer.full:
            self._rows = self._rows[
                1:
            ]  # the oldest row contains the next observation of the newest
        self._bounds = [b for env in range(buffer.n_envs) for b in self._find_bounds(env)]
        if not self._bounds:
            raise ValueError("The replay buffer holds no episode")

    def _find_bounds(self, env: int) -> list[tuple[int, int, int]]:
        """Return the environment, the first row by age, and one past the last, for each episode."""
        ends = np.flatnonzero(self._buffer.dones[self._rows, env]) + 1
        cuts = [0], ends, self._find_resets(env), [len(self._rows)]
        edges = np.unique(np.concatenate(cuts).astype(int)).tolist()
        shortest = 2 if self._overwritten else 1
        bounds = [(env, a, b) for a, b in pairwise(edges) if b - a >= shortest]
        warn_left_out(len(edges) - 1 - len(bounds), f"SB3 replay buffer, environment {env}")
        return bounds

    def _find_resets(self, env: int) -> list[int]:
        """Return the rows at which `learn` was called again, after an unfinished episode."""
        if self._overwritten:
            return []
        seen = self._images(self._buffer.observations)
        led_to = self._images(self._buffer.next_observations)
        steps = enumerate(pairwise(self._rows), start=1)
        return [i for i, (a, b) in steps if not np.array_equal(led_to[a, env], seen[b, env])]

    def __len__(self) -> int:
        return len(self._bounds)

    def __getitem__(self, i: int) -> Trajectory:
        env, start, stop = self._bounds[i]
        rows, buffer = self._rows[start:stop], self._buffer
        image = self._images(buffer.observations)[rows, env]
        terminated = False
        if self._overwritten:
            rows = rows[:-1]
        else:
            last = self._images(buffer.next_observations)[rows[-1:], env]
            image = np.concatenate([image, last])
            # a time limit is not a terminal state
            over = buffer.dones[rows[-1], env] and not buffer.timeouts[rows[-1], env]
            terminated = bool(over)
        source = f"SB3 replay buffer, environment {env}, steps {start} to {stop - 1}"
        action = buffer.actions[rows, env]
        reward = buffer.rewards[rows, env]
        trajectory = self._trajectory(image, action, reward, source, terminated=terminated)
        # SB3 has rescaled the actions already, from the bounds of the environment's space.
        known = self.limits is None and np.isfinite(self._limits).all()
        return replace(trajectory, bounds=np.stack(self._limits)) if known else trajectory

    def _images(self, observations: Any) -> np.ndarray:
        if not isinstance(observations, dict):
            return np.asarray(observations)
        if self.image_key not in observations:
            raise ValueError(
                f"The replay buffer's observations are {', '.join(observations)}; pass image_key: "
                "TrajectoryDataset.from_sb3(buffer, path, image_key=...)"
            )
        return np.asarray(observations[self.image_key])


def _load(path: str | os.PathLike[str], trust: bool) -> ReplayBuffer:
    if not trust:
        raise ValueError(
            f"{path} is a pickle, as SB3 saves replay buffers, and loading it can run any "
            "code; if you trust it, pass trust=True (--trust)"
        )
    try:
        with open(path, "rb") as file:
            loaded: ReplayBuffer = load_from_pkl(file)
            return loaded
    except (OSError, EOFError, pickle.UnpicklingError) as error:
        raise ValueError(f"{path} cannot be read as a replay buffer of SB3: {error}") from error
