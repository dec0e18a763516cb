"""Eq. (1) on a batch whose gradients several processes or several passes compute.

The random numbers of a row and the clipping of the KL do not depend on the division of a batch, so
losses and weights equal those of one process up to rounding.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from wpt_agents.data.trajectory import Batch
from wpt_agents.model.distributions import Share, kl_one_hot
from wpt_agents.model.layers import frozen
from wpt_agents.model.world_model import WorldModel, WorldModelLoss, world_model_update_loss
from wpt_agents.training.distributed import World
from wpt_agents.training.world_model_learner import WorldModelLearner


class Divided:
    """Eq. (1) on batches that are divided over processes, and in each over several passes.

    :param learner: the learner of the world model; the copies of all processes become equal
    :param world: the processes that share the work
    :param passes: number of passes in which each process computes its share, to save memory
    :raises ValueError: a batch that cannot be divided so
    """

    def __init__(self, learner: WorldModelLearner, world: World, passes: int) -> None:
        batch_size = learner.hyperparameters.batch_size
        if passes < 1 or batch_size % (world.size * passes):
            raise ValueError(
                f"batch_size={batch_size} cannot be divided over {world.size} processes of "
                f"accumulate={passes} passes each: it must be a multiple of their product"
            )
        self.model = learner.policy.world_model
        self.world = world
        self.passes = passes
        self.batch_size = batch_size
        self.autocast = learner.autocast
        self.options = learner.eq_1_options
        self.objective: nn.Module = _Objective(self.model, self.options)
        if world.size > 1:
            with frozen(*self.model.heads):  # DDP waits for the gradients of all else
                self.objective = DistributedDataParallel(self.objective)

    def backward(self, share: Batch, device: torch.device, seed: int) -> WorldModelLoss:
        """Add the whole batch's gradients to the weights' gradients and return its losses.

        :param share: this process's rows, `World.share` of them
        :param device: the device to compute on
        :param seed: seed of the random numbers, the same in all processes
        """
        parts = [part.to(device) for part in share.split(self.passes)]
        whole = self._whole_kl(parts, seed)
        losses = []
        for i, part in enumerate(parts):
            with self._in_step(last=i + 1 == self.passes):
                with self.autocast():
                    loss = self.objective(part, self._draws(part, i, seed), whole)
                # Passes have equally many rows, so the mean of their losses is the batch's.
                (loss.total / self.passes).backward()
            losses.append(torch.stack([term.detach() for term in loss]))
        return WorldModelLoss(*self.world.mean(torch.stack(losses).mean(0)))

    def _draws(self, part: Batch, i: int, seed: int) -> Share:
        first = (self.world.rank * self.passes + i) * len(part.image)
        generator = Share(part.image.device, self.batch_size, first)
        generator.manual_seed(seed)
        return generator

    def _in_step(self, last: bool) -> AbstractContextManager[None]:
        """Return a context in which gradients are added up over processes in the last pass only."""
        if last or not isinstance(self.objective, DistributedDataParallel):
            return nullcontext()
        return self.objective.no_sync()

    @torch.no_grad()
    def _whole_kl(self, parts: list[Batch], seed: int) -> Callable[[Tensor], Tensor]:
        """Return a function that turns a part's mean KL into the whole batch's.

        The first of several passes needs the KL of all parts, for which each part passes through
        encoder and RSSM once more.
        """
        if self.passes == 1 or self.options["free_nats_mode"] != "mean":
            return self.world.mean
        kls = []
        for i, part in enumerate(parts):
            with self.autocast():
                _, post, prior = self.model.observe(part, self._draws(part, i, seed))
            kls.append(kl_one_hot(post, prior).mean())
        kl = self.world.mean(torch.stack(kls).mean())
        return lambda _: kl


class _Objective(nn.Module):
    """Eq. (1) of a part of a batch, as the forward pass that DistributedDataParallel needs."""

    def __init__(self, model: WorldModel, options: dict[str, Any]) -> None:
        super().__init__()
        self.model = model
        self.options = options

    def forward(
        self, batch: Batch, draws: Share, whole: Callable[[Tensor], Tensor]
    ) -> WorldModelLoss:
        if self.options["free_nats_mode"] == "element":
            return world_model_update_loss(self.model, batch, draws, **self.options)[0]
        options = self.options | {"free_nats": 0.0}
        loss, _ = world_model_update_loss(self.model, batch, draws, **options)
        total = part_total(loss, whole(loss.kl), self.options["free_nats"])
        return loss._replace(total=total)


def part_total(loss: WorldModelLoss, whole_kl: Tensor, free_nats: float) -> Tensor:
    """Return a part's Eq. (1), whose KL has a gradient unless free nats clip the whole batch's.

    A KL that they clip is a constant and left out.

    :param loss: the losses of the part, without free nats
    :param whole_kl: the mean KL of the whole batch
    """
    return torch.where(whole_kl < free_nats, loss.reconstruction, loss.total)
