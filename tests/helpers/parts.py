"""Measure what each part of the algorithm changes, on the dot of `make learn`, from scratch.

    python tests/helpers/parts.py --seeds 3             # all parts, a minute of CPU for each run
    python tests/helpers/parts.py --seeds 3 --only repval_scale=0.3 bin_range=7
    python tests/helpers/parts.py --seeds 3 --steps 825 --only imagine_starts=None  # equal CPU time

Every variant changes one keyword (or two that belong together) of the settings of `make learn`, and
learns for 1,000 steps, fewer than `make learn` takes, so that faster and slower learning differ.
The columns are means over the seeds; the first also shows the value of each seed:

* the return of 20 episodes as a share of the known optimum;
* the mean absolute error of the critic's value, against the discounted return that followed;
* the mean absolute error of the reward head on the same episodes, a step;
* the entropy of the actor, in nats, and the CPU seconds.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.evaluation import evaluate_policy

TESTS = Path(__file__).parents[1]
sys.path[:0] = [str(TESTS / "helpers"), str(TESTS / "agents"), str(TESTS.parent)]
from test_learning import SETTINGS
from toy_env import DotEnv, best_return

from wpt_agents import WPT
from wpt_agents.zoo.collect.episodes import record
from wpt_agents.zoo.judge.diagnosis import promises
from wpt_agents.zoo.judge.evaluation import acting

STEPS, EPISODES = 1000, 20
STARTS = range(6)  # 20 steps remain from the last on, and 0.9 ** 20 = 0.12
VARIANTS: dict[str, dict[str, Any]] = {
    "make learn's settings": {},
    "imagine_starts=None": {"imagine_starts": None},
    "data_dependent_init=False": {"data_dependent_init": False},
    "pixel_weight=8": {"pixel_weight": 8.0},
    "ent_coef=linear(1e-2,1e-3,1000)": {"ent_coef": "linear(1e-2,1e-3,1000)"},
    "actor_grad=reinforce": {"actor_grad": "reinforce"},
    "actor_critic_decay=True": {"actor_critic_decay": True},
    "actor_average=0.02": {"actor_average": 0.02},
    "actor_average=0.99": {"actor_average": 0.99},  # nearly the actor itself: shows chance
    "recent_share=0.25": {"recent_share": 0.25},
    "repval_scale=0.3": {"repval_scale": 0.3},
    "slow_critic_scale=1": {"slow_critic_scale": 1.0},
    "bin_range=7": {"bin_range": 7.0},
    "reward_grad=10": {"reward_grad": 10.0},
    "reward_ensemble=3, pessimism=linear(1,0,1000)": {
        "reward_ensemble": 3,
        "pessimism": "linear(1,0,1000)",
    },
}


def measured(seed: int, steps: int, changes: Mapping[str, Any]) -> dict[str, float]:
    """Learn with one seed, and measure the policy and its networks on new episodes."""
    model = WPT("WPTPolicy", DotEnv(), seed=seed, device="cpu", **SETTINGS | changes)
    start = time.process_time()
    model.learn(steps)
    seconds = time.process_time() - start
    mean, _ = evaluate_policy(model, DotEnv(), n_eval_episodes=EPISODES, warn=False)
    value_errors = []
    reward_errors = []
    for episode in range(EPISODES):
        played = record(DotEnv(), acting(model), 1000 + episode)
        errors = model.policy.heldout_errors(played, len(played) + 1)
        reward_errors.append(errors["reward"])
        for promise in promises(model.policy, played, model.gamma, STARTS, 1):
            value_errors.append(abs(promise.value - promise.discounted))
    return {
        "share of the optimum": float(mean) / best_return(EPISODES, seed=0),
        "value error": float(np.mean(value_errors)),
        "reward error": float(np.mean(reward_errors)),
        "entropy": model.logger.name_to_value["train/entropy"],
        "CPU s": seconds,
    }


def main(seeds: int, steps: int, only: list[str]) -> None:
    """Print a row as soon as a variant is measured."""
    for name in only or VARIANTS:
        runs = [measured(seed, steps, VARIANTS[name]) for seed in range(seeds)]
        shares = " ".join(f"{run['share of the optimum']:.2f}" for run in runs)
        means = {column: np.mean([run[column] for run in runs]) for column in runs[0]}
        cells = [f"{means[column]:.3f}" for column in ("value error", "reward error", "entropy")]
        row = [name, f"{means['share of the optimum']:.2f} ({shares})", *cells]
        print("|", " | ".join([*row, f"{means['CPU s']:.0f}"]), "|", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=3, help="the number of seeds")
    parser.add_argument("--steps", type=int, default=STEPS, help="calls of env.step")
    parser.add_argument("--only", nargs="*", default=[], choices=VARIANTS, help="variants")
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    main(arguments.seeds, arguments.steps, arguments.only)
