"""MR.Q (Fujimoto et al., 2025): TD3 on features that predict reward, next features and end.

Source: https://arxiv.org/abs/2501.16142. MR.Q appeared after the paper of WPT and is not among the
paper's baselines.
"""

from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from math import inf
from typing import ClassVar

import numpy as np
import torch
from stable_baselines3.common.policies import BasePolicy
from torch import Generator, Tensor
from torch.optim import AdamW

from wpt_agents.agents.base import MetricLists
from wpt_agents.agents.frame_agent import FrameAgent, FrameKeywords, FrameProgress
from wpt_agents.data.transitions import Steps, Transitions, draw_steps
from wpt_agents.model.frame_policy import FramePolicy
from wpt_agents.model.layers import frozen
from wpt_agents.model.mrq import (
    ModelEncoder,
    NormedMLP,
    ValuePair,
    actor_loss,
    encoder_loss,
    noisy,
    scaled_target,
    value_loss,
    xavier_relu,
)
from wpt_agents.training.descent import descend
from wpt_agents.training.keywords import Stage, amount, count, with_default
from wpt_agents.training.model_files import optimizers
from wpt_agents.training.randomness import Purpose

LEAST_SCALE = 1e-8  # of rewards, where all are zero


@dataclass(frozen=True, kw_only=True)
class MRQKeywords(FrameKeywords):
    """The keywords of `MRQ`; the defaults are the published ones, the same for all tasks."""

    channels: int = count(32, "channels of each of the encoder's four layers", Stage.SIZE)
    latent_dim: int = count(512, "width of the features", Stage.SIZE)
    hidden_dim: int = count(512, "width of all hidden layers", Stage.SIZE)
    learning_rate: float = amount(3e-4, "learning rate of actor and value functions")
    encoder_learning_rate: float = amount(1e-4, "learning rate of the encoder")
    weight_decay: float = amount(1e-4, "weight decay of AdamW")
    n_steps: int = count(3, "rewards in a target, before the value of the target networks")
    horizon: int = count(5, "steps that the encoder predicts in a row")
    sync_every: int = count(
        250,
        "updates between two copies of all networks to their targets; the encoder makes as many "
        "updates then",
    )
    reward_weight: float = amount(0.1, "weight of the reward in the encoder's loss")
    end_weight: float = amount(0.1, "weight of the episode's end in the encoder's loss")
    pre_activation: float = amount(1e-5, "weight of the actor's squared output before tanh")
    grad_clip: float = amount(20.0, "largest norm of the value functions' gradient")
    std: float = amount(0.2, "standard deviation of the noise on actions, also in targets")
    std_clip: float = amount(0.3, "largest noise in targets")
    learning_starts: int = with_default(FrameKeywords, "learning_starts", 10_000)
    warmup_steps: int = with_default(FrameKeywords, "warmup_steps", 10_000)


@dataclass(kw_only=True)
class MRQProgress(FrameProgress):
    """Counters of an `MRQ` agent.

    :ivar scale: mean absolute reward when the targets were last copied
    :ivar target_scale: `scale` at the copy before
    :ivar updates_before: updates that were made for earlier tasks
    """

    # The values are in units of these.
    of_weights: ClassVar[tuple[str, ...]] = ("scale", "target_scale")

    scale: float = 1.0
    target_scale: float = 0.0
    updates_before: int = field(default=0, metadata={"earlier": 0})


class MRQPolicy(FramePolicy):
    """Encoder, actor, value functions, and a target of each.

    Its widths are `channels`, `latent_dim` and `hidden_dim` of `MRQKeywords`.
    """

    def build(self) -> None:
        """Initialise the networks for actions of width `action_dim`."""
        width = self.widths.latent_dim
        hidden = self.widths.hidden_dim
        self.encoder = ModelEncoder(self.widths.channels, width, hidden, self.action_dim)
        self.actor = NormedMLP(width, hidden, self.action_dim, "relu")
        self.value = ValuePair(width, hidden)
        for network in (self.encoder, self.actor, self.value):
            network.apply(xavier_relu)
        self.target_encoder = deepcopy(self.encoder).requires_grad_(False)
        self.target_actor = deepcopy(self.actor).requires_grad_(False)
        self.target_value = deepcopy(self.value).requires_grad_(False)

    def decide(
        self, frames: Tensor, deterministic: bool, generator: Generator | None = None
    ) -> Tensor:
        """Return the mean action, or with noise: (N, F, 64, 64, 3) uint8 -> (N, A)."""
        mean: Tensor = self.actor(self.encoder.state(frames)).tanh()
        return mean if deterministic else noisy(mean, self.std, inf, generator)


class MRQLearner:
    """The optimisers of encoder, value functions and actor, and their updates.

    :param policy: the networks to train
    :param settings: learning rates and weights of the losses
    """

    def __init__(self, policy: MRQPolicy, settings: MRQKeywords) -> None:
        self.policy = policy
        self.settings = settings
        decay = settings.weight_decay
        rate = settings.learning_rate
        encoder = policy.encoder.parameters()
        self.encoder_optimizer = AdamW(encoder, settings.encoder_learning_rate, weight_decay=decay)
        self.value_optimizer = AdamW(policy.value.parameters(), rate, weight_decay=decay)
        self.actor_optimizer = AdamW(policy.actor.parameters(), rate, weight_decay=decay)

    def copy_targets(self) -> None:
        """Copy all networks to their targets."""
        policy = self.policy
        policy.target_encoder.load_state_dict(policy.encoder.state_dict())
        policy.target_actor.load_state_dict(policy.actor.state_dict())
        policy.target_value.load_state_dict(policy.value.state_dict())

    def update_encoder(self, batch: Steps, ends: bool) -> Tensor:
        """Take a step on the encoder's loss; return the loss.

        :param batch: steps, whose images are shifted already
        :param ends: whether any episode ended in a terminal state
        """
        settings = self.settings
        with torch.no_grad():
            images = batch.next_image.flatten(0, 1)
            target = self.policy.target_encoder.state(images).unflatten(0, batch.reward.shape)
        end_weight = settings.end_weight if ends else 0.0
        weights = 1.0, settings.reward_weight, end_weight
        loss = encoder_loss(self.policy.encoder, batch, target, weights)
        descend(self.encoder_optimizer, loss, "encoder")
        return loss.detach()

    def update(
        self,
        batch: Transitions,
        scale: float,
        target_scale: float,
        generator: Generator | None = None,
    ) -> Mapping[str, Tensor]:
        """Take a step of the value functions and one of the actor, on fixed features.

        :param batch: transitions, whose images are shifted already
        :param scale: the unit of the values, the mean absolute reward
        :param target_scale: the unit of the values of the target networks
        """
        policy = self.policy
        settings = self.settings
        with torch.no_grad():
            next_z = policy.target_encoder.state(batch.next_image)
            next_mean = policy.target_actor(next_z).tanh()
            next_action = noisy(next_mean, settings.std, settings.std_clip, generator)
            next_q = policy.target_value(policy.target_encoder(next_z, next_action))
            target = scaled_target(batch.reward, batch.discount, next_q, scale, target_scale)
            z = policy.encoder.state(batch.image)
            features = policy.encoder(z, batch.action)
        q = policy.value(features)
        loss = value_loss(q, target)
        descend(self.value_optimizer, loss, "value", settings.grad_clip)
        with frozen(policy.encoder, policy.value):
            before_tanh = policy.actor(z)
            chosen = policy.value(policy.encoder(z, before_tanh.tanh()))
            policy_loss = actor_loss(chosen, before_tanh, settings.pre_activation)
        descend(self.actor_optimizer, policy_loss, "actor")
        return {
            "train/value_loss": loss.detach(),
            "train/actor_loss": policy_loss.detach(),
            "train/q": scale * q.detach().mean(),
            "train/batch_reward": batch.reward.mean(),
        }


class MRQ(FrameAgent, keywords=MRQKeywords, progress=MRQProgress):
    """MR.Q: model-free learning on features of a model, with one set of settings for all tasks.

    Example::

        model = MRQ("CnnPolicy", "wpt/dmc-walker-walk-v0")
        model.learn(75_000).save("walker.zip")

    :param policy: "CnnPolicy"
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": MRQPolicy}
    saved_as = "MRQ"
    uses_data = False
    policy: MRQPolicy
    learner: MRQLearner
    hyperparameters: MRQKeywords
    progress: MRQProgress
    shape_keywords: ClassVar[tuple[str, ...]] = ("channels", "latent_dim", "hidden_dim")

    def make_learner(self) -> MRQLearner:
        """Make the optimisers."""
        return MRQLearner(self.policy, self.hyperparameters)

    @property
    def std_now(self) -> float:
        """The standard deviation σ of the noise on actions, the same at all steps."""
        return self.hyperparameters.std

    def update(self, metrics: MetricLists) -> None:
        """Make one update on the replay. Once in `sync_every` updates, the encoder's come first."""
        settings = self.hyperparameters
        if (self.updates - self.progress.updates_before) % settings.sync_every == 0:
            metrics["train/encoder_loss"].append(self._update_encoder())
        batch = self.draw(self.replay_buffer, settings.batch_size, settings.n_steps, tails=True)
        generator = self.streams.torch(Purpose.UPDATE, self.updates, self.device)
        scales = self.progress.scale, self.progress.target_scale
        for name, value in self.learner.update(batch, *scales, generator).items():
            metrics[name].append(value)
        self.updates += 1

    def _update_encoder(self) -> Tensor:
        """Copy the networks to their targets, measure the rewards, and train the encoder."""
        settings = self.hyperparameters
        trajectories = self.replay_buffer.trajectories
        rewards = np.concatenate([t.reward for t in trajectories if t.reward is not None])
        self.learner.copy_targets()
        ends = any(trajectory.terminated for trajectory in trajectories)
        losses = []
        for number in range(settings.sync_every):
            rng = self.batch_rng(1 + number)
            shape = settings.batch_size, settings.horizon, self.policy.action_dim
            batch = draw_steps(trajectories, *shape, rng, settings.pad).to(self.device)
            losses.append(self.learner.update_encoder(batch, ends))
        # Last, so that it happens once even if the updates above are interrupted and made again.
        self.progress.target_scale = self.progress.scale
        self.progress.scale = max(float(np.abs(rewards).mean()), LEAST_SCALE)
        return torch.stack(losses).mean()

    def hyperparameters_changed(self) -> None:
        """Pass the keywords to learner and policy, and the learning rates to the optimisers."""
        super().hyperparameters_changed()
        settings = self.hyperparameters
        for group in self.learner.encoder_optimizer.param_groups:
            group["lr"] = settings.encoder_learning_rate
        for optimizer in optimizers(self.learner).values():
            for group in optimizer.param_groups:
                group["weight_decay"] = settings.weight_decay

    def reset_task(self) -> None:
        """Forget the task: episodes, all networks, and the scale of the rewards."""
        self.progress.reset("scale", "target_scale")
        self.progress.updates_before = self.updates  # the encoder's come first again
        super().reset_task()
