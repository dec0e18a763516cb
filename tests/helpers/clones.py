"""Compare ways of behaviour cloning, on tasks of Meta-World.

    for task in drawer-open button-press-topdown-wall door-unlock window-open; do
        python -m wpt_agents.zoo collect --suite metaworld --tasks $task --episodes 20 \
            --rendering fast --out data/$task
    done
    python tests/helpers/clones.py --seeds 3

For each task and seed, prior actors with the same initial weights are cloned from the same
episodes, in updates of 64 images and actions, and play the same new episodes. The columns are the
success rate and mean return of each variant, and the CPU seconds of cloning. A variant is keywords
of `WPT`, or `constant`: a learning rate of 1e-3 at every update instead of one that falls linearly
from 1e-3 to 0, as the library's does. Without further options, `constant` is compared with the
library's defaults. The sizes of the preset `mid` are, on data of 60 episodes:

    python tests/helpers/clones.py --tasks push-wall --size mid --retrieve 40 --steps 4000 \
        --variants "" bc_shift=1 bc_variance=trajectory "bc_shift=1 bc_variance=trajectory"
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
import yaml
from torch.optim.lr_scheduler import ConstantLR

from wpt_agents import WPT
from wpt_agents.zoo.judge.evaluation import evaluate

TASKS = ["drawer-open", "button-press-topdown-wall", "door-unlock", "window-open"]
FAST = {"rendering": "fast"}
RATES = "wpt_agents.training.cloning.LinearLR"


def constant(optimizer: torch.optim.Optimizer, *_: float) -> ConstantLR:
    """Return a schedule that does not change the learning rate."""
    return ConstantLR(optimizer, factor=1.0)


def measured(settings: argparse.Namespace, task: str, seed: int, variant: str) -> str:
    """Clone a prior actor and evaluate it; return its success rate, return and CPU seconds."""
    name = f"wpt/metaworld-{task}-v0"
    words = [word for word in variant.split() if word != "constant"]
    keywords = {"num_retrieve": settings.retrieve, "bc_steps": settings.steps}
    keywords |= {key: yaml.safe_load(value) for key, value in (w.split("=") for w in words)}
    model = WPT(
        "WPTPolicy",
        gym.make(name, **FAST),
        dataset=settings.data / task,
        size=settings.size,
        max_action_dim=4,
        bc_batch_size=64,
        bc_learning_rate=1e-3,
        seed=seed,
        device="cpu",
        **keywords,
    )
    start = time.process_time()
    with patch(RATES, constant) if "constant" in variant else nullcontext():
        model.learn(1)  # retrieves, clones, and makes a step of the task
    seconds = time.process_time() - start
    score = evaluate(model.prior, name, FAST, settings.episodes, seed=1000 + seed)
    success = sum(score.successes) / settings.episodes
    return f"{success:.2f} ({sum(score.returns) / settings.episodes:.0f}) {seconds:.0f} s"


def main(settings: argparse.Namespace) -> None:
    """Print a row for each task and seed as soon as all prior actors are measured."""
    for task in settings.tasks:
        for seed in range(settings.first, settings.first + settings.seeds):
            row = [measured(settings, task, seed, variant) for variant in settings.variants]
            print("|", " | ".join([task, str(seed), *row]), "|", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("data"), help="a folder for each task")
    parser.add_argument("--variants", nargs="+", default=["constant", ""], help="the columns")
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
