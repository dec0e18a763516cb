"""Compare a pre-trained agent with learning from scratch, over several seeds.

    python examples/compare_baseline.py --seeds 3 --steps 1500

The data are episodes of random actions in the environment of custom_environment.py, without
rewards. Each mean has the zoo's 95 % interval over seeds. `python -m wpt_agents.zoo run` makes such
comparisons for the tasks of the library.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from custom_environment import SETTINGS, PushDot
from stable_baselines3.common.evaluation import evaluate_policy

from wpt_agents import WPT, Trajectory, TrajectoryDataset
from wpt_agents.zoo.statistics import mean_interval


def record(folder: Path, episodes: int) -> TrajectoryDataset:
    """Play random actions and store images and actions, without the rewards."""
    env = PushDot()
    env.action_space.seed(0)
    dataset = TrajectoryDataset.open_or_create(folder)
    for episode in range(len(dataset), episodes):
        images = [env.reset(seed=episode)[0]]
        actions = [env.action_space.sample() for _ in range(25)]
        images += [env.step(action)[0] for action in actions]
        dataset.append(Trajectory(np.stack(images), np.stack(actions), embodiment="dot"))
    dataset.close()
    return TrajectoryDataset.open(folder)


def main(
    seeds: int, steps: int, folder: Path, pretrain_steps: int = 1000, **changes: Any
) -> dict[str, list[float]]:
    """Pre-train once, learn with every seed, and return each method's mean return by seed."""
    settings = SETTINGS | changes
    dataset = record(folder, episodes=40)
    off = {"offline_ratio": 0, "guidance": 0}
    world_model = WPT.pretrain(dataset, steps=pretrain_steps, **settings)
    world_model.save(folder.parent / "world-model.zip")
    scores: dict[str, list[float]] = {"pre-trained": [], "from scratch": []}
    for seed in range(seeds):
        # pre-training alone: the random data have nothing to imitate or to rehearse
        pretrained = WPT.load(folder.parent / "world-model.zip", env=PushDot(), seed=seed, **off)
        scratch = WPT("WPTPolicy", PushDot(), **(settings | off | {"seed": seed}))
        for name, model in (("pre-trained", pretrained), ("from scratch", scratch)):
            model.learn(steps)
            mean, _ = evaluate_policy(model, PushDot(), n_eval_episodes=10, warn=False)
            scores[name].append(float(mean))
    for name, values in scores.items():
        mean, low, high = mean_interval(values)  # by Student's t over seeds, from three seeds on
        interval = "" if low is None else f" (95 % interval {low:.1f} to {high:.1f})"
        print(f"{name}: {mean:.1f}{interval}, seeds {np.round(values, 1).tolist()}")
    return scores


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds")
    parser.add_argument("--steps", type=int, default=1500, help="calls of env.step")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/comparison/data"), help="the recorded data"
    )
    arguments = parser.parse_args()
    main(arguments.seeds, arguments.steps, arguments.folder)
