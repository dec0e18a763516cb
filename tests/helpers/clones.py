"""Measure what the falling learning rate of behaviour cloning changes, on tasks of Meta-World.

    for task in drawer-open button-press-topdown-wall door-unlock window-open; do
        python -m wpt_agents.zoo collect --suite metaworld --tasks $task --episodes 20 \
            --rendering fast --out data/$task
    done
    python tests/helpers/clones.py --seeds 3

For each task and seed, two prior actors with the same initial weights are cloned from the 20
episodes, in 2,000 updates of 64 images and actions: with a learning rate of 1e-3 at every update,
and with one that falls linearly from 1e-3 to 0, as the library's does. Each plays the same 20 new
episodes. The columns are success rate and mean return of both, and the CPU seconds of cloning.
"""

import argparse
import time
import warnings
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import patch

import gymnasium as gym
import torch
import wpt_envs  # noqa: F401  # registers the ids
from torch.optim.lr_scheduler import ConstantLR

from wpt_agents import WPT
from wpt_agents.zoo.judge.evaluation import evaluate

TASKS = ["drawer-open", "button-press-topdown-wall", "door-unlock", "window-open"]
FAST = {"rendering": "fast"}
RATES = "wpt_agents.training.cloning.LinearLR"


def constant(optimizer: torch.optim.Optimizer, *_: float) -> ConstantLR:
    """Return a schedule that does not change the learning rate."""
    return ConstantLR(optimizer, factor=1.0)


def measured(data: Path, task: str, seed: int, falls: bool, steps: int, episodes: int) -> str:
    """Clone a prior actor and evaluate it; return its success rate, return and CPU seconds."""
    name = f"wpt/metaworld-{task}-v0"
    model = WPT(
        "WPTPolicy",
        gym.make(name, **FAST),
        dataset=data / task,
        size="tiny",
        max_action_dim=4,
        num_retrieve=20,
        bc_steps=steps,
        bc_batch_size=64,
        bc_learning_rate=1e-3,
        seed=seed,
        device="cpu",
    )
    start = time.process_time()
    with nullcontext() if falls else patch(RATES, constant):
        model.learn(1)  # retrieves, clones, and makes a step of the task
    seconds = time.process_time() - start
    score = evaluate(model.prior, name, FAST, episodes, seed=1000 + seed)
    success = sum(score.successes) / episodes
    return f"{success:.2f} ({sum(score.returns) / episodes:.0f}) {seconds:.0f} s"


def main(data: Path, tasks: list[str], seeds: range, steps: int, episodes: int) -> None:
    """Print a row for each task and seed as soon as both prior actors are measured."""
    for task in tasks:
        for seed in seeds:
            row = [measured(data, task, seed, falls, steps, episodes) for falls in (False, True)]
            print("|", " | ".join([task, str(seed), *row]), "|", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data"), help="a folder for each task")
    parser.add_argument("--tasks", nargs="+", default=TASKS, choices=TASKS)
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--steps", type=int, default=2000, help="updates")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of an evaluation")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    chosen = range(arguments.first, arguments.first + arguments.seeds)
    main(arguments.data, arguments.tasks, chosen, arguments.steps, arguments.episodes)
