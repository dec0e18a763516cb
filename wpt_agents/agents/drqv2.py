"""DrQ-v2: deterministic policy gradients from augmented pixels (Yarats et al., 2021).

Source: https://arxiv.org/abs/2107.09645. The equations below are numbered as in that paper.
"""

from collections.abc import Mapping
from copy import deepcopy

import torch
from gymnasium import spaces
from torch import Generator, Tensor, nn
from torch.optim import Adam, Optimizer

from wpt_agents.data.transitions import Transitions
from wpt_agents.model.actor_critic import ema_update
from wpt_agents.model.behavior_cloning import random_shift
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.model.frames import FrameEncoder, Trunk, mlp, orthogonal
from wpt_agents.model.networks import Size, frozen

EDGE = 1 - 1e-6  # actions are clamped to this


class Actor(nn.Module):
    """μ(h): a trunk of its own, then an MLP and tanh.

    :param embed_dim: E, the width of h = f(o)
    :param features: width of the trunk's latent
    :param hidden: width of the MLP
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, features: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.layers = mlp(features, hidden, action_dim)

    def forward(self, embed: Tensor) -> Tensor:
        """(N, E) -> (N, A), the mean action in (-1, 1)."""
        return self.layers(self.trunk(embed)).tanh()


class Critic(nn.Module):
    """Q_1 and Q_2 on a common trunk.

    :param embed_dim: E, the width of h = f(o)
    :param features: width of the trunk's latent
    :param hidden: width of the MLPs
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, features: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.q1 = mlp(features + action_dim, hidden, 1)
        self.q2 = mlp(features + action_dim, hidden, 1)

    def forward(self, embed: Tensor, action: Tensor) -> Tensor:
        """(N, E), (N, A) -> (2, N)."""
        inputs = torch.cat([self.trunk(embed), action], -1)
        return torch.stack([self.q1(inputs), self.q2(inputs)]).squeeze(-1)


def noisy_action(
    mean: Tensor, std: float, clip: float | None = None, generator: Generator | None = None
) -> Tensor:
    """Action a = clamp(μ + clip(ε, -c, c)), ε ~ N(0, σ²); with the gradient of μ + clip(ε).

    The noise is clipped in Eq. (1) and (4) only: acting explores with all of it.

    :param mean: (N, A), μ
    :param std: σ of the exploration schedule
    :param clip: c, or None for no clipping
    :return: (N, A), inside of (-1, 1)
    """
    noise = std * torch.randn(mean.shape, device=mean.device, generator=generator)
    action = mean + (noise if clip is None else noise.clamp(-clip, clip))
    return action - action.detach() + action.detach().clamp(-EDGE, EDGE)


def td_target(reward: Tensor, discount: Tensor, next_q: Tensor) -> Tensor:
    """Eq. (2): y = Σ_{i<n} γ^i r_{t+i} + γ^n min_k Qbar_k(h_{t+n}, a_{t+n}).

    :param reward: (N,), the sum, as `draw_transitions` makes it
    :param discount: (N,), γ^n, or 0 behind a terminal state
    :param next_q: (2, N), of the target critic
    """
    assert reward.shape == discount.shape == next_q.shape[1:], (reward.shape, next_q.shape)
    return reward + discount * next_q.amin(0)


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """Eq. (1): E[(Q_1 - y)²] + E[(Q_2 - y)²].

    :param q: (2, N)
    :param target: (N,), y; no gradient reaches it
    """
    assert q.shape[1:] == target.shape, (q.shape, target.shape)
    return (q - target.detach()).square().mean(1).sum()


def actor_loss(q: Tensor) -> Tensor:
    """Eq. (4): -E[min_k Q_k(h, a)], a of the actor: (2, N) -> scalar."""
    return -q.amin(0).mean()


def augment(
    batch: Transitions, pad: int, generator: Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Shift o and o' each by up to `pad` pixels; the frames of one stack move together."""
    image = random_shift(batch.image, pad, generator)
    return image, random_shift(batch.next_image, pad, generator)


def descend(optimizer: Optimizer, loss: Tensor, name: str) -> None:
    """Takes one optimiser step, unless the loss is not finite.

    :raises FloatingPointError: the loss is not finite; the weights are as before
    """
    if not loss.isfinite():
        raise FloatingPointError(
            f"The {name} loss is {loss.item()}; this step was not taken and the weights are as "
            "before: look at the rewards or lower the learning rate"
        )
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()


class DrQv2Policy(FramePolicy):
    """Encoder, actor, critic and target critic; the target critic has no encoder of its own.

    :param channels: of each of the encoder's four layers
    :param feature_dim: width of the trunks' latents
    :param hidden_dim: width of the MLPs
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        clone_size: Size | None = None,
        channels: int = 32,
        feature_dim: int = 50,
        hidden_dim: int = 1024,
    ) -> None:
        self.widths = channels, feature_dim, hidden_dim
        super().__init__(observation_space, action_space, clone_size)

    def build(self) -> None:
        """Draws the networks for actions of width `action_dim`."""
        channels, features, hidden = self.widths
        self.encoder: nn.Module = FrameEncoder((channels,) * 4, (2, 1, 1, 1), centre=0.5)
        shape = self.encoder.embed_dim, features, hidden, self.action_dim
        self.actor, self.critic = Actor(*shape), Critic(*shape)
        for network in (self.encoder, self.actor, self.critic):
            network.apply(orthogonal)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """(N, F, 64, 64, 3) uint8 -> (N, A): the mean, or the mean and noise of deviation `std`."""
        mean = self.actor(self.encoder(frames))
        return mean if deterministic else noisy_action(mean, self.std, None, generator)


class DrQv2Learner:
    """One update of critic, encoder and actor.

    :param policy: whose networks learn
    :param learning_rate: of Adam, for all networks
    :param tau: share by which the target critic moves to the critic
    :param std_clip: c of `noisy_action`
    """

    def __init__(
        self, policy: DrQv2Policy, learning_rate: float, tau: float, std_clip: float, pad: int = 4
    ) -> None:
        self.policy, self.tau, self.std_clip, self.pad = policy, tau, std_clip, pad
        value = [*policy.encoder.parameters(), *policy.critic.parameters()]
        self.critic_optimizer = Adam(value, learning_rate, fused=True)
        self.actor_optimizer = Adam(policy.actor.parameters(), learning_rate, fused=True)

    def update(
        self, batch: Transitions, std: float, generator: Generator | None = None
    ) -> Mapping[str, Tensor]:
        """Critic and encoder by Eq. (1), actor by Eq. (4), then the target critic.

        :param std: σ of the exploration schedule
        """
        policy = self.policy
        image, next_image = augment(batch, self.pad, generator)
        embed = policy.encoder(image)
        with torch.no_grad():  # the encoder has no target network: h' is of the present one
            next_embed = policy.encoder(next_image)
            next_action = noisy_action(policy.actor(next_embed), std, self.std_clip, generator)
            next_q = policy.target_critic(next_embed, next_action)
            target = td_target(batch.reward, batch.discount, next_q)
        q = policy.critic(embed, batch.action)
        value_loss = critic_loss(q, target)
        descend(self.critic_optimizer, value_loss, "critic")
        embed = embed.detach()  # the actor's loss does not train the encoder
        action = noisy_action(policy.actor(embed), std, self.std_clip, generator)
        with frozen(policy.critic):
            loss = actor_loss(policy.critic(embed, action))
        descend(self.actor_optimizer, loss, "actor")
        ema_update(policy.target_critic, policy.critic, self.tau)
        return {
            "train/critic_loss": value_loss.detach(),
            "train/actor_loss": loss.detach(),
            "train/q": q.detach().mean(),
            "train/batch_reward": batch.reward.mean(),
        }
