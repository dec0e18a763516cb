"""Measure what two ways of behaviour cloning change, on tasks of Meta-World.

    for task in drawer-open button-press-topdown-wall door-unlock window-open; do
        python -m wpt_agents.zoo collect --suite metaworld --tasks $task --episodes 20 \
            --rendering fast --out data/$task
    done
    python tests/helpers/clones.py --seeds 3

For each task and seed, two prior actors with the same initial weights are cloned from the 20
episodes, in 2,000 updates of 64 images and actions: with a learning rate of 1e-3 at every update,
and with one that falls linearly from 1e-3 to 0, as the library's does. Each plays the same 20 new
episodes. The columns are success rate and mean return of both, and the CPU seconds of cloning.

With `--compare bc_variance`, the rate falls for both, and the first has `bc_variance="fixed"`, the
second "trajectory". Some settings of the preset `mid` are then

    python tests/helpers/clones.py --compare bc_variance --size mid --retrieve 40 --steps 4000
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


def measured(settings: argparse.Namespace, task: str, seed: int, second: bool) -> str:
    """Clone a prior actor and evaluate it; return its success rate, return and CPU seconds."""
    name = f"wpt/metaworld-{task}-v0"
    of_variance = settings.compare == "bc_variance"
    model = WPT(
        "WPTPolicy",
        gym.make(name, **FAST),
        dataset=settings.data / task,
        size=settings.size,
        max_action_dim=4,
        num_retrieve=settings.retrieve,
        bc_steps=settings.steps,
        bc_batch_size=64,
        bc_learning_rate=1e-3,
        bc_variance="trajectory" if of_variance and second else "fixed",
        seed=seed,
        device="cpu",
    )
    start = time.process_time()
    with nullcontext() if of_variance or second else patch(RATES, constant):
        model.learn(1)  # retrieves, clones, and makes a step of the task
    seconds = time.process_time() - start
    score = evaluate(model.prior, name, FAST, settings.episodes, seed=1000 + seed)
    success = sum(score.successes) / settings.episodes
    return f"{success:.2f} ({sum(score.returns) / settings.episodes:.0f}) {seconds:.0f} s"


def main(settings: argparse.Namespace) -> None:
    """Print a row for each task and seed as soon as both prior actors are measured."""
    for task in settings.tasks:
        for seed in range(settings.first, settings.first + settings.seeds):
            row = [measured(settings, task, seed, second) for second in (False, True)]
            print("|", " | ".join([task, str(seed), *row]), "|", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data"), help="a folder for each task")
    parser.add_argument("--compare", choices=["rate", "bc_variance"], default="rate")
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--size", default="tiny")
    parser.add_argument("--retrieve", type=int, default=20, help="trajectories to clone from")
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--steps", type=int, default=2000, help="updates")
    parser.add_argument("--episodes", type=int, default=20, help="episodes of an evaluation")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    main(arguments)
