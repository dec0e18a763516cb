"""RLPD (Ball et al., 2023): soft actor-critic from pixels, half of each batch from offline data.

Source: https://arxiv.org/abs/2302.02948. With reward-free offline data it becomes UDS (rewards of
zero, https://arxiv.org/abs/2202.01741) or ExPLORe (an optimistic reward model's rewards,
https://arxiv.org/abs/2311.05067).
"""

import math
from collections.abc import Mapping
from copy import deepcopy

import torch
import torch.nn.functional as F
from gymnasium import spaces
from torch import Generator, Tensor, nn
from torch.optim import Adam

from wpt_agents.agents.frame_agent import descend
from wpt_agents.data.transitions import Transitions
from wpt_agents.model.actor_critic import ema_update
from wpt_agents.model.ensembles import CriticEnsemble, RewardEnsemble
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.model.frames import FrameEncoder, Trunk, mlp, xavier
from wpt_agents.model.networks import Size, frozen

LOG_STD = -20.0, 2.0  # bounds of the policy's log standard deviation
SHOWN = 0.8  # share of the online rows that each reward head learns from


class TanhActor(nn.Module):
    """π(a | h) = tanh of a Gaussian: a trunk of its own, then an MLP to mean and log std.

    :param embed_dim: E, the width of the encoder's output
    :param features: width of the trunk's latent
    :param hidden: width of the MLP
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, features: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.layers = mlp(features, hidden, 2 * action_dim)

    def forward(self, embed: Tensor) -> tuple[Tensor, Tensor]:
        """(N, E) -> mean and log std of the Gaussian before tanh, (N, A) each."""
        mean, log_std = self.layers(self.trunk(embed)).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD)


def tanh_sample(
    mean: Tensor, log_std: Tensor, generator: Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Action a = tanh(u), u = μ + σ ε, and log π(a) = Σ log N(u; μ, σ²) - log(1 - tanh² u).

    log(1 - tanh² u) = 2 (log 2 - u - softplus(-2 u)), which does not overflow.

    :param mean: (N, A)
    :param log_std: (N, A)
    :return: (N, A) and (N,)
    """
    noise = torch.randn(mean.shape, device=mean.device, generator=generator)
    u = mean + log_std.exp() * noise
    normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    correction = 2 * (math.log(2) - u - F.softplus(-2 * u))
    return u.tanh(), (normal - correction).sum(-1)


def td_target(reward: Tensor, discount: Tensor, next_q: Tensor) -> Tensor:
    """Target y = r + γ m Qbar_j(o', a') with one random member j; there is no entropy term.

    :param reward: (N,)
    :param discount: (N,), γ m, which is 0 behind a terminal state
    :param next_q: (N,), of member j of the target critic
    """
    assert reward.shape == discount.shape == next_q.shape, (reward.shape, next_q.shape)
    return reward + discount * next_q


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """E[(Q_k - y)²] over members and batch.

    :param q: (K, N)
    :param target: (N,), y; no gradient reaches it
    """
    assert q.shape[1:] == target.shape, (q.shape, target.shape)
    return (q - target.detach()).square().mean()


def actor_loss(log_prob: Tensor, q: Tensor, alpha: Tensor | float) -> Tensor:
    """E[α log π(a | o) - mean_k Q_k(o, a)].

    :param log_prob: (N,)
    :param q: (K, N)
    :param alpha: the temperature; no gradient reaches it
    """
    assert q.shape[1:] == log_prob.shape, (q.shape, log_prob.shape)
    alpha = alpha.detach() if isinstance(alpha, Tensor) else alpha
    return (alpha * log_prob - q.mean(0)).mean()


def temperature_loss(log_alpha: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """α (H - Hbar), H = -E[log π]: α falls while the entropy is above its target.

    :param log_alpha: scalar, log α
    :param log_prob: (N,); no gradient reaches it
    :param target_entropy: Hbar, -A / 2 in RLPD
    """
    return log_alpha.exp() * (-log_prob.detach().mean() - target_entropy)


def reward_ensemble_loss(prediction: Tensor, reward: Tensor, shown: Tensor) -> Tensor:
    """E[(r_k(z) - r)²] over the rows that are shown to member k.

    :param prediction: (K, N)
    :param reward: (N,), the environment's
    :param shown: (K, N) bool
    """
    assert prediction.shape == shown.shape, (prediction.shape, shown.shape)
    return ((prediction - reward).square() * shown).sum() / shown.sum().clamp_min(1)


def optimistic_reward(prediction: Tensor, beta: float) -> tuple[Tensor, Tensor]:
    """ExPLORe's label by an ensemble: r = mean_k r_k(z) + β std_k r_k(z).

    The ensemble stands in the place of ExPLORe's random network distillation, as in appendix G of
    the ICLR 2026 version of the WPT paper: its deviation is in units of reward.

    :param prediction: (K, N)
    :param beta: β
    :return: the label and the bonus in it, β std, (N,) each
    """
    bonus = beta * prediction.std(0, correction=0)
    return prediction.mean(0) + bonus, bonus


class RLPDPolicy(FramePolicy):
    """Encoder, actor, critics, their target networks with an encoder of their own, temperature.

    :param channels: of the encoder's first layer; each further layer has twice as many
    :param feature_dim: width of the trunks' latents
    :param hidden_dim: width of the heads
    :param critics: K, the number of critics
    :param reward_members: the number of reward heads; 0 for none
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        clone_size: Size | None = None,
        channels: int = 32,
        feature_dim: int = 50,
        hidden_dim: int = 256,
        critics: int = 10,
        reward_members: int = 0,
    ) -> None:
        self.widths = channels, feature_dim, hidden_dim
        self.critics, self.reward_members = critics, reward_members
        super().__init__(observation_space, action_space, clone_size)

    def build(self) -> None:
        """Draws the networks for actions of width `action_dim`."""
        channels, features, hidden = self.widths
        self.encoder = FrameEncoder([channels * 2**i for i in range(4)], (2, 2, 2, 2))
        shape = self.encoder.embed_dim, features, hidden, self.action_dim
        self.actor, self.critic = TanhActor(*shape), CriticEnsemble(*shape, self.critics)
        for network in (self.encoder, self.actor, self.critic):
            network.apply(xavier)  # the ensemble's layers draw their own
        self.target_encoder = deepcopy(self.encoder).requires_grad_(False)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(0.1).log())
        if self.reward_members:
            self.reward_ensemble = RewardEnsemble(features, hidden, self.reward_members)

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """(N, F, 64, 64, 3) uint8 -> (N, A): the mode or a sample of the policy."""
        mean, log_std = self.actor(self.encoder(frames))
        return mean.tanh() if deterministic else tanh_sample(mean, log_std, generator)[0]


class RLPDLearner:
    """One update of encoder, critics, actor and temperature, and of the reward ensemble if any.

    :param policy: whose networks learn
    :param learning_rate: of Adam, for all networks
    :param tau: share by which the target networks move
    :param beta: weight of the ensemble's deviation in `optimistic_reward`
    """

    def __init__(
        self, policy: RLPDPolicy, learning_rate: float, tau: float, beta: float = 1.0
    ) -> None:
        self.policy, self.tau, self.beta = policy, tau, beta
        value = [*policy.encoder.parameters(), *policy.critic.parameters()]
        self.critic_optimizer = Adam(value, learning_rate, fused=True)
        self.actor_optimizer = Adam(policy.actor.parameters(), learning_rate, fused=True)
        self.temperature_optimizer = Adam([policy.log_alpha], learning_rate, fused=True)
        self.optimizers = ["critic_optimizer", "actor_optimizer", "temperature_optimizer"]
        if policy.reward_members:
            heads = policy.reward_ensemble.parameters()
            self.reward_optimizer = Adam(heads, learning_rate, fused=True)
            self.optimizers.append("reward_optimizer")

    def update(
        self, batch: Transitions, online: int, generator: Generator | None = None
    ) -> Mapping[str, Tensor]:
        """One step of every network.

        :param batch: rows of the environment, then offline rows
        :param online: how many rows are of the environment
        """
        policy = self.policy
        with torch.no_grad():
            next_embed = policy.encoder(batch.next_image)
            mean, log_std = policy.actor(next_embed)
            next_action, _ = tanh_sample(mean, log_std, generator)
            member = torch.randint(
                policy.critics, (), generator=generator, device=batch.reward.device
            )
            next_q = policy.target_critic(policy.target_encoder(batch.next_image), next_action)[
                member
            ]
        reward, metrics = self._labelled(batch.reward, next_embed, online, generator)
        embed = policy.encoder(batch.image)
        q = policy.critic(embed, batch.action)
        value_loss = critic_loss(q, td_target(reward, batch.discount, next_q))
        descend(self.critic_optimizer, value_loss, "critic")
        metrics |= self._update_actor(embed.detach(), generator)
        ema_update(policy.target_encoder, policy.encoder, self.tau)
        ema_update(policy.target_critic, policy.critic, self.tau)
        return metrics | {"train/critic_loss": value_loss.detach(), "train/q": q.detach().mean()}

    def _labelled(
        self, reward: Tensor, next_embed: Tensor, online: int, generator: Generator | None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """The rewards of all rows: the offline ones by the reward ensemble, where there is one.

        Rewards belong to arriving, so the ensemble looks at the next image. It learns first.
        """
        policy = self.policy
        if not policy.reward_members:
            return reward, {}
        with torch.no_grad():
            latent = policy.critic.trunk(next_embed)
        prediction = policy.reward_ensemble(latent[:online])
        draw = torch.rand(prediction.shape, device=reward.device, generator=generator)
        loss = reward_ensemble_loss(prediction, reward[:online], draw < SHOWN)
        descend(self.reward_optimizer, loss, "reward")
        with torch.no_grad():
            label, bonus = optimistic_reward(policy.reward_ensemble(latent[online:]), self.beta)
        metrics = {"explore/reward_loss": loss.detach()}
        if len(label):
            metrics["explore/bonus_share"] = bonus.mean() / label.abs().mean().clamp_min(1e-8)
            metrics["explore/bonus"] = bonus.mean()
        return torch.cat([reward[:online], label]), metrics

    def _update_actor(self, embed: Tensor, generator: Generator | None) -> dict[str, Tensor]:
        """Actor and temperature on the encoder's output, which they do not train.

        RLPD encodes the images again after the critic's step; here h is of before, as in DrQ-v2.
        """
        policy = self.policy
        alpha = policy.log_alpha.exp().detach()
        mean, log_std = policy.actor(embed)
        action, log_prob = tanh_sample(mean, log_std, generator)
        with frozen(policy.critic):
            loss = actor_loss(log_prob, policy.critic(embed, action), alpha)
        descend(self.actor_optimizer, loss, "actor")
        temperature = temperature_loss(policy.log_alpha, log_prob, -0.5 * policy.action_dim)
        descend(self.temperature_optimizer, temperature, "temperature")
        return {
            "train/actor_loss": loss.detach(),
            "train/entropy": -log_prob.detach().mean(),
            "train/alpha": alpha,
        }
