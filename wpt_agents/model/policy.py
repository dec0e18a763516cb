"""All networks in one module, and how they act: filter a latent state, then the actor decides."""

import hashlib
from collections.abc import Callable, Mapping
from copy import deepcopy
from typing import Any, NamedTuple, Self

import numpy as np
import torch
from gymnasium import spaces
from torch import Generator, Tensor

from wpt_agents.data.trajectory import Trajectory, led_to, stack_windows
from wpt_agents.model.actor_critic import Actor, Critic, averaged
from wpt_agents.model.behavior_cloning import FRAMES, PriorActor
from wpt_agents.model.choosing import actor_or_prior, corrected
from wpt_agents.model.distributions import BIN_RANGE, Noise
from wpt_agents.model.layers import frozen
from wpt_agents.model.observations import (
    IMAGE_SPACE,
    State,
    check_episode_start,
    check_state,
    stack_frames,
)
from wpt_agents.model.ops import op
from wpt_agents.model.pixel_policy import PixelPolicy
from wpt_agents.model.rssm import Latent
from wpt_agents.model.sizes import Size
from wpt_agents.model.world_model import WorldModel, world_model_update_loss


class Dream(NamedTuple):
    """Imagined trajectories: N starts, H steps."""

    states: Latent  # (N, H + 1, ...)
    action: Tensor  # (N, H, A)
    entropy: Tensor  # (N, H), of the actor at the steps 0 .. H-1
    saturated: Tensor  # scalar, the share of the actor's means beyond 0.99


class WPTPolicy(PixelPolicy):
    """World model, actor, critic, target critic and prior actor.

    :param observation_space: the environment's; images are converted in `predict`
    :param action_space: a Box; its width is the embodiment's, at most `max_action_dim`
    :param size: the widths of all networks
    :param max_action_dim: A, the padded action width of the world model
    :param unimix: share of the uniform distribution in every latent distribution
    :param zero_init_heads: start reward head and critic at zero
    :param actor_outscale: factor on the initial weights of the actor's last layer
    :param bin_range: largest bin of reward head and critic, in symlog space
    :param reward_ensemble: number of reward heads
    :param continue_head: predict where episodes end
    :param ibrl: take the prior actor's action where it is worth more than the actor's
    :param residual: add to the prior actor's action what the actor has learned in imagination
    """

    average_actor: Actor | None  # of `actor` over updates, in whose place it acts
    imitator: Actor | None  # the actor without imagination: an imitation of the prior actor alone
    average_imitator: Actor | None  # of `imitator`, beside the average of `actor`
    return_scale: Tensor  # scalar, the running 5-95 % range of returns; 0 before the first ones
    updates: int  # raised whenever weights have changed: caches of them look at it

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Box,
        size: Size,
        max_action_dim: int,
        unimix: float = 0.01,
        zero_init_heads: bool = False,
        actor_outscale: float = 1.0,
        bin_range: float = BIN_RANGE,
        reward_ensemble: int = 1,
        continue_head: bool = False,
        ibrl: bool = False,
        residual: bool = False,
    ) -> None:
        super().__init__(observation_space, action_space, squash_output=True)
        self.updates = 0
        self.ibrl = ibrl
        self.residual = residual
        self.size = size
        self.max_action_dim = max_action_dim
        self.unimix = unimix
        self.zero_init_heads = zero_init_heads
        self.actor_outscale = actor_outscale
        self.bin_range = bin_range
        self.world_model = WorldModel(size, max_action_dim, unimix, zero_init_heads, bin_range)
        mask = torch.zeros(max_action_dim, dtype=torch.bool)
        self.register_buffer("action_mask", mask, persistent=False)
        self.register_buffer("return_scale", torch.zeros(()))
        self.reset_behavior()
        self.world_model.make_reward_members(range(reward_ensemble - 1))
        if continue_head:
            self.world_model.make_continue_head(log_odds=0.0, seed=0)
        self.set_action_space(action_space)

    def reset_behavior(self) -> None:
        """Initialise the networks of a task again: reward head, actors and critics."""
        size = self.size
        device = self.device
        self.world_model.reset_heads()
        self.world_model.to(device)
        self.actor = Actor(size, self.max_action_dim, self.actor_outscale).to(device)
        self.critic = Critic(size, self.zero_init_heads, self.bin_range).to(device)
        self.target_critic = Critic(size, bin_range=self.bin_range).to(device)
        self.target_critic.requires_grad_(False).load_state_dict(self.critic.state_dict())
        self.average_actor = None
        self.imitator = None
        self.average_imitator = None
        self.prior_actor = PriorActor(size, self.max_action_dim).to(device)
        self.return_scale.fill_(0)
        self.updates += 1

    def load_state_dict(
        self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False
    ) -> Any:
        """Load weights, as `torch.nn.Module.load_state_dict`.

        Afterwards there are an imitator and averages if the weights have them.
        """
        self.updates += 1
        if not hasattr(self, "curiosity"):  # an explorer's, which does not take part in acting
            state_dict = {k: v for k, v in state_dict.items() if not k.startswith("curiosity.")}
        self.fit_actors(state_dict)
        return super().load_state_dict(state_dict, strict, assign)

    def fit_actors(self, weights: Mapping[str, Any]) -> None:
        """Add or remove imitator and averages, so that these weights can be loaded."""
        for name in ("imitator", "average_actor", "average_imitator"):
            there = any(weight.startswith(f"{name}.") for weight in weights)
            if there != (getattr(self, name) is not None):
                learns = name == "imitator"
                setattr(self, name, deepcopy(self.actor).requires_grad_(learns) if there else None)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.updates += 1  # `to`, `half` and others move or convert the weights
        super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        return self

    def set_action_space(self, action_space: spaces.Box) -> None:
        """Act in this space from now on; entries past its width are masked everywhere."""
        self.action_space = action_space
        self.action_mask[:] = torch.arange(self.max_action_dim) < action_space.shape[0]

    @property
    def acting_actor(self) -> Actor:
        """The actor that acts in the environment, the average if there is one."""
        return self.actor if self.average_actor is None else self.average_actor

    @property
    def acting_imitator(self) -> Actor | None:
        """The imitator to compare `acting_actor` with; also an average if that is one."""
        return self.imitator if self.average_imitator is None else self.average_imitator

    def begin_residual(self) -> None:
        """Copy the actor to the imitator; their difference is added to the prior actor's action."""
        self.imitator = deepcopy(self.actor)
        self.average_imitator = deepcopy(self.average_actor)

    def average(self, fraction: float) -> None:
        """Move the averages towards actor and imitator by `fraction`; 0 drops them."""
        self.average_actor = averaged(self.average_actor, self.actor, fraction)
        self.average_imitator = averaged(self.average_imitator, self.imitator, fraction)
        self.updates += 1

    def initial_state(self, n: int) -> State:
        """Return the acting state of n new episodes: h (n, D), z (n, S, K), last action (n, A).

        With `ibrl` or `residual`, the last three images (n, F, 64, 64, 3) come before the action.
        """
        shapes = (n, self.size.deter), (n, self.size.stoch, self.size.classes)
        frames = [np.zeros((n, FRAMES, *IMAGE_SPACE.shape), np.uint8)] if self.sees_frames else []
        latent = [np.zeros(shape, np.float32) for shape in shapes]
        return (*latent, *frames, np.zeros((n, self.max_action_dim), np.float32))

    @torch.inference_mode()
    def act(
        self,
        image: np.ndarray,
        state: State | None,
        episode_start: np.ndarray | None,
        deterministic: bool = False,
        generator: Generator | None = None,
    ) -> tuple[np.ndarray, State]:
        """Make one step of filtering and acting.

        :param image: (n, 64, 64, 3) uint8
        :param state: from the step before, or None
        :param episode_start: (n,) bool, where the state is reset
        :param deterministic: take the most likely latent state and the mean action
        :param generator: source of the random numbers; torch's own if None
        :return: action (n, A) in [-1, 1], zero in the padding, and the new state
        """
        n = len(image)
        fresh = self.initial_state(n)
        if state is not None:
            state = self._with_frames(state, image)
            check_state(state, tuple(part.shape[1:] for part in fresh), n)
        deter, stoch, *_, before = (self._tensor(x) for x in state or fresh)
        first = check_episode_start(episode_start, n)
        if n == 0:  # no actions for no observations, as SB3's own policies return
            return fresh[-1], fresh
        inputs = self._tensor(image), Latent(deter, stoch), before, self._tensor(first)
        # The authors draw the latent even if the action is deterministic.
        post, outputs = acting_step(self, *inputs, generator, not deterministic)
        dist = self.acting_actor.truncated(outputs, self.action_mask)
        frames: list[np.ndarray] = []  # of the prior actor, if it takes part
        if self.sees_frames:
            frames = [stack_frames(image, state[2] if state else None, first)]
        if self.residual:
            dist = corrected(self, dist, post, self._tensor(frames[0]))
        decision = dist.mode if deterministic else dist.rsample(generator)
        if self.ibrl:
            decision = actor_or_prior(self, post, decision, self._tensor(frames[0]))
        action = decision.cpu().numpy()
        if not np.isfinite(action).all():
            raise ValueError(
                "The actor's output is not finite: the weights are damaged, load an earlier model"
            )
        latent = [x.cpu().numpy() for x in post]
        return action, (*latent, *frames, action)

    def _with_frames(self, state: State, image: np.ndarray) -> State:
        """Add or remove the images of a state, as keywords may change within an episode."""
        parts = len(state) if isinstance(state, tuple | list) else 0
        if self.sees_frames and parts == 3:
            return (*state[:2], stack_frames(image, None, None), state[2])
        return (*state[:2], state[3]) if parts == 4 and not self.sees_frames else state

    @property
    def sees_frames(self) -> bool:
        """Whether the prior actor takes part in acting."""
        return self.ibrl or self.residual

    def executed(self, state: State, action: np.ndarray) -> State:
        """Return the acting state after `action` (n, A) was executed instead of the policy's."""
        return (*state[:-1], action)

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.from_numpy(np.asarray(array)).to(self.action_mask.device)

    def dream(self, start: Latent, horizon: int, generator: Generator | None = None) -> Dream:
        """Imagine with the actor; gradients pass the world model without reaching its weights.

        :param start: (N, ...), the states to start from
        :param horizon: H
        """
        with frozen(self.world_model):
            return dream(self, start.detach(), horizon, generator)

    @torch.no_grad()
    def embed(self, image: np.ndarray) -> np.ndarray:
        """e(o) of Eq. (5): (n, 64, 64, 3) uint8 -> (n, E) float32."""
        return np.asarray(self.world_model.encoder(self._tensor(image)).float().cpu())

    def encoder_id(self) -> str:
        """Return a hash of the encoder's weights, which is stored with the features."""
        digest = hashlib.sha256()
        for tensor in self.world_model.encoder.state_dict().values():
            digest.update(tensor.cpu().numpy().tobytes())
        return digest.hexdigest()

    @torch.no_grad()
    def open_loop(self, trajectory: Trajectory, context: int = 5, horizon: int = 40) -> np.ndarray:
        """Predict a trajectory's images: `context` reconstructions, then predictions.

        :return: (context + horizon, 64, 64, 3) uint8, or fewer images if the trajectory is shorter
        """
        stop = min(context + horizon, len(trajectory) + 1)
        batch = stack_windows([led_to(trajectory, 0, stop, self.max_action_dim)])
        generator = Generator(self.device).manual_seed(0)
        frames = self.world_model.open_loop(batch.to(self.device), context, generator)
        return frames[0].cpu().numpy()

    @torch.no_grad()
    def heldout_errors(self, trajectory: Trajectory, images: int = 256) -> dict[str, float]:
        """Measure the world model's errors on an episode with rewards, not yet replayed.

        :param images: largest number of images to use, from the episode's start
        :return: `reconstruction`, the squared error of Eq. (1) summed over an image, and `reward`,
            the mean absolute error; both averaged over the steps
        """
        stop = min(len(trajectory) + 1, images)
        batch = stack_windows([led_to(trajectory, 0, stop, self.max_action_dim)]).to(self.device)
        model = self.world_model
        loss, post = world_model_update_loss(model, batch, Generator(self.device).manual_seed(0))
        error = (model.reward(post.feat) - batch.reward).abs()[batch.reward_known].mean()
        return {"reconstruction": loss.reconstruction.item(), "reward": error.item()}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ["observation_space", "action_space", "size", "max_action_dim", "unimix"]
        names += ["zero_init_heads", "actor_outscale", "bin_range", "ibrl", "residual"]
        heads = {
            "reward_ensemble": 1 + len(self.world_model.reward_members),
            "continue_head": self.world_model.continue_head is not None,
        }
        return {name: getattr(self, name) for name in names} | heads


@op
def acting_step(
    policy: WPTPolicy,
    image: Tensor,
    state: Latent,
    action: Tensor,
    is_first: Tensor,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """Make one step of filtering and compute the actor's outputs.

    :param image: (N, 64, 64, 3) uint8
    :param state: of the step before, (N, ...)
    :param action: (N, A), the action that led to the image
    :param is_first: (N,) bool, where state and action are reset
    :return: the posterior state, and the argument of `Actor.truncated`, (N, 2 A)
    """
    model = policy.world_model
    embed = model.encoder(image)
    post, _ = model.rssm.filter(  # a sequence of one step
        embed[:, None], action[:, None], is_first[:, None], state, generator, sample
    )
    post = post.flatten_time()
    return post, policy.acting_actor(post.feat)


@op
def dream(policy: WPTPolicy, start: Latent, horizon: int, generator: Noise = None) -> Dream:
    """Imagine `horizon` steps with the actor, from N states (N, ...)."""
    entropies: list[Tensor] = []
    saturated: list[Tensor] = []

    def act(state: Latent, _: int) -> Tensor:
        dist = policy.actor.dist(state.feat.detach(), policy.action_mask)
        entropies.append(dist.entropy())
        # where tanh saturates, hardly any gradient reaches the actor; the log shows this share
        beyond = (dist.mean.detach().abs() > 0.99) & policy.action_mask
        saturated.append(beyond.float().sum(-1))
        return dist.rsample(generator)

    states, action = policy.world_model.rssm.imagine(start, act, horizon, generator)
    share = torch.stack(saturated).mean() / policy.action_mask.sum()
    return Dream(states, action, torch.stack(entropies, 1), share)
