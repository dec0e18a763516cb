"""Untrained policies: the zero action, and uniformly random actions."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import PolicyPredictor

from wpt_agents.zoo.result import NOTHING, RANDOM

Observation = np.ndarray | dict[str, np.ndarray]
State = tuple[np.ndarray, ...]


@dataclass(frozen=True)
class DoNothing:
    """A policy that always returns zeros."""

    action_space: spaces.Box

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State | None]:
        """Return zeros, (n, A)."""
        return np.zeros((len(observation), *self.action_space.shape), np.float32), None


class RandomPolicy:
    """A policy with uniform actions in the action space."""

    def __init__(self, action_space: spaces.Box, seed: int) -> None:
        self.action_space = action_space
        self.rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State | None]:
        """Return uniform actions, (n, A), regardless of `deterministic`."""
        low, high = self.action_space.low, self.action_space.high
        return self.rng.uniform(low, high, (len(observation), len(low))).astype(np.float32), None


BASELINES: Mapping[str, Callable[[spaces.Box, int], PolicyPredictor]] = {
    NOTHING: lambda space, seed: DoNothing(space),
    RANDOM: RandomPolicy,
}
