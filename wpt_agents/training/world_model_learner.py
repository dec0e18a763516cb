"""The updates of the world model and the heads of a task: Eq. (1) and the reward likelihood."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

import torch
from torch import Generator, Tensor, nn
from torch.optim import Optimizer

import wpt_agents.fast  # noqa: F401  # registers the faster twins of what the model defines
from wpt_agents.data.trajectory import Batch
from wpt_agents.model.dreamer_v3 import continue_loss
from wpt_agents.model.layers import scale_gradient
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.rssm import Latent
from wpt_agents.model.world_model import WorldModelLoss, reward_loss, world_model_update_loss
from wpt_agents.training import descent
from wpt_agents.training.hyperparameters import Hyperparameters

StatesLoss = Callable[[Latent], Tensor]
"""Posterior states (B, T, ...) -> a scalar that is added to the world model's loss."""
Metrics = dict[str, Tensor]  # scalars without gradient, by their names in the log


class WorldModelLearner:
    """The optimisers of a world model and of its heads, and the updates that they make.

    :param policy: the policy whose world model is trained
    :param hyperparameters: the keywords of `WPT`
    """

    def __init__(self, policy: WPTPolicy, hyperparameters: Hyperparameters) -> None:
        self.policy = policy
        self.hyperparameters = hyperparameters.resolved()
        model = policy.world_model
        # One step for both, so weight decay counts once; in the authors' code it counts twice.
        parts = [model.dynamics_parameters(), list(model.reward_head.parameters())]
        self.model_optimizer = self.adam(parts, self.model_rate)
        self.add_continue_head()
        self.add_reward_members()

    @property
    def model_rate(self) -> float:
        """The learning rate of the world model and its heads."""
        return float(self.hyperparameters.value("learning_rate"))

    def add_continue_head(self) -> None:
        """Make an optimiser of the world model's continue head, if it has one."""
        self.continue_optimizer: Optimizer | None = None
        if head := self.policy.world_model.continue_head:
            self.continue_optimizer = self.adam([list(head.parameters())], self.model_rate)

    def add_reward_members(self) -> None:
        """Make an optimiser of the world model's further reward heads, if it has any."""
        self.members_optimizer: Optimizer | None = None
        if members := self.policy.world_model.reward_members:
            parts = [list(member.parameters()) for member in members]
            self.members_optimizer = self.adam(parts, self.model_rate)

    def adam(self, parts: list[list[nn.Parameter]], rate: float) -> Optimizer:
        """Make an optimiser over parts whose gradients are clipped separately."""
        return descent.adam(parts, rate, self.hyperparameters.weight_decay)

    def configure(self, hyperparameters: Hyperparameters) -> None:
        """Use other hyperparameters from now on; the states of the optimisers are kept."""
        self.hyperparameters = hyperparameters.resolved()
        for optimizer in (self.model_optimizer, self.continue_optimizer, self.members_optimizer):
            if optimizer is not None:
                self.set_rate(optimizer, self.model_rate)

    def set_rate(self, optimizer: Optimizer, rate: float) -> None:
        """Set an optimiser's learning rate and weight decay."""
        for group in optimizer.param_groups:
            group["lr"] = rate
            group["weight_decay"] = descent.decay(rate, self.hyperparameters.weight_decay)

    def update_world_model(
        self,
        batch: Batch,
        generator: Generator,
        learn_reward: bool = False,
        states_loss: StatesLoss | None = None,
    ) -> tuple[Latent, Batch, Metrics]:
        """Take a step on Eq. (1) and, with `learn_reward`, on the reward likelihood.

        The likelihood (Algorithm 1, r_ξ) trains the reward head and, with the weight `reward_grad`,
        the states; this weight is 0 in the paper.

        :param batch: (B, T) sequences
        :param generator: source of the random numbers
        :param learn_reward: whether to train the reward head
        :param states_loss: a further loss, which trains the states
        :return: the posterior states (B, T, ...), without gradient, the batch with the rewards that
            actor and critic learn from, and the metrics
        """
        model = self.policy.world_model
        metrics: Metrics = {}
        with self.autocast():
            loss, post = world_model_update_loss(model, batch, generator, **self.eq_1_options)
            total = loss.total
            if learn_reward:
                feat = scale_gradient(post.feat, self.hyperparameters.reward_grad)
                logits = model.reward_head(feat)
                reward = reward_loss(logits, batch.reward, batch.reward_known, model.bin_range)
                total = total + reward
                metrics["train/reward_loss"] = reward.detach()
            if states_loss is not None:
                total = total + states_loss(post)
        norm = self.descend(self.model_optimizer, total, "world model")
        post = post.detach()
        if learn_reward:
            metrics |= self.update_reward_members(post, batch)
        return post, batch, metrics | world_model_metrics(loss, norm)

    def update_reward_members(self, post: Latent, batch: Batch) -> Metrics:
        """Take a step on the further reward heads, if there are any.

        :param post: (B, T, ...), the posterior states, without gradient
        """
        model = self.policy.world_model
        if self.members_optimizer is None:
            return {}
        feat = post.feat
        with self.autocast():
            losses = [
                reward_loss(head(feat), batch.reward, batch.reward_known, model.bin_range)
                for head in model.reward_members
            ]
        self.descend(self.members_optimizer, torch.stack(losses).sum(), "reward ensemble")
        with torch.no_grad(), self.autocast():
            spread = model.rewards(feat).std(-1, correction=0).mean()
        return {"train/reward_disagreement": spread}

    def update_continue_head(self, post: Latent, batch: Batch) -> Metrics:
        """Take a step on the continue head, if there is one, on the rows of the task itself.

        :param post: (B, T, ...), the posterior states, without gradient
        """
        head = self.policy.world_model.continue_head
        optimizer = self.continue_optimizer
        if head is None or optimizer is None or not self.hyperparameters.continue_head:
            return {}
        known = batch.reward_known.any(1, keepdim=True).expand_as(batch.is_terminal)
        with self.autocast():
            loss = continue_loss(head(post.feat).squeeze(-1), batch.is_terminal, known)
        self.descend(optimizer, loss, "continue")
        return {"train/continue_loss": loss.detach()}

    @property
    def eq_1_options(self) -> dict[str, Any]:
        """The keywords of `world_model_update_loss`."""
        names = ("dyn_scale", "rep_scale", "free_nats", "free_nats_mode", "pixel_weight")
        return {name: getattr(self.hyperparameters, name) for name in names}

    def descend(self, optimizer: Optimizer, loss: Tensor, name: str) -> Tensor:
        """Take a step on a loss; return the gradient's norm before clipping."""
        norm = descent.descend(optimizer, loss, name, self.hyperparameters.grad_clip)
        self.policy.updates += 1  # cached copies of the weights are out of date
        return norm

    def take_step(self, optimizer: Optimizer, loss: Tensor, name: str) -> Tensor:
        """Take a step on gradients that were computed; return their norm before clipping."""
        norm = descent.take_step(optimizer, loss, name, self.hyperparameters.grad_clip)
        self.policy.updates += 1
        return norm

    def autocast(self) -> AbstractContextManager[None]:
        """Return the context of a forward pass, by the keyword `precision`."""
        # The authors pre-train in float16; bfloat16 has float32's range and needs no loss scaling.
        bf16 = self.hyperparameters.precision == "bf16"
        kind = self.policy.device.type
        return torch.autocast(kind, torch.bfloat16, enabled=bf16, cache_enabled=True)


def world_model_metrics(loss: WorldModelLoss, norm: Tensor) -> Metrics:
    """Return the metrics of a step on Eq. (1)."""
    return {
        "train/reconstruction_loss": loss.reconstruction.detach(),
        "train/kl": loss.kl,
        "train/world_model_grad_norm": norm,
    }
