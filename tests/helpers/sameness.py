"""Print hashes of what every agent learns and does, to show that a refactoring changes no number.

Run it before and after a change, on the same machine::

    python tests/helpers/sameness.py > before.txt
    python tests/helpers/sameness.py > after.txt
    diff before.txt after.txt

Each line names an agent and holds a hash of its losses and weights after 20 updates, or of its
actions over 200 steps. `--values` prints every loss beside the hash, to see by how much it differs.
Names of agents restrict it to these.
"""

import argparse
import hashlib
import sys
import warnings
from collections import defaultdict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
from debug_agent import SETTINGS, ClockEnv, agent, pretrained, recorded
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import DotEnv

from wpt_agents import WPT, TrajectoryDataset
from wpt_agents.agents.curious import EXPLORERS

UPDATES, STEPS = 20, 200
DATA = [recorded(seed=seed, length=12) for seed in range(6)]
# Everything that a keyword adds to the losses of the paper, with and without gradient in dreams.
FURTHER = {
    "kickstart": "linear(20,2,100)",
    "actor_delay": 3,
    "residual": True,
    "imitation_grad": 300.0,
    "reward_grad": 1.0,
    "reward_ensemble": 3,
    "pessimism": "linear(2,0,100)",
    "ent_coef": "linear(3e-3,3e-4,100)",
    "repval_scale": 0.3,
    "slow_critic_scale": 1.0,
    "return_norm": True,
    "actor_average": 0.1,
    "actor_critic_decay": True,
    "pixel_weight": 8.0,
}


def digest(tensors: Mapping[str, torch.Tensor]) -> str:
    """Return a short hash of names, shapes and bytes."""
    sha = hashlib.sha256()
    for name, tensor in sorted(tensors.items()):
        array = tensor.detach().cpu().contiguous().numpy()
        sha.update(f"{name}{array.shape}{array.dtype}".encode())
        sha.update(array.tobytes())
    return sha.hexdigest()[:16]


def weights(model: WPT) -> dict[str, torch.Tensor]:
    """Return all weights of a model."""
    return dict(model.policy.state_dict())


def updated(model: WPT) -> dict[str, torch.Tensor]:
    """Make 20 updates; return the losses of each."""
    metrics: dict[str, list[torch.Tensor]] = defaultdict(list)
    for _ in range(UPDATES):
        model.update(metrics)
    return {name: torch.stack(values) for name, values in metrics.items()}


def learnt(
    method: Mapping[str, object], env: ClockEnv | DummyVecEnv | None = None
) -> tuple[WPT, dict[str, torch.Tensor]]:
    """Pre-train if the method has data, learn for a few episodes, then make 20 updates."""
    if "dataset" in method:
        model = pretrained(**method)
    else:
        model = agent(**method)
    model.set_env(env or DotEnv())
    model.learn(60)
    model._total_timesteps = 100  # rates that fall over `learn` would be 0 at its end
    return model, updated(model)


def pretraining(**options: Any) -> tuple[WPT, dict[str, torch.Tensor]]:
    """Pre-train for 20 updates; return the losses of each."""
    metrics: dict[str, list[torch.Tensor]] = defaultdict(list)

    def note(step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            metrics[name].append(torch.tensor(value, dtype=torch.float64))

    model = WPT.pretrain(DATA, steps=UPDATES, callback=note, **SETTINGS | options)
    return model, {name: torch.stack(values) for name, values in metrics.items()}


def explored(name: str, **changes: Any) -> tuple[WPT, dict[str, torch.Tensor]]:
    """Explore for two episodes, then make 20 updates."""
    settings = SETTINGS | {"offline_ratio": 0.0, "guidance": 0.0} | changes
    model = EXPLORERS[name]("WPTPolicy", ClockEnv(), **settings)
    list(model.explore(3))
    return model, updated(model)


def acted(model: WPT) -> dict[str, torch.Tensor]:
    """Act for 200 steps in two environments at once, deterministically and sampled."""
    rng, actions = np.random.default_rng(5), []
    for deterministic in (True, False):
        state, start = None, np.ones(2, bool)
        torch.manual_seed(0)
        for step in range(STEPS // 2):
            image = rng.integers(0, 256, (2, 64, 64, 3)).astype(np.uint8)
            action, state = model.predict(image, state, start, deterministic)
            start = np.array([step % 9 == 8, False])
            actions.append(torch.from_numpy(np.array(action)))
    return {"action": torch.stack(actions)}


def main() -> None:
    """Print one line for each agent."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--values", action="store_true", help="print every loss, too")
    parser.add_argument("names", nargs="*", help="the agents to print; all by default")
    options = parser.parse_args()
    torch.set_num_threads(1)
    torch.use_deterministic_algorithms(True, warn_only=True)
    warnings.simplefilter("ignore")
    data = TrajectoryDataset.of(DATA)
    cases: dict[str, Callable[[], tuple[WPT, dict[str, torch.Tensor]]]] = {
        "pre-training": pretraining,
        "two passes": lambda: pretraining(accumulate=2),
        "free nats": lambda: pretraining(accumulate=2, free_nats=1e3),
        "wpt": lambda: learnt({"dataset": data, "guidance": 1.0}),
        "kickstart": lambda: learnt({"dataset": data, "kickstart": "linear(20,2,100)"}),
        "adaptive": lambda: learnt(
            {"dataset": data, "kickstart": "adaptive(20,1)", "train_freq": "step"},
            DummyVecEnv([lambda: ClockEnv(length=7), lambda: ClockEnv(length=5)]),
        ),
        "scratch": lambda: learnt({"offline_ratio": 0.0, "guidance": 0.0}),
        "further": lambda: learnt({"dataset": data} | FURTHER, ClockEnv(terminates=True)),
        "reinforce": lambda: learnt(
            {"dataset": data, "actor_grad": "reinforce", "precision": "bf16"} | FURTHER,
            ClockEnv(terminates=True),
        ),
        "icm": lambda: explored("icm"),
        "plan2explore": lambda: explored("plan2explore"),
        "icm further": lambda: explored("icm", repval_scale=0.3, reward_ensemble=3),
        "p2e further": lambda: explored("plan2explore", repval_scale=0.3, imagine_starts=5),
    }
    for name in options.names or cases:
        model, losses = cases[name]()
        print(f"{name:14} losses {digest(losses)}  weights {digest(weights(model))}", flush=True)
        if options.values:
            for loss, values in sorted(losses.items()):
                print(f"  {loss}: {values.tolist()}")
        if name == "wpt":
            print(f"{'acting':14} actions {digest(acted(model))}", flush=True)


if __name__ == "__main__":
    main()
