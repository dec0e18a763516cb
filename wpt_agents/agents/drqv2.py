"""DrQ-v2: deterministic policy gradients from augmented pixels (Yarats et al., 2021).

Source: https://arxiv.org/abs/2107.09645. The equations below are numbered as in that paper.
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Generator, Tensor, nn
from torch.optim import Adam, Optimizer

from wpt_agents.agents.base import MetricLists
from wpt_agents.agents.frame_agent import FrameAgent, FrameKeywords
from wpt_agents.data.transitions import Transitions
from wpt_agents.model.actor_critic import ema_update
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.model.frames import FrameEncoder, Trunk, mlp, orthogonal
from wpt_agents.model.layers import frozen
from wpt_agents.training.descent import descend
from wpt_agents.training.guidance import parse_schedule
from wpt_agents.training.keywords import Stage, amount, count, schedule, share
from wpt_agents.training.randomness import Purpose

EDGE = 1 - 1e-6  # actions are clamped to this, as in the published code


class Actor(nn.Module):
    """The deterministic policy μ(h): a trunk, then an MLP and tanh.

    :param embed_dim: E, the width of h = f(o)
    :param features: width of the trunk's latent
    :param hidden: width of the MLP
    :param action_dim: A
    """

    def __init__(self, embed_dim: int, features: int, hidden: int, action_dim: int) -> None:
        super().__init__()
        self.trunk = Trunk(embed_dim, features)
        self.layers = mlp(features, hidden, action_dim)

    def before_tanh(self, embed: Tensor) -> Tensor:
        """Return u of the mean action tanh(u): (N, E) -> (N, A)."""
        u: Tensor = self.layers(self.trunk(embed))
        return u

    def forward(self, embed: Tensor) -> Tensor:
        """Return the mean action in (-1, 1): (N, E) -> (N, A)."""
        return self.before_tanh(embed).tanh()


class Critic(nn.Module):
    """The value functions Q_1(h, a) and Q_2(h, a) on a common trunk.

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
        """Return both values: (N, E), (N, A) -> (2, N)."""
        inputs = torch.cat([self.trunk(embed), action], -1)
        return torch.stack([self.q1(inputs), self.q2(inputs)]).squeeze(-1)


def noisy_action(
    mean: Tensor, std: float, clip: float | None = None, generator: Generator | None = None
) -> Tensor:
    """Add noise to an action: a = clamp(μ + clip(ε, -c, c)), ε ~ N(0, σ²).

    The gradient is that of μ + clip(ε). The noise is clipped in Eq. (1) and (4) only, not in
    acting.

    :param mean: (N, A), μ
    :param std: σ of the exploration schedule
    :param clip: c, or None for no clipping
    :return: (N, A), inside of (-1, 1)
    """
    noise = std * torch.randn(mean.shape, device=mean.device, generator=generator)
    action = mean + (noise if clip is None else noise.clamp(-clip, clip))
    # Straight-through: the gradient passes the clamp, as in the published code.
    return action - action.detach() + action.detach().clamp(-EDGE, EDGE)


def td_target(reward: Tensor, discount: Tensor, next_q: Tensor) -> Tensor:
    """Eq. (2): y = Σ_{i<n} γ^i r_{t+i} + γ^n min_k Qbar_k(h_{t+n}, a_{t+n}).

    :param reward: (N,), the discounted sum, as `draw_transitions` computes it
    :param discount: (N,), γ^n, or 0 after a terminal state
    :param next_q: (2, N), the values of the target critic
    :return: (N,), y
    """
    assert reward.shape == discount.shape == next_q.shape[1:], (reward.shape, next_q.shape)
    return reward + discount * next_q.amin(0)


def critic_loss(q: Tensor, target: Tensor) -> Tensor:
    """Eq. (1): E[(Q_1 - y)²] + E[(Q_2 - y)²].

    :param q: (2, N), the values of the critic
    :param target: (N,), y; no gradient reaches it
    :return: scalar
    """
    assert q.shape[1:] == target.shape, (q.shape, target.shape)
    return (q - target.detach()).square().mean(1).sum()


def actor_loss(q: Tensor) -> Tensor:
    """Eq. (4): -E[min_k Q_k(h, a)], with a from the actor: (2, N) -> scalar."""
    return -q.amin(0).mean()


@dataclass(frozen=True, kw_only=True)
class DrQv2Keywords(FrameKeywords):
    """The keywords of `DrQv2`; the defaults are the published ones for tasks of medium difficulty.

    Source: cfgs/config.yaml and cfgs/task of https://github.com/facebookresearch/drqv2.
    """

    channels: int = count(32, "channels of each of the encoder's four layers", Stage.SIZE)
    feature_dim: int = count(50, "width of the actor's and the critic's latent", Stage.SIZE)
    hidden_dim: int = count(1024, "width of the hidden layers of actor and critic", Stage.SIZE)
    n_steps: int = count(3, "rewards in a target, before the value of the target critic")
    tau: float = share(0.01, "share by which the target critic moves to the critic in an update")
    std: str | float = schedule(
        "linear(1,0.1,500000)",
        np.inf,
        "standard deviation of the noise on actions, a number or a schedule over steps. The "
        "published ones last 100,000 steps on easy tasks, 500,000 on medium and 2,000,000 on hard "
        "ones; shorten it for short runs, or noise dominates the actions to the end",
    )
    std_clip: float = amount(0.3, "largest noise in targets and in the actor's loss")
    pre_activation: float = amount(
        0.0,
        "weight of the mean square of the actor's output before tanh in its loss, as in MR.Q; not "
        "in DrQ-v2. Short runs need it, or tanh saturates early and recovers slowly",
    )
    frame_differences: float = amount(
        0.0,
        "if above 0, the encoder sees the newest frame and the differences of neighbouring frames "
        "times this number instead of three frames. It is not in DrQ-v2",
        Stage.SIZE,
    )
    update_every: int = count(2, "collected steps per update")


class DrQv2Policy(FramePolicy):
    """Encoder, actor, critic and target critic; the target critic has no encoder of its own.

    Its widths are the keywords `channels`, `feature_dim`, `hidden_dim` and `frame_differences` of
    `DrQv2Keywords`.
    """

    def build(self) -> None:
        """Initialise the networks for actions of width `action_dim`."""
        widths = self.widths
        self.encoder = self.make_encoder(widths.channels)
        shape = self.encoder.embed_dim, widths.feature_dim, widths.hidden_dim, self.action_dim
        self.actor = Actor(*shape)
        self.critic = Critic(*shape)
        for network in (self.actor, self.critic):
            network.apply(orthogonal)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)

    def make_encoder(self, channels: int) -> Any:
        """Initialise an encoder: (N, F, 64, 64, 3) uint8 -> (N, `embed_dim`)."""
        differences = vars(self.widths).get("frame_differences", 0.0)  # not in older files
        encoder = FrameEncoder((channels,) * 4, (2, 1, 1, 1), centre=0.5, differences=differences)
        return encoder.apply(orthogonal)

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """Return the mean action, or with noise: (N, F, 64, 64, 3) uint8 -> (N, A)."""
        mean = self.actor(self.encoder(frames))
        return mean if deterministic else noisy_action(mean, self.std, None, generator)


class DrQv2Learner:
    """The optimisers of encoder, critic and actor, and their updates.

    :param policy: the networks to train
    :param settings: learning rate, τ and the noise's clip c
    """

    def __init__(self, policy: DrQv2Policy, settings: DrQv2Keywords) -> None:
        self.policy = policy
        self.settings = settings
        value = [*policy.encoder.parameters(), *policy.critic.parameters()]
        value = [weight for weight in value if weight.requires_grad]  # R3M's encoder is frozen
        self.critic_optimizer = Adam(value, settings.learning_rate, fused=True)
        self.actor_optimizer = Adam(policy.actor.parameters(), settings.learning_rate, fused=True)

    def update(
        self, batch: Transitions, std: float, generator: Generator | None = None
    ) -> Mapping[str, Tensor]:
        """Update critic and encoder by Eq. (1), the actor by Eq. (4), then the target critic.

        :param batch: transitions, whose images are shifted already
        :param std: σ of the exploration schedule
        """
        policy, clip = self.policy, self.settings.std_clip
        embed = policy.encoder(batch.image)
        with torch.no_grad():  # the encoder has no target network: h' is of the present one
            next_embed = policy.encoder(batch.next_image)
            next_action = noisy_action(policy.actor(next_embed), std, clip, generator)
            next_q = policy.target_critic(next_embed, next_action)
            target = td_target(batch.reward, batch.discount, next_q)
        q = policy.critic(embed, batch.action)
        value_loss = critic_loss(q, target)
        self.descend(self.critic_optimizer, value_loss, "critic")
        embed = embed.detach()  # the actor's loss does not train the encoder
        before_tanh = policy.actor.before_tanh(embed)
        action = noisy_action(before_tanh.tanh(), std, clip, generator)
        with frozen(policy.critic):
            loss = actor_loss(policy.critic(embed, action))
        if self.settings.pre_activation:
            loss = loss + self.settings.pre_activation * before_tanh.square().mean()
        self.descend(self.actor_optimizer, loss, "actor")
        ema_update(policy.target_critic, policy.critic, self.settings.tau)
        return {
            "train/critic_loss": value_loss.detach(),
            "train/actor_loss": loss.detach(),
            "train/q": q.detach().mean(),
            "train/batch_reward": batch.reward.mean(),
        }

    def descend(self, optimizer: Optimizer, loss: Tensor, name: str) -> None:
        """Compute the gradients of a loss and take a step."""
        descend(optimizer, loss, name)


class DrQv2(FrameAgent, keywords=DrQv2Keywords):
    """DrQ-v2: off-policy actor-critic from augmented pixels, without a world model.

    Example::

        model = DrQv2("CnnPolicy", "wpt/dmc-cartpole-balance-v0", std="linear(1,0.1,50000)")
        model.learn(50_000).save("cartpole.zip")

    It differs from the published code in two things: images are 64 x 64 pixels instead of 84 x 84,
    and all starts of n-step transitions are equally likely where episodes differ in length.

    :param policy: "CnnPolicy"
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": DrQv2Policy}
    saved_as = "DrQv2"
    uses_data = False
    policy: DrQv2Policy
    learner: DrQv2Learner
    hyperparameters: DrQv2Keywords
    shape_keywords: ClassVar[tuple[str, ...]] = (
        *("channels", "feature_dim", "hidden_dim"),
        "frame_differences",
    )

    def make_learner(self) -> DrQv2Learner:
        """Make the optimisers."""
        return DrQv2Learner(self.policy, self.hyperparameters)

    @property
    def std_now(self) -> float:
        """The standard deviation σ of the exploration schedule at the current step."""
        return parse_schedule(self.hyperparameters.std, np.inf, "std")(self.num_timesteps)

    def update(self, metrics: MetricLists) -> None:
        """Make one update on transitions of the replay buffer."""
        settings = self.hyperparameters
        std = self.std_now
        batch = self.draw(self.replay_buffer, settings.batch_size, settings.n_steps)
        generator = self.streams.torch(Purpose.UPDATE, self.updates, self.device)
        for name, value in self.learner.update(batch, std, generator).items():
            metrics[name].append(value)
        metrics["train/std"].append(torch.tensor(std))
        self.updates += 1
