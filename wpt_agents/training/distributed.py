"""One batch's gradients from several processes, as `torchrun` starts them, or from several passes.

Whoever computes a row, its random draws and the clip of its KL are those of the whole batch, so
that losses and weights are those of one process to rounding.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from datetime import timedelta
from itertools import count
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from stable_baselines3.common.utils import get_device
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from wpt_agents.data.trajectory import Batch
from wpt_agents.model.distributions import Share, kl_one_hot
from wpt_agents.model.layers import frozen
from wpt_agents.model.world_model import WorldModel, WorldModelLoss, world_model_loss

T = TypeVar("T")
PATIENCE = timedelta(days=1)  # the others wait while rank 0 collects or converts data


@dataclass(frozen=True)
class World:
    """The processes that train together, and which of them this one is.

    :param rank: 0 to size - 1; rank 0 prints and writes
    :param size: how many there are
    """

    rank: int = 0
    size: int = 1

    @classmethod
    def current(cls) -> "World":
        """Return the processes that `torch.distributed` connects, or this one alone."""
        if dist.is_available() and dist.is_initialized():
            return cls(dist.get_rank(), dist.get_world_size())
        return cls()

    def share(self, rows: int) -> slice:
        """Return this process's part of some rows."""
        part = rows // self.size
        return slice(self.rank * part, (self.rank + 1) * part)

    def mean(self, value: Tensor) -> Tensor:
        """Return the mean of the processes' values, without gradient."""
        if self.size > 1:
            value = value / self.size
            dist.all_reduce(value)
        return value

    def largest(self, value: int, device: torch.device) -> int:
        """Return the largest of the processes' values."""
        if self.size == 1:
            return value
        largest = torch.tensor(value, device=device)
        dist.all_reduce(largest, dist.ReduceOp.MAX)
        return int(largest)

    def barrier(self) -> None:
        """Wait until every process is here."""
        if self.size > 1:
            dist.barrier()

    def rank_0s(self, value: T) -> T:
        """Broadcast rank 0's value to every process."""
        box = [value]
        if self.size > 1:
            dist.broadcast_object_list(box)
        return box[0]

    @contextmanager
    def rank_0_first(self) -> Iterator[None]:
        """Run the block in rank 0 before the others, which then find what it made."""
        if self.rank > 0:
            self.barrier()
        try:
            yield
        finally:
            if self.rank == 0:
                self.barrier()

    def check_same(self, facts: dict[str, Any]) -> None:
        """Refuse processes that were called with different arguments.

        :raises ValueError: naming what differs; in all of them
        """
        everyones: list[Any] = [facts] * self.size
        if self.size > 1:
            dist.all_gather_object(everyones, facts)
        for name in facts:
            values = [everyone[name] for everyone in everyones]
            if any(value != values[0] for value in values):
                raise ValueError(
                    f"The processes differ in {name}, by rank: {values}. Make the same call "
                    "in each, with dataset and run_dir in folders that all of them see"
                )


def started_by_torchrun() -> bool:
    """Return whether torchrun, or what sets the same variables, started several processes."""
    return "RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1


@contextmanager
def joined(device: torch.device) -> Iterator[World]:
    """Connect the processes that `torchrun` started with this one while the block runs.

    They stay connected if they are already. Without torchrun this process is alone.
    """
    if not started_by_torchrun() or World.current().size > 1:
        yield World.current()
        return
    gpu = device if device.type == "cuda" else None
    if gpu:
        torch.cuda.set_device(gpu)  # objects, too, are sent by way of it
    # torch exports both names only where it was built with `distributed`, which mypy cannot know.
    meet = dist.rendezvous  # type: ignore[attr-defined, unused-ignore]
    store, rank, size = next(meet("env://", timeout=PATIENCE))
    backend = "nccl" if gpu else "gloo"
    store = dist.PrefixStore(_meeting(), store)  # type: ignore[attr-defined, unused-ignore]
    dist.init_process_group(
        backend, store=store, rank=rank, world_size=size, timeout=PATIENCE, device_id=gpu
    )
    try:
        yield World.current()
    finally:
        dist.destroy_process_group()


_meetings = count()


def _meeting() -> str:
    """Return a new name for each time that the processes connect.

    Under a name that was used before they would find the addresses of closed connections.
    """
    restarts = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    return f"wpt-{restarts}-{next(_meetings)}"


def local_device(device: torch.device | str = "auto") -> torch.device:
    """Return the device as SB3 does; torchrun's processes get one GPU each unless one is named."""
    device = get_device(device)
    if device.type == "cuda" and device.index is None and "LOCAL_RANK" in os.environ:
        return torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    return device


class Divided:
    """Eq. (1) on batches that are divided over processes, and in each over several passes.

    :param model: every process's copy; they become equal
    :param passes: over each process's share, to save memory
    :param batch_size: rows of the whole batch
    :param autocast: what a forward pass runs in
    :param options: `Learner.eq_1_options`
    :raises ValueError: a batch that cannot be divided so
    """

    def __init__(
        self,
        model: WorldModel,
        world: World,
        passes: int,
        batch_size: int,
        autocast: Callable[[], AbstractContextManager[None]],
        options: dict[str, Any],
    ) -> None:
        if passes < 1 or batch_size % (world.size * passes):
            raise ValueError(
                f"batch_size={batch_size} cannot be divided over {world.size} processes of "
                f"accumulate={passes} passes each: it must be a multiple of their product"
            )
        self.model = model
        self.world = world
        self.passes = passes
        self.batch_size = batch_size
        self.autocast = autocast
        self.options = options
        self.objective: nn.Module = _Objective(model, options)
        if world.size > 1:
            with frozen(*model.heads):  # DDP waits for the gradients of all else
                self.objective = DistributedDataParallel(self.objective)

    def backward(self, share: Batch, device: torch.device, seed: int) -> WorldModelLoss:
        """Add the whole batch's gradients to the weights' gradients and return its losses.

        :param share: this process's rows, `World.share` of them
        :param seed: of the random draws, the same in all processes
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

        The first of several passes needs to know the KL of all, which costs each part one more way
        through encoder and RSSM.
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
        post, post_logits, prior_logits = self.model.observe(batch, draws)
        options = dict(self.options)
        error = self.model.batch_error(post, batch, options.pop("pixel_weight"))
        if options["free_nats_mode"] == "mean":
            kl = kl_one_hot(post_logits, prior_logits).mean().detach()
            options["free_nats"] = part_free_nats(options["free_nats"], kl, whole(kl))
        return world_model_loss(error, post_logits, prior_logits, **options)


def part_free_nats(free_nats: float, part_kl: Tensor, whole_kl: Tensor) -> Tensor:
    """Return the free nats that clip the mean KL of a part where the whole batch's is clipped.

    With f free nats, Eq. (1) takes max(f, kl) of the whole batch's KL. A part with the KL k takes
    max(f + k - kl, k) = max(f, kl) + k - kl instead: it is clipped exactly where the whole is, and
    as the mean of all k is kl, the mean over all parts is max(f, kl).
    """
    return free_nats + part_kl - whole_kl
