"""The updates of Algorithm 1: optimisers and one update of each network, Eq. (1) to (4)."""

from copy import deepcopy
from functools import partial
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from torch.optim import Optimizer

from wpt_agents.data.trajectory import Batch
from wpt_agents.model.actor_critic import (
    Actor,
    actor_loss,
    critic_loss,
    discounts,
    draw_starts,
    ema_update,
    lambda_return,
    return_range,
    survival,
)
from wpt_agents.model.behavior_cloning import FRAMES, bc_loss, recent_frames
from wpt_agents.model.dreamer_v3 import (
    advantage,
    reinforce_loss,
    replay_return,
    replay_value_loss,
)
from wpt_agents.model.layers import frozen
from wpt_agents.model.policy import Dream, WPTPolicy
from wpt_agents.model.rssm import Latent, over_steps
from wpt_agents.model.world_model import pessimistic_reward
from wpt_agents.training.hyperparameters import Hyperparameters
from wpt_agents.training.world_model_learner import Metrics, WorldModelLearner


class Worth(NamedTuple):
    """Rewards, values and returns of imagined trajectories: N starts, H steps."""

    reward: Tensor  # (N, H)
    value: Tensor  # (N, H + 1), of the target critic
    returns: Tensor  # (N, H), Eq. (2)
    goes_on: Tensor | None = None  # (N, H), the probability that the episode goes on after a step


class Learner(WorldModelLearner):
    """The optimisers of a policy's networks, and the updates that they make.

    Example::

        learner = Learner(policy, Hyperparameters(size="tiny"))
        metrics = learner.update(batch, generator)

    Keywords add losses to those of the paper: `reward_grad` and `imitation_grad` to the world
    model's, `kickstart` to the actor's, `repval_scale` and `slow_critic_scale` to the critic's. The
    networks that `reward_ensemble`, `continue_head` and `residual` add have losses of their own.

    :param policy: the networks to train
    :param hyperparameters: the keywords of `WPT`
    """

    def __init__(self, policy: WPTPolicy, hyperparameters: Hyperparameters) -> None:
        super().__init__(policy, hyperparameters)
        rate = self.actor_critic_rate
        self.actor_optimizer = self.adam([list(policy.actor.parameters())], rate)
        self.critic_optimizer = self.adam([list(policy.critic.parameters())], rate)
        self.add_imitator()

    @property
    def actor_critic_rate(self) -> float:
        """The learning rate of actor, critic and imitator."""
        return float(self.hyperparameters.value("actor_critic_learning_rate"))

    def configure(self, hyperparameters: Hyperparameters) -> None:
        """Use other hyperparameters from now on; the states of the optimisers are kept."""
        super().configure(hyperparameters)
        self.set_actor_critic_rate(1.0)

    def set_actor_critic_rate(self, share: float) -> None:
        """Set the learning rates of actor and critic to a share of their keyword."""
        rate = share * self.actor_critic_rate
        self.set_rate(self.actor_optimizer, rate)
        self.set_rate(self.critic_optimizer, rate)
        if self.imitator_optimizer is not None:
            self.set_rate(self.imitator_optimizer, rate)

    def add_imitator(self) -> None:
        """Make an optimiser of the policy's imitator, if it has one."""
        self.imitator_optimizer: Optimizer | None = None
        if imitator := self.policy.imitator:
            parts = [list(imitator.parameters())]
            self.imitator_optimizer = self.adam(parts, self.actor_critic_rate)

    def begin_imitator(self) -> None:
        """Make the optimiser of an imitator that was just copied from the actor.

        The new optimiser copies the state of the actor's. With a state of zeros, its first steps
        would be large, and the imitator would differ from the actor without any learning in
        imagination.
        """
        self.add_imitator()
        assert self.imitator_optimizer is not None
        state = self.actor_optimizer.state_dict()
        self.imitator_optimizer.load_state_dict(deepcopy(state))  # torch would share the averages

    def update(
        self,
        batch: Batch,
        generator: Generator,
        step: int = 0,
        imitation_weight: float = 0.0,
        head_start: bool = False,
    ) -> Metrics:
        """Train world model and heads on a batch, actor and critic in imagination from its states.

        :param batch: (B, T) sequences
        :param generator: source of the random numbers
        :param step: collected steps, on which schedules depend
        :param imitation_weight: weight of the loss with which the actor imitates the prior actor
        :param head_start: train the actor on this loss alone (`actor_delay`)
        :return: scalars by their names in the log
        """
        settings = self.hyperparameters
        has_imitator = settings.residual and self.policy.imitator is not None
        advice = self.advice(batch) if imitation_weight or has_imitator else None
        states_loss = None
        if advice is not None and imitation_weight and settings.imitation_grad:
            states_loss = partial(self.states_loss, advice=advice)
        post, rewarded, metrics = self.update_world_model(batch, generator, True, states_loss)
        metrics |= self.update_continue_head(post, batch)
        if advice is not None and has_imitator:
            metrics |= self.update_imitator(post, advice, imitation_weight)
        imitation: Tensor | float = 0.0
        if advice is not None and imitation_weight:
            loss = self.imitation_loss(self.policy.actor, post, advice)
            metrics["train/kickstart_loss"] = loss.detach()
            metrics["train/kickstart_weight"] = torch.full_like(loss.detach(), imitation_weight)
            imitation = imitation_weight * loss
        replay_loss: Tensor | float = 0.0
        if settings.repval_scale:
            loss = self.replay_value_loss(post, rewarded)
            metrics["train/replay_value_loss"] = loss.detach()
            replay_loss = settings.repval_scale * loss
        dream, worth = self.dream(post, rewarded, generator, step, head_start)
        spread, scale = self.return_scale(worth.returns)
        metrics |= self.update_actor(dream, worth, scale, step, imitation, head_start)
        metrics |= self.update_critic(dream, worth, replay_loss)
        self.policy.return_scale.copy_(spread)  # now that it is known to be finite
        return metrics | dream_metrics(dream, worth, scale)

    @torch.no_grad()
    def advice(self, batch: Batch) -> Tensor:
        """Return the prior actor's actions on the replayed images, (B (T - 2), A)."""
        policy = self.policy
        seen = recent_frames(batch.image, batch.is_first).flatten(0, 1)
        with self.autocast():
            return policy.prior_actor.act(seen, policy.action_mask)

    def imitation_loss(self, actor: Actor, post: Latent, advice: Tensor) -> Tensor:
        """Return the loss with which an actor imitates the prior actor (kickstarting).

        It is the mean squared distance of their actions on the replayed images. Not in the paper.
        Source: https://arxiv.org/abs/1803.03835

        :param post: (B, T, ...), the states of the replayed steps
        :param advice: (B (T - 2), A), the prior actor's actions, which need three images
        :return: scalar
        """
        mask = self.policy.action_mask
        feat = post.feat[:, FRAMES - 1 :].flatten(0, 1)
        with self.autocast():
            return bc_loss(actor.dist(feat, mask).mode, advice, mask)

    def update_imitator(self, post: Latent, advice: Tensor, imitation_weight: float) -> Metrics:
        """Take a step on the imitation loss of the imitator, the copy of the actor for `residual`.

        :param post: (B, T, ...), the states of the replayed steps
        :param advice: (B (T - 2), A), the prior actor's actions
        :param imitation_weight: the weight of this loss for the actor. The imitator's is the same,
            so that the two differ only by what the actor learns in imagination, or 1 if the actor's
            is 0
        """
        imitator = self.policy.imitator
        optimizer = self.imitator_optimizer
        if imitator is None or optimizer is None:
            return {}
        correction = self.correction(imitator, post)
        loss = self.imitation_loss(imitator, post, advice)
        self.descend(optimizer, (imitation_weight or 1.0) * loss, "imitator")
        return {"train/correction": correction, "train/imitator_loss": loss.detach()}

    @torch.no_grad()
    def correction(self, imitator: Actor, post: Latent) -> Tensor:
        """Return the root mean square of what `residual` adds to the prior actor's actions.

        :param post: (B, T, ...), the states of the replayed steps
        :return: scalar, over the entries that are not padded
        """
        mask = self.policy.action_mask
        feat = post.feat.flatten(0, 1)
        with self.autocast():
            added = self.policy.actor.dist(feat, mask).mean - imitator.dist(feat, mask).mean
        return added[:, mask].square().mean().sqrt()

    def states_loss(self, post: Latent, advice: Tensor) -> Tensor:
        """Return the weighted loss with which imitation trains the states; the actor is fixed.

        :param post: (B, T, ...), the states of the replayed steps, with their gradient
        :param advice: (B (T - 2), A), the prior actor's actions
        """
        actor = self.policy.actor
        with frozen(actor):
            return self.hyperparameters.imitation_grad * self.imitation_loss(actor, post, advice)

    def replay_value_loss(self, post: Latent, batch: Batch) -> Tensor:
        """Return DreamerV3's replay value loss, on the rows whose rewards are known.

        DreamerV3 bootstraps from the imagined return of each replayed state. Here imagination
        starts from some states only (`imagine_starts`), so the target critic's value replaces this
        return.

        :param post: (B, T, ...), the states of the replayed steps
        """
        settings = self.hyperparameters
        with self.autocast():
            with torch.no_grad():
                value = self.policy.target_critic.value(post.feat)
            ends = batch.is_first[:, 1:]
            is_last = torch.cat([ends, torch.zeros_like(batch.is_first[:, :1])], 1)
            returns = replay_return(
                batch.reward, value, is_last, batch.is_terminal, settings.gamma, settings.lam
            )
            logits = self.policy.critic(post.feat)
            bin_range = self.policy.bin_range
            return replay_value_loss(logits, returns, batch.reward_known, bin_range)

    def draw_starts(self, batch: Batch, generator: Generator) -> Tensor:
        """Return which of the flattened B x T states to imagine from, (N,)."""
        number = self.hyperparameters.value("imagine_starts")
        rows, length = batch.is_first.shape
        return draw_starts(rows, length, number, generator, self.policy.device)

    def dream(
        self, post: Latent, rewarded: Batch, generator: Generator, step: int, head_start: bool
    ) -> tuple[Dream, Worth]:
        """Imagine from replayed states, and compute rewards, values and returns.

        :param post: (B, T, ...), the states of the replayed steps
        :param rewarded: the batch with the rewards for arriving in these states
        :param step: collected steps, on which the pessimism depends
        :param head_start: whether the actor is trained on imitation alone
        """
        index = self.draw_starts(rewarded, generator)
        start = post.flatten_time().pick(index)
        arrival = rewarded.reward.flatten()[index]
        # REINFORCE needs no gradient through the dream, nor does the actor in its head start.
        through_dream = self.hyperparameters.actor_grad == "dynamics" and not head_start
        with self.autocast(), torch.set_grad_enabled(through_dream):
            dream = self.policy.dream(start, self.hyperparameters.imagine_horizon, generator)
            return dream, self.worth(dream, arrival, step)

    def worth(self, dream: Dream, arrival: Tensor, step: int = 0) -> Worth:
        """Compute rewards, values and returns of imagined trajectories, Eq. (2).

        :param dream: the trajectories
        :param arrival: (N,), the replayed rewards for arriving in the states from which they start
        :param step: collected steps, on which the pessimism depends
        """
        settings = self.hyperparameters
        reward = self.imagined_reward(dream, arrival, step)
        value = over_steps(self.policy.target_critic.value, dream.states)
        goes_on = self.imagined_continue(dream)
        returns = lambda_return(reward, value, settings.gamma, settings.lam, goes_on)
        return Worth(reward, value, returns, goes_on)

    def imagined_reward(self, dream: Dream, arrival: Tensor, step: int) -> Tensor:
        """Return the rewards for arriving in the imagined states 0 .. H-1, (N, H).

        :param arrival: as in `worth`; the reward heads do not need it, but a subclass without them
            may
        """
        model = self.policy.world_model
        states = dream.states.but_last()
        with frozen(model):
            if model.reward_members:
                rewards = over_steps(model.rewards, states)
                return pessimistic_reward(rewards, self.hyperparameters.pessimism_at(step))
            return over_steps(model.reward, states)

    def imagined_continue(self, dream: Dream) -> Tensor | None:
        """Return the probability of continuing after the steps 0 .. H-1, (N, H); None means 1."""
        model = self.policy.world_model
        if model.continue_head is None or not self.hyperparameters.continue_head:
            return None
        with frozen(model):
            return over_steps(model.goes_on, dream.states.but_last())

    def return_scale(self, returns: Tensor) -> tuple[Tensor, Tensor]:
        """Return the running 5-95 % range of the returns and the divisor of returns, scalars.

        :param returns: (N, H)
        """
        before = self.policy.return_scale
        if not self.hyperparameters.value("return_norm"):
            return before, torch.ones_like(before)
        width = return_range(returns)
        unknown = before == 0  # these are the first returns
        spread = torch.where(unknown, width, before.lerp(width, 0.01))  # DreamerV3's rate
        return spread, spread.clamp_min(1.0)

    def update_actor(
        self,
        dream: Dream,
        worth: Worth,
        scale: Tensor,
        step: int,
        imitation: Tensor | float = 0.0,
        head_start: bool = False,
    ) -> Metrics:
        """Take a step on Eq. (4) and the imitation, or in the head start on the imitation alone.

        Without a prior actor to imitate, the actor is not updated during the head start: reward
        head and critic learn first.

        :param scale: the divisor of returns
        :param imitation: the weighted imitation loss, which is added to the loss, but not to its
            metric
        """
        # In a new context: torch before 2.11 would use the weights again that it has cast in the
        # dream, without gradient for REINFORCE. Source: https://github.com/pytorch/pytorch/pull/165068
        with self.autocast():
            loss = self.actor_loss(dream, worth, scale, step)
        total = imitation if head_start else loss + imitation
        norm = torch.zeros_like(scale)
        if isinstance(total, Tensor):
            norm = self.descend(self.actor_optimizer, total, "actor")
        return {"train/actor_loss": loss.detach(), "train/actor_grad_norm": norm}

    def actor_loss(self, dream: Dream, worth: Worth, scale: Tensor, step: int = 0) -> Tensor:
        """Compute Eq. (4), or DreamerV3's REINFORCE loss on the imagined actions.

        :param scale: the divisor of returns
        :param step: collected steps, on which the weight of the entropy depends
        """
        settings = self.hyperparameters
        reward, value, returns, goes_on = worth
        gamma = settings.gamma
        ent_coef = settings.ent_coef_at(step)
        if settings.actor_grad == "dynamics":
            return actor_loss(returns, dream.entropy, ent_coef, gamma, scale, goes_on)
        feat = dream.states.but_last().but_last().feat.detach()
        dist = self.policy.actor.dist(feat, self.policy.action_mask)
        weight = discounts(returns.shape[1] - 1, gamma, returns)
        if goes_on is not None:  # without c_t, which the advantage contains
            weight = weight * survival(goes_on)[:, :-1]
        return reinforce_loss(
            dist.log_prob(dream.action[:, :-1].detach()),
            advantage(reward, value, returns, gamma if goes_on is None else gamma * goes_on),
            dist.entropy(),
            weight,
            ent_coef,
            scale,
        )

    def update_critic(
        self, dream: Dream, worth: Worth, replay_loss: Tensor | float = 0.0
    ) -> Metrics:
        """Take a step on Eq. (3), and move the target critic.

        :param replay_loss: the weighted replay value loss, which is added to the loss, but not to
            its metric
        """
        policy = self.policy
        settings = self.hyperparameters
        gamma = settings.gamma
        goes_on = worth.goes_on
        bin_range = policy.bin_range
        with self.autocast():
            logits = over_steps(policy.critic, dream.states.detach().but_last())
            loss = critic_loss(logits, worth.returns, gamma, goes_on, bin_range)
            total = loss + replay_loss
            if settings.slow_critic_scale:  # DreamerV3's regulariser, towards the target critic
                slow = critic_loss(logits, worth.value[:, :-1], gamma, goes_on, bin_range)
                total = total + settings.slow_critic_scale * slow
        norm = self.descend(self.critic_optimizer, total, "critic")
        ema_update(policy.target_critic, policy.critic, settings.target_fraction)
        return {"train/critic_loss": loss.detach(), "train/critic_grad_norm": norm}


def dream_metrics(dream: Dream, worth: Worth, scale: Tensor) -> Metrics:
    """Return the metrics of imagined trajectories."""
    return {
        "train/value": worth.value.detach().mean(),
        "train/imagined_reward": worth.reward.detach().mean(),
        "train/entropy": dream.entropy.detach().mean(),
        "train/saturated_actions": dream.saturated,
        "train/return_scale": scale,
    }
