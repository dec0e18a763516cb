"""Learn a task whose episodes end when the robot falls, with and without a continue head.

    python examples/episodes_that_end.py --env InvertedPendulum-v5 --seeds 2

The reward of such tasks is nearly constant, so the return depends on the length of the episode. A
continue head predicts from the world model's state whether the episode goes on, so that
imagined returns end where the episode would. `WPT` adds one automatically once an episode has
terminated; this script switches it off for comparison.
"""

import argparse
from typing import Any

import gymnasium as gym
import numpy as np
import wpt_envs
from stable_baselines3.common.evaluation import evaluate_policy

from wpt_agents import WPT

SETTINGS: dict[str, Any] = {
    "size": "tiny",
    "batch_length": 16,
    "imagine_horizon": 15,
    "imagine_starts": 64,
    "gamma": 0.97,
    "ent_coef": 3e-3,
    "actor_critic_learning_rate": 1e-3,
    "target_fraction": 0.1,
    "train_ratio": 32,
    "learning_starts": 500,
    "warmup_steps": 500,
}


def make_env(env_id: str) -> gym.Env:
    """Make a MuJoCo environment of Gymnasium, seen from 64 x 64 pixels."""
    return wpt_envs.pixels(gym.make(env_id, render_mode="rgb_array"), rendering="fast")


def main(env_id: str, steps: int, seeds: int, **changes: Any) -> dict[str, list[float]]:
    """Learn with both settings and every seed.

    :return: the mean return of 20 episodes by seed, for both settings
    """
    env = make_env(env_id)
    settings = SETTINGS | {"max_action_dim": env.action_space.shape[0]} | changes
    returns: dict[str, list[float]] = {"without": [], "with": []}
    for seed in range(seeds):
        for name, head in (("without", False), ("with", True)):
            off = {"offline_ratio": 0, "guidance": 0, "continue_head": head, "seed": seed}
            model = WPT("WPTPolicy", make_env(env_id), **settings | off)
            model.learn(steps, progress_bar=True)
            mean, _ = evaluate_policy(model, make_env(env_id), n_eval_episodes=20, warn=False)
            returns[name].append(float(mean))
            print(f"{env_id}, seed {seed}, {name} a continue head: return {mean:.1f}", flush=True)
    for name, values in returns.items():
        print(f"{name} a continue head: {np.mean(values):.1f}")
    return returns


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="InvertedPendulum-v5", help="a MuJoCo environment")
    parser.add_argument("--steps", type=int, default=6000, help="calls of env.step")
    parser.add_argument("--seeds", type=int, default=1, help="the number of seeds")
    arguments = parser.parse_args()
    main(arguments.env, arguments.steps, arguments.seeds)
