"""Saved policies as behaviours: models of this library or Stable-Baselines3, with noise."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import stable_baselines3 as sb3
from stable_baselines3.common.base_class import BaseAlgorithm

from wpt_agents.agents.base import PixelAgent
from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.jsrl import JSRL
from wpt_agents.agents.mrq import MRQ
from wpt_agents.agents.packnet import PackNet
from wpt_agents.agents.r3m import R3M
from wpt_agents.agents.rlpd import RLPD
from wpt_agents.agents.wpt import WPT
from wpt_agents.files.model_file import agent_of
from wpt_agents.files.names import unknown_name
from wpt_agents.model.observations import State

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "wpt": WPT,
    **{name: getattr(sb3, name.upper()) for name in ("a2c", "ddpg", "ppo", "sac", "td3")},
}
OURS: dict[str, type[BaseAlgorithm]] = {
    agent.__name__: agent for agent in (WPT, DrQv2, JSRL, MRQ, PackNet, R3M, RLPD)
}


@cache
def load_policy(name: str) -> BaseAlgorithm:
    """Load the model in the file `name`: of this library, or of SB3 as `sac:expert.zip`.

    SB3's files contain pickles: load only those that you trust.

    :raises ValueError: if the algorithm is unknown or the file is missing
    """
    algorithm, _, path = name.rpartition(":")
    if (algorithm or "wpt") not in ALGORITHMS:
        raise unknown_name("algorithm", algorithm, ALGORITHMS)
    if not Path(path).is_file():
        raise ValueError(f"No policy {path}: pass a model file, or `sac:FILE` for one of SB3's")
    kind = ALGORITHMS[algorithm] if algorithm else OURS.get(agent_of(path) or "", WPT)
    return kind.load(path, device="cpu")


def sees_states(name: str) -> bool:
    """Return whether the policy observes `info["state"]` instead of the image."""
    return len(load_policy(name).observation_space.shape or ()) == 1


def executed(agent: object, state: State | None, action: np.ndarray) -> State | None:
    """Return an agent's recurrent state after another action than its own was executed.

    The world model predicts from actions, so WPT has to see it. Other states do not depend on them.

    :param agent: anything with `predict`
    :param state: what `predict` returned
    :param action: (A,) or (n, A) in [-1, 1]
    """
    if not isinstance(agent, PixelAgent) or state is None:
        return state
    policy = agent.policy
    batch = np.atleast_2d(action)
    padded = np.zeros((len(batch), len(policy.action_mask)), np.float32)
    padded[:, : batch.shape[1]] = batch
    after: State = policy.executed(state, padded)
    return after


class SavedPolicy:
    """The deterministic policy's actions in [-1, 1] for one episode, with Gaussian noise.

    :param width: number of the task's actions
    """

    def __init__(self, rng: np.random.Generator, name: str, sigma: float, width: int) -> None:
        self.rng = rng
        self.model = load_policy(name)
        self.sigma = sigma
        self.sees_states = sees_states(name)
        self.state: State | None = None
        if self.model.action_space.shape != (width,):
            raise ValueError(
                f"{name} acts in {self.model.action_space}, the task takes {width} actions; pass a "
                "policy of this robot"
            )

    def __call__(self, obs: np.ndarray, info: dict[str, Any], step: int) -> np.ndarray:
        """(obs, info, step) -> (A,)."""
        seen = np.asarray(info["state"], np.float32) if self.sees_states else obs
        start = np.array([step == 0])
        action, self.state = self.model.predict(seen, self.state, start, deterministic=True)
        with np.errstate(invalid="ignore"):  # 0 / 0 where both bounds of an action are equal
            action = np.nan_to_num(self.model.policy.scale_action(action))
        noisy = np.clip(action + self.rng.normal(0, self.sigma, len(action)), -1, 1)
        self.state = executed(self.model, self.state, noisy)
        return noisy
