"""A dot to be pushed to a target: pixels in, two actions out, and an optimum that is known."""

from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces

SPEED = 0.2  # of the dot along each axis, in a step; positions are in [-1, 1]
LENGTH = 25


class DotEnv(gym.Env):
    """Each axis moves by SPEED times its action; the reward is 1 at the target, 0 at distance 2."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = "rgb_array", size: int = 64, actions: int = 2):
        self.render_mode, self.size = render_mode, size
        self.observation_space = spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.dot, self.target = self.np_random.uniform(-0.9, 0.9, 2), np.array([0.5, 0.5])
        self.time = 0
        return self.render(), {}

    def step(self, action: np.ndarray):
        self.dot = np.clip(self.dot + SPEED * np.clip(action[:2], -1, 1), -1, 1)
        self.time += 1
        return self.render(), self.reward(), False, self.time >= LENGTH, {}

    def reward(self) -> float:
        return float(max(0.0, 1 - np.linalg.norm(self.dot - self.target) / 2))

    def render(self) -> np.ndarray:
        image = np.full((self.size, self.size, 3), 30, np.uint8)
        disc, dot = (self.target, 9, (40, 160, 60)), (self.dot, 5, (250, 250, 250))
        for place, half, colour in (disc, dot):
            row, column = ((place + 1) / 2 * (self.size - 1)).round().astype(int)
            rows = slice(max(row - half, 0), row + half + 1)
            image[rows, max(column - half, 0) : column + half + 1] = colour
        return image


def best_action(env: DotEnv) -> np.ndarray:
    """Straight to the target, each axis as fast as it may: no policy earns more."""
    return np.clip((env.target - env.dot) / SPEED, -1, 1).astype(np.float32)


def best_return(episodes: int, seed: int) -> float:
    """The mean return of the optimal policy."""
    env, total = DotEnv(), 0.0
    for episode in range(episodes):
        env.reset(seed=seed + episode)
        total += sum(env.step(best_action(env))[1] for _ in range(LENGTH))
    return total / episodes
