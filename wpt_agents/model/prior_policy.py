"""How the prior actor acts: on the last three images, without any other state."""

from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from wpt_agents.model.behavior_cloning import PriorActor
from wpt_agents.model.observations import Observation, State, stack_frames, to_images


class HasPriorActor(Protocol):
    """A policy with a prior actor."""

    image_key: str | None  # the entry to see of Dict observations
    prior_actor: PriorActor
    action_mask: Tensor  # (A,) bool, True at the entries of an action that the robot has

    @property
    def device(self) -> torch.device:
        """Where the weights are."""

    def to_env(self, action: np.ndarray) -> np.ndarray:
        """Map actions (n, A) in [-1, 1] to the bounds of the environment's actions."""


class PriorPolicy:
    """The prior actor with SB3's `predict`; its state is the last three images."""

    def __init__(self, policy: HasPriorActor) -> None:
        self.policy = policy

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State]:
        """Return the prior actor's action, which is always deterministic, and the next state.

        :param observation: (64, 64, 3) or (n, 64, 64, 3) uint8, or a Dict with one image
        :param state: what the last call returned; None at the start of an episode
        :param episode_start: (n,) bool, the environments whose episode has just begun
        :param deterministic: has no effect; accepted because SB3 has it
        :return: (A,) or (n, A) in the bounds of the environment's actions, and the next state
        """
        images, batched = to_images(observation, self.policy.image_key)
        frames = stack_frames(images, state[0] if state else None, episode_start)
        action = self.policy.to_env(prior_action(self.policy, frames))
        return (action if batched else action[0]), (frames,)


@torch.no_grad()
def prior_action(policy: HasPriorActor, frames: np.ndarray) -> np.ndarray:
    """Return the prior actor's actions: (n, F, 64, 64, 3) uint8 -> (n, A) in [-1, 1]."""
    images = torch.from_numpy(frames).to(policy.device)
    return np.asarray(policy.prior_actor.act(images, policy.action_mask).cpu())
