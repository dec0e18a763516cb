"""// Update Models of Algorithm 1: one gradient step of each network, and what it draws on.

`WPT` inherits `Updates`, so that `wpt.py` holds the algorithm and this module its gradient steps.
"""

from contextlib import AbstractContextManager
from typing import Any

import numpy as np
import torch
from torch import Generator, Tensor
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW, Optimizer

import wpt_agents.fast  # noqa: F401  # registers the faster twins of what the model defines
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer, mix
from wpt_agents.data.trajectory import Batch
from wpt_agents.model.actor_critic import (
    actor_loss,
    critic_loss,
    draw_starts,
    ema_update,
    lambda_return,
    return_range,
)
from wpt_agents.model.behavior_cloning import FRAMES, bc_loss, recent_frames
from wpt_agents.model.layers import frozen
from wpt_agents.model.policy import Dream, WPTPolicy
from wpt_agents.model.rssm import Latent, over_steps
from wpt_agents.model.sizes import find_size
from wpt_agents.model.world_model import WorldModelLoss, reward_loss, world_model_update_loss
from wpt_agents.training.guidance import Schedule

# Purposes of random streams.
PRETRAIN, UPDATE, CLONE, WINDOW, WARMUP, ACT, RETRIEVE, INITIALISE = range(8)
INITIAL_IMAGES = 128, 4  # sequences, and images of each, that a new posterior is adapted to


class Updates:
    """The optimisers of a policy's networks and the steps they take, by the keywords of WPT."""

    policy: WPTPolicy
    device: torch.device
    replay_buffer: ReplayBuffer
    retrieved: ReplayBuffer | None
    learning_rate: float
    stream_seed: int
    updates: int
    task_updates: int
    initialised: bool
    starts: Tensor
    num_timesteps: int
    cloned: bool
    kickstart_schedule: Schedule
    size: str | dict[str, Any]
    actor_critic_learning_rate: float | None
    max_action_dim: int
    batch_size: int
    batch_length: int
    offline_ratio: float
    weight_decay: float
    grad_clip: float
    dyn_scale: float
    rep_scale: float
    free_nats: float
    free_nats_mode: str
    imagine_horizon: int
    imagine_starts: int | None
    actor_delay: int
    gamma: float
    lam: float
    ent_coef: float
    target_fraction: float
    return_norm: bool
    precision: str

    def _setup_optimizers(self) -> None:
        policy, model_rate = self.policy, float(self.learning_rate)
        rate = self.actor_critic_learning_rate
        if rate is None:
            rate = find_size(self.size).actor_critic_learning_rate
        model = policy.world_model
        parts = [model.dynamics_parameters(), list(model.reward_head.parameters())]
        self.model_optimizer = self._optimizer(parts, model_rate)
        self.actor_optimizer = self._optimizer([list(policy.actor.parameters())], rate)
        self.critic_optimizer = self._optimizer([list(policy.critic.parameters())], rate)

    def _optimizer(self, parts: list[list[torch.nn.Parameter]], rate: float) -> Optimizer:
        """Adam over parts that are clipped each by itself."""
        decay = self.weight_decay / rate if rate else 0.0  # AdamW multiplies it with the rate again
        groups = [{"params": part} for part in parts]
        return AdamW(groups, rate, eps=1e-5, weight_decay=decay, fused=True)

    def _initialise(self, data: TrajectoryDataset | ReplayBuffer) -> None:
        """Standardise a new world model's posterior by 512 images of the data, once."""
        if not self.initialised:
            rng = self._stream(INITIALISE, 0)
            batch = data.sample(*INITIAL_IMAGES, self.max_action_dim, rng)
            self.policy.world_model.standardise(batch.image.flatten(0, 1).to(self.device))
            self.initialised = True

    def update(self, metrics: dict[str, list[Tensor]]) -> None:
        """One gradient step of every network on a mixed batch; appends to `metrics`."""
        self._initialise(self.replay_buffer)
        batch = mix(
            self.replay_buffer,
            self.retrieved,
            self.offline_ratio,
            self.batch_size,
            self.batch_length,
            self.max_action_dim,
            self._stream(UPDATE, self.updates),
        ).to(self.device)
        self._update_on(batch, metrics)
        self.updates += 1
        self.task_updates += 1

    def _update_on(self, batch: Batch, metrics: dict[str, list[Tensor]]) -> None:
        """World model and reward head on the batch; actor and critic on dreams from its states."""
        generator = self._generator(UPDATE, self.updates)
        post = self._update_world_model(batch, metrics, generator, learn_reward=True)
        imitation = self._imitation(post, batch, metrics)
        self.starts = self._draw_starts(batch, generator)
        start = post.flatten_time().pick(self.starts)
        self._update_behavior(start, metrics, generator, imitation)

    def _draw_starts(self, batch: Batch, generator: Generator) -> Tensor:
        """Return the numbers of the batch's states to imagine from."""
        number = self.imagine_starts
        if number is None:
            number = self.policy.size.imagine_starts
        rows, length = batch.is_first.shape
        return draw_starts(rows, length, number, generator, self.device)

    def _update_world_model(
        self,
        batch: Batch,
        metrics: dict[str, list[Tensor]],
        generator: Generator,
        learn_reward: bool = False,
    ) -> Latent:
        """Eq. (1), and the reward likelihood on states cut off from the world model."""
        model = self.policy.world_model
        with self._autocast():
            loss, post = world_model_update_loss(model, batch, generator, **self._eq_1_options)
            total = loss.total
            if learn_reward:
                logits = model.reward_head(post.feat.detach())
                reward = reward_loss(logits, batch.reward, batch.reward_known)
                total = total + reward
                metrics["train/reward_loss"].append(reward.detach())
        norm = self._descend(self.model_optimizer, total, "world model")
        note(metrics, loss, norm)
        return post.detach()

    @property
    def _eq_1_options(self) -> dict[str, Any]:
        names = "dyn_scale", "rep_scale", "free_nats", "free_nats_mode"
        return {name: getattr(self, name) for name in names}

    def _imitation(
        self, post: Latent, batch: Batch, metrics: dict[str, list[Tensor]]
    ) -> Tensor | float:
        """Kickstarting: what the actor pays for doing otherwise than the prior actor would.

        The paper does not have it. Source: https://arxiv.org/abs/1803.03835
        """
        weight = self.kickstart_schedule(self.num_timesteps) if self.cloned else 0.0
        if self._in_head_start() and self.cloned:
            weight = max(
                weight, 1.0
            )  # the only term of the actor's loss, so its size is immaterial
        if weight == 0:
            return 0.0
        policy, mask = self.policy, self.policy.action_mask
        seen = recent_frames(batch.image, batch.is_first).flatten(0, 1)
        feat = post.feat[:, FRAMES - 1 :].flatten(0, 1)
        with self._autocast():
            with torch.no_grad():
                advice = policy.prior_actor.act(seen, mask)
            loss = bc_loss(policy.actor.dist(feat, mask).mode, advice, mask)
        metrics["train/kickstart_loss"].append(loss.detach())
        return weight * loss

    def _in_head_start(self) -> bool:
        """Whether the actor still leaves the dreams to the critic."""
        return self.task_updates < self.actor_delay

    def _update_behavior(
        self,
        start: Latent,
        metrics: dict[str, list[Tensor]],
        generator: Generator,
        imitation: Tensor | float = 0.0,
    ) -> None:
        """Actor and critic on imagined trajectories, Eq. (2) to (4).

        During the head start (`actor_delay`) the actor's loss is the imitation alone, and without a
        prior actor it is not updated: reward head and critic first learn what the dreams are worth.

        :param imitation: added to the actor's loss, and not to what is logged of it
        """
        policy = self.policy
        ahead = self._in_head_start()
        with self._autocast(), torch.set_grad_enabled(not ahead):
            dream = policy.dream(start, self.imagine_horizon, generator)
            reward = self._imagined_reward(dream)
            value = over_steps(policy.target_critic.value, dream.states)
            returns = lambda_return(reward, value, self.gamma, self.lam)
            spread = scale = torch.ones_like(policy.return_scale)
            if self.return_norm:
                width = return_range(returns)
                unknown = policy.return_scale == 0  # these are the first returns
                spread = torch.where(unknown, width, policy.return_scale.lerp(width, 0.01))
                scale = spread.clamp_min(1.0)
            loss = actor_loss(returns, dream.entropy, self.ent_coef, self.gamma, scale)
        objective = imitation if ahead else loss + imitation
        actor_norm = torch.zeros_like(scale)
        if isinstance(objective, Tensor):
            actor_norm = self._descend(self.actor_optimizer, objective, "actor")
        policy.return_scale.copy_(spread)  # now that it is known to be finite
        with self._autocast():
            logits = over_steps(policy.critic, dream.states.detach().but_last())
            value_loss = critic_loss(logits, returns, self.gamma)
        critic_norm = self._descend(self.critic_optimizer, value_loss, "critic")
        ema_update(policy.target_critic, policy.critic, self.target_fraction)
        for key, tensor in {
            "actor_loss": loss,
            "critic_loss": value_loss,
            "value": value.mean(),
            "imagined_reward": reward.mean(),
            "entropy": dream.entropy.mean(),
            "saturated_actions": dream.saturated,
            "return_scale": scale,
            "actor_grad_norm": actor_norm,
            "critic_grad_norm": critic_norm,
        }.items():
            metrics[f"train/{key}"].append(tensor.detach())

    def _imagined_reward(self, dream: Dream) -> Tensor:
        """(N, H): what arriving in the imagined states 0 .. H-1 pays."""
        model = self.policy.world_model
        with frozen(model):
            return over_steps(model.reward, dream.states.but_last())

    def _descend(self, optimizer: Optimizer, loss: Tensor, name: str) -> Tensor:
        """One optimiser step; refuses a loss or gradient that is not finite, keeping the weights.

        :return: the gradient's norm before clipping
        """
        optimizer.zero_grad()
        loss.backward()
        return self._step(optimizer, loss, name)

    def _step(self, optimizer: Optimizer, loss: Tensor, name: str) -> Tensor:
        """What `_descend` does once the gradients of `loss` are there."""
        groups = [group["params"] for group in optimizer.param_groups]
        norms = [clip_grad_norm_(weights, self.grad_clip) for weights in groups]
        if not torch.isfinite(sum(norms, loss.detach())):
            raise FloatingPointError(
                f"The {name} loss is {loss.item()} at update {self.updates}, its gradient norm "
                f"{float(sum(norms))}; this step was not taken and the weights are finite: save "
                "them, and look at the data or lower the learning rate"
            )
        optimizer.step()
        self.policy.updates += 1  # cached copies of the weights are out of date
        return norms[0]

    def _autocast(self) -> AbstractContextManager[None]:
        return torch.autocast(
            self.device.type, torch.bfloat16, enabled=self.precision == "bf16", cache_enabled=True
        )

    def _stream(self, purpose: int, counter: int) -> np.random.Generator:
        """Random numbers that depend on the seed, what they are for, and a counter; no state."""
        return np.random.default_rng([self.stream_seed, purpose, counter])

    def _generator(self, purpose: int, counter: int) -> Generator:
        seed = torch_seed(self._stream(purpose, counter))
        return Generator(self.device).manual_seed(seed)


def note(metrics: dict[str, list[Tensor]], loss: WorldModelLoss, norm: Tensor) -> None:
    """Appends what a step on Eq. (1) has to tell."""
    metrics["train/reconstruction_loss"].append(loss.reconstruction.detach())
    metrics["train/kl"].append(loss.kl)
    metrics["train/world_model_grad_norm"].append(norm)


def torch_seed(rng: np.random.Generator) -> int:
    """A seed for torch's generators."""
    return int(rng.integers(2**31))
