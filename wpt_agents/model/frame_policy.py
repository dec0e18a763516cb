"""How the model-free agents act: the networks see the last three images and keep no other state."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from torch import Generator, Tensor

from wpt_agents.data.trajectory import IMAGE_SIZE
from wpt_agents.model.behavior_cloning import FRAMES, PriorActor
from wpt_agents.model.observations import State, check_state, stack_frames
from wpt_agents.model.pixel_policy import PixelPolicy
from wpt_agents.model.sizes import Size


class FramePolicy(PixelPolicy):
    """A policy that acts on the last three images; subclasses define the networks.

    The networks are as wide as the environment's own actions. They are initialised again whenever
    `set_action_space` is called with another width.

    :param observation_space: the environment's; images are converted in `predict`
    :param action_space: a Box
    :param clone_size: the widths of the prior actor, or None for no prior actor
    :param widths: the keywords of the agent that `build` uses
    """

    action_mask: Tensor  # (A,) bool, all True: nothing is padded

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        clone_size: Size | None = None,
        **widths: Any,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=True)
        self.clone_size = clone_size
        self.widths = SimpleNamespace(**widths)
        self.std = 1.0  # of the noise added to actions in collection, where there is any
        self.reset_behavior()

    @property
    def action_dim(self) -> int:
        """A, the width of the actions."""
        return self.action_space.shape[0]

    def reset_behavior(self) -> None:
        """Initialise all networks again, as they belong to a task."""
        device = self.device
        mask = torch.ones(self.action_dim, dtype=torch.bool)
        self.register_buffer("action_mask", mask, persistent=False)
        if self.clone_size is not None:
            self.prior_actor = PriorActor(self.clone_size, self.action_dim)
        self.build()
        self.to(device)

    def build(self) -> None:
        """Make the networks for actions of width `action_dim`."""
        raise NotImplementedError

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """Return the actions: (N, F, 64, 64, 3) uint8 -> (N, A) in [-1, 1]."""
        raise NotImplementedError

    def set_action_space(self, action_space: spaces.Box) -> None:
        """Act in this space from now on; another width needs new networks."""
        width = self.action_dim
        self.action_space = action_space
        if self.action_dim != width:
            self.reset_behavior()

    def initial_state(self, n: int) -> State:
        """Return the acting state of n new episodes: the last images, (n, F, 64, 64, 3)."""
        return (np.zeros((n, FRAMES, IMAGE_SIZE, IMAGE_SIZE, 3), np.uint8),)

    @torch.inference_mode()
    def act(
        self,
        image: np.ndarray,
        state: State | None,
        episode_start: np.ndarray | None,
        deterministic: bool = False,
        generator: Generator | None = None,
    ) -> tuple[np.ndarray, State]:
        """Return one action for each environment, and the next state.

        :param image: (n, 64, 64, 3) uint8
        :param state: from the step before, or None
        :param episode_start: (n,) bool, where the state is reset
        :param deterministic: act without noise
        :param generator: source of the noise; torch's own if None
        :return: action (n, A) in [-1, 1], and the new state
        """
        if state is not None:
            check_state(state, ((FRAMES, *image.shape[1:]),), len(image))
        frames = stack_frames(image, None if state is None else state[0], episode_start)
        action = self.decide(torch.from_numpy(frames).to(self.device), deterministic, generator)
        if not action.isfinite().all():
            raise ValueError(
                "The actor's output is not finite: the weights are damaged, load an earlier model"
            )
        return action.cpu().numpy(), (frames,)

    def executed(self, state: State, action: np.ndarray) -> State:
        """Return the state after `action` was executed; it does not depend on the action."""
        return state

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ["observation_space", "action_space", "clone_size"]
        return {name: getattr(self, name) for name in names} | vars(self.widths)
