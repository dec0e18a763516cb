"""The base of all policies: `predict` converts what environments and `act` exchange."""

from abc import abstractmethod

import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from torch import Generator, Tensor

from wpt_agents.model.actions import to_bounds
from wpt_agents.model.observations import Observation, State, to_images


class PixelPolicy(BasePolicy):
    """A policy of SB3 that acts on images, with a recurrent state that the caller keeps."""

    action_space: spaces.Box
    image_key: str | None = None  # the entry to see of Dict observations; their only image if None
    action_mask: Tensor  # (A,) bool, True at the embodiment's own entries

    @abstractmethod
    def act(
        self,
        image: np.ndarray,
        state: State | None,
        episode_start: np.ndarray | None,
        deterministic: bool = False,
        generator: Generator | None = None,
    ) -> tuple[np.ndarray, State]:
        """Return actions (n, A) in [-1, 1] for images (n, 64, 64, 3), and the next state."""

    def to_env(self, action: np.ndarray) -> np.ndarray:
        """Map actions (n, A) in [-1, 1] to the bounds of the environment's actions, (n, width)."""
        return to_bounds(action, self.action_space)

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, State]:
        """Return the action in the environment's own space, and the state for the next call.

        :param observation: (64, 64, 3) or (n, 64, 64, 3) uint8; channels first and other sizes
            are converted
        :param state: what the last call returned; None at the start
        :param episode_start: (n,) bool, the environments whose episode has just begun; None for
            none
        :param deterministic: act without random numbers
        :return: (width,) or (n, width) in the bounds of the environment's actions, and the next
            state
        """
        images, batched = to_images(observation, self.image_key)
        action, state = self.act(images, state, episode_start, deterministic)
        action = self.to_env(action)
        return (action if batched else action[0]), state

    def _predict(  # type: ignore[override]  # no dictionaries of images
        self, observation: Tensor, deterministic: bool = False
    ) -> Tensor:
        """Act as SB3's stateless policies do: every observation is an episode's first."""
        images, _ = to_images(observation.cpu().numpy())
        action, _ = self.act(images, None, None, deterministic)
        return torch.from_numpy(self.to_env(action)).to(self.action_mask.device)
