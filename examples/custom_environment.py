"""Wrap an environment of your own, learn in it from scratch, and evaluate the policy.

    python examples/custom_environment.py --steps 3000

The environment shows a dot that two actions push towards a target. `WPT` needs images as
observations and a `Box` with finite bounds as actions; all else is standard Gymnasium.
"""

import argparse
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.evaluation import evaluate_policy

from wpt_agents import WPT

# Small networks and short sequences learn this task in minutes; the defaults are the paper's.
SETTINGS: dict[str, Any] = {
    "size": "tiny",
    "max_action_dim": 2,
    "batch_length": 8,
    "imagine_horizon": 10,
    "gamma": 0.9,
    "ent_coef": 3e-3,
    "target_fraction": 0.1,
    "train_ratio": 32,
    "learning_starts": 250,
    "warmup_steps": 250,
    "seed": 0,
}


class PushDot(gym.Env):
    """Push a dot to a target. The reward is 1 at the target and 0 at distance 2."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str = "rgb_array") -> None:
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Put the dot at a random position."""
        super().reset(seed=seed)
        self.dot = self.np_random.uniform(-0.9, 0.9, 2)
        self.target = np.array([0.5, 0.5])
        self.time = 0
        return self.render(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Move the dot; an episode lasts 25 steps."""
        self.dot = np.clip(self.dot + 0.2 * action, -1, 1)
        self.time += 1
        distance = float(np.linalg.norm(self.dot - self.target))
        info = {"is_success": distance < 0.2}
        return self.render(), max(0.0, 1 - distance / 2), False, self.time >= 25, info

    def render(self) -> np.ndarray:
        """Draw the target in green and the dot in white: (64, 64, 3) uint8."""
        image = np.full((64, 64, 3), 30, np.uint8)
        for place, half, colour in ((self.target, 9, (40, 160, 60)), (self.dot, 5, (250,) * 3)):
            row, column = ((place + 1) / 2 * 63).round().astype(int)
            rows = slice(max(row - half, 0), row + half + 1)
            image[rows, max(column - half, 0) : column + half + 1] = colour
        return image


def main(steps: int, **changes: Any) -> float:
    """Learn for some steps and return the mean return of ten episodes."""
    settings = SETTINGS | changes
    model = WPT("WPTPolicy", PushDot(), offline_ratio=0, guidance=0, verbose=1, **settings)
    model.learn(steps, progress_bar=True)
    mean, deviation = evaluate_policy(model, PushDot(), n_eval_episodes=10, warn=False)
    print(f"return {mean:.1f} +- {deviation:.1f} of at most 25")
    return float(mean)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=3000, help="calls of env.step")
    main(parser.parse_args().steps)
