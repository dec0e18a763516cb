"""RLPD (Ball et al., 2023): soft actor-critic from pixels, half of each batch from offline data.

Source: https://arxiv.org/abs/2302.02948. With reward-free offline data it becomes UDS (rewards of
zero, https://arxiv.org/abs/2202.01741) or ExPLORe (an optimistic reward model's rewards,
https://arxiv.org/abs/2311.05067).
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Generator, Tensor, nn
from torch.optim import Adam

from wpt_agents.agents.base import MetricLists
from wpt_agents.agents.frame_agent import FrameAgent, FrameKeywords
from wpt_agents.agents.optimistic import label
from wpt_agents.data.transitions import Transitions, concatenate
from wpt_agents.model.actor_critic import ema_update
from wpt_agents.model.ensembles import CriticEnsemble, RewardEnsemble
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.model.frames import FrameEncoder, xavier
from wpt_agents.model.layers import frozen
from wpt_agents.model.tanh_actor import TanhActor, tanh_sample
from wpt_agents.training.descent import descend
from wpt_agents.training.keywords import Stage, amount, choice, count, share, with_default
from wpt_agents.training.randomness import Purpose

LABELS = ("true", "zero", "optimistic")


def td_target(reward: Tensor, discount: Tensor, next_q: Tensor) -> Tensor:
    """Target y = r + γ m Qbar_j(o', a') with a random member j, without an entropy term.

    :param reward: (N,)
    :param discount: (N,), γ m, which is 0 after a terminal state
    :param next_q: (N,), the values of member j of the target critic
    :return: (N,), y
    """
    assert reward.shape == discount.shape == next_q.shape, (reward.shape, next_q.shape)
    return reward + discount * next_q


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """E[(Q_k - y)²] over members and batch.

    :param q: (K, N), the values of the K members
    :param target: (N,), y; no gradient reaches it
    :return: scalar
    """
    assert q.shape[1:] == target.shape, (q.shape, target.shape)
    return (q - target.detach()).square().mean()


def actor_loss(log_prob: Tensor, q: Tensor, alpha: Tensor | float) -> Tensor:
    """E[α log π(a | o) - mean_k Q_k(o, a)].

    :param log_prob: (N,), log π(a | o)
    :param q: (K, N), the values of the K members
    :param alpha: the temperature; no gradient reaches it
    :return: scalar
    """
    assert q.shape[1:] == log_prob.shape, (q.shape, log_prob.shape)
    alpha = alpha.detach() if isinstance(alpha, Tensor) else alpha
    return (alpha * log_prob - q.mean(0)).mean()


def temperature_loss(log_alpha: Tensor, log_prob: Tensor, target_entropy: float) -> Tensor:
    """α (H - Hbar), H = -E[log π]: α falls while the entropy is above its target.

    :param log_alpha: scalar, log α
    :param log_prob: (N,); no gradient reaches it
    :param target_entropy: Hbar in nats, -A / 2 in RLPD
    :return: scalar
    """
    return log_alpha.exp() * (-log_prob.detach().mean() - target_entropy)


@dataclass(frozen=True, kw_only=True)
class RLPDKeywords(FrameKeywords):
    """The keywords of `RLPD`; the defaults are those of its published code for pixels.

    Source: configs/rlpd_pixels_config.py of https://github.com/ikostrikov/rlpd.
    """

    channels: int = count(32, "channels of the encoder's first layer, doubled by each", Stage.SIZE)
    feature_dim: int = count(50, "width of the actor's and the critics' latent", Stage.SIZE)
    hidden_dim: int = count(256, "width of the hidden layers of all heads", Stage.SIZE)
    critics: int = count(10, "number of critics", Stage.SIZE)
    label: str = choice(
        "true",
        LABELS,
        "the rewards of offline data: 'true', those of the dataset; 'zero' (UDS); or "
        "'optimistic' (ExPLORe), the mean of a reward ensemble plus `beta` times its standard "
        "deviation",
        Stage.SIZE,
    )
    reward_members: int = count(5, "reward heads of the label 'optimistic'", Stage.SIZE)
    beta: float = amount(1.0, "weight of the deviation in the label 'optimistic'")
    learning_rate: float = with_default(FrameKeywords, "learning_rate", 3e-4)
    tau: float = share(0.005, "share by which the target networks move in an update")
    offline_ratio: float = share(0.5, "share of offline transitions in a batch; 0 for none")
    learning_starts: int = with_default(FrameKeywords, "learning_starts", 1_000)
    warmup_steps: int = with_default(FrameKeywords, "warmup_steps", 1_000)


class RLPDPolicy(FramePolicy):
    """Encoder, actor, critics, their target networks with an encoder of their own, temperature.

    Its widths are `channels`, `feature_dim`, `hidden_dim`, `critics` and `reward_members` of
    `RLPDKeywords`; unless `label` is 'optimistic', there are 0 reward members.
    """

    def build(self) -> None:
        """Initialise the networks for actions of width `action_dim`."""
        widths = self.widths
        self.encoder = FrameEncoder([widths.channels * 2**i for i in range(4)], (2, 2, 2, 2))
        shape = self.encoder.embed_dim, widths.feature_dim, widths.hidden_dim, self.action_dim
        self.actor = TanhActor(*shape)
        self.critic = CriticEnsemble(*shape, widths.critics)
        for network in (self.encoder, self.actor, self.critic):
            network.apply(xavier)  # the ensemble's layers draw their own
        self.target_encoder = deepcopy(self.encoder).requires_grad_(False)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)
        self.log_alpha = nn.Parameter(torch.tensor(0.1).log())  # α = 0.1, as in the published code
        if widths.reward_members:
            self.reward_ensemble = RewardEnsemble(
                widths.feature_dim, widths.hidden_dim, widths.reward_members
            )

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """Return the mode or a sample of the policy: (N, F, 64, 64, 3) uint8 -> (N, A)."""
        mean, log_std = self.actor(self.encoder(frames))
        return mean.tanh() if deterministic else tanh_sample(mean, log_std, generator)[0]


class RLPDLearner:
    """The optimisers of all networks and of the temperature, and their updates.

    :param policy: the networks to train
    :param settings: learning rate, τ and β
    """

    def __init__(self, policy: RLPDPolicy, settings: RLPDKeywords) -> None:
        self.policy = policy
        self.settings = settings
        learning_rate = settings.learning_rate
        value = [*policy.encoder.parameters(), *policy.critic.parameters()]
        self.critic_optimizer = Adam(value, learning_rate, fused=True)
        self.actor_optimizer = Adam(policy.actor.parameters(), learning_rate, fused=True)
        self.temperature_optimizer = Adam([policy.log_alpha], learning_rate, fused=True)
        if policy.widths.reward_members:
            heads = policy.reward_ensemble.parameters()
            self.reward_optimizer = Adam(heads, learning_rate, fused=True)

    def update(
        self, batch: Transitions, online: int, generator: Generator | None = None
    ) -> Mapping[str, Tensor]:
        """Take a step of every network.

        :param batch: rows of the environment, then offline rows, whose images are shifted already
        :param online: how many rows are of the environment
        """
        policy = self.policy
        next_q, latent = self._look_ahead(batch.next_image, generator)
        reward = batch.reward
        metrics: dict[str, Tensor] = {}
        if policy.widths.reward_members:
            ensemble = policy.reward_ensemble, self.reward_optimizer
            reward, metrics = label(
                *ensemble, reward, latent, online, self.settings.beta, generator
            )
        embed = policy.encoder(batch.image)
        q = policy.critic(embed, batch.action)
        value_loss = critic_loss(q, td_target(reward, batch.discount, next_q))
        descend(self.critic_optimizer, value_loss, "critic")
        metrics |= self._update_actor(embed.detach(), generator)
        ema_update(policy.target_encoder, policy.encoder, self.settings.tau)
        ema_update(policy.target_critic, policy.critic, self.settings.tau)
        return metrics | {"train/critic_loss": value_loss.detach(), "train/q": q.detach().mean()}

    @torch.no_grad()
    def _look_ahead(self, next_image: Tensor, generator: Generator | None) -> tuple[Tensor, Tensor]:
        """The value of o' by one random target critic, (N,), and the critics' latent, (N, Z)."""
        policy = self.policy
        embed = policy.encoder(next_image)
        mean, log_std = policy.actor(embed)
        action, _ = tanh_sample(mean, log_std, generator)
        member = torch.randint(policy.widths.critics, (), generator=generator, device=embed.device)
        next_q = policy.target_critic(policy.target_encoder(next_image), action)
        return next_q[member], policy.critic.trunk(embed)

    def _update_actor(self, embed: Tensor, generator: Generator | None) -> dict[str, Tensor]:
        """Actor and temperature on the encoder's output, which they do not train.

        The published critics encode the images again after their step, and the actor does not; here
        h is of before for both, as in DrQ-v2.
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


class RLPD(FrameAgent, keywords=RLPDKeywords):
    """Soft actor-critic from augmented pixels that takes half of each batch from offline data.

    Example::

        model = RLPD("CnnPolicy", "wpt/metaworld-drawer-open-v0", dataset="data/mw", label="zero")
        model.learn(50_000)

    The offline data are trajectories of the task, or else of the robot. Without a dataset, or with
    `offline_ratio=0`, it is soft actor-critic with an ensemble of critics.

    :param policy: "CnnPolicy"
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": RLPDPolicy}
    saved_as = "RLPD"
    policy: RLPDPolicy
    learner: RLPDLearner
    hyperparameters: RLPDKeywords
    shape_keywords = "channels", "feature_dim", "hidden_dim", "critics", "label", "reward_members"

    def widths(self) -> dict[str, Any]:
        """Return the keywords of the policy's constructor, from those of the agent."""
        widths = super().widths()
        if widths.pop("label") != "optimistic":
            widths["reward_members"] = 0
        return widths

    def make_learner(self) -> RLPDLearner:
        """Make the optimisers."""
        return RLPDLearner(self.policy, self.hyperparameters)

    @property
    def wants_data(self) -> bool:
        """Whether offline data are used at all."""
        return self.hyperparameters.offline_ratio > 0

    @property
    def offline_rewards(self) -> bool:
        """Whether the rewards of offline data are used."""
        return self.hyperparameters.label == "true"

    def update(self, metrics: MetricLists) -> None:
        """Make one update on online and offline transitions."""
        size = self.hyperparameters.batch_size
        offline = round(size * self.hyperparameters.offline_ratio) if self.retrieved else 0
        sources = [(self.replay_buffer, size - offline), (self.retrieved, offline)]
        parts = [
            self.draw(replay, rows, 1, stream)
            for stream, (replay, rows) in enumerate(sources)
            if replay is not None and rows
        ]
        batch = concatenate(parts)
        generator = self.streams.torch(Purpose.UPDATE, self.updates, self.device)
        for name, value in self.learner.update(batch, size - offline, generator).items():
            metrics[name].append(value)
        self.updates += 1
