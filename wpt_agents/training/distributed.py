"""The processes that train together, as `torchrun` starts them."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from itertools import count
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from stable_baselines3.common.utils import get_device
from torch import Tensor

T = TypeVar("T")
PATIENCE = timedelta(days=1)  # the others wait while rank 0 collects or converts data


@dataclass(frozen=True)
class World:
    """The processes that train together, and which of them this one is.

    :param rank: 0 to size - 1; rank 0 prints and writes
    :param size: the number of processes
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
        """Check that all processes were called with the same arguments.

        :param facts: the arguments by name
        :raises ValueError: in all processes, an argument that differs; the message names it
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

    Under a name that was used before, they would find the addresses of closed connections.
    """
    restarts = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    return f"wpt-{restarts}-{next(_meetings)}"


def local_device(device: torch.device | str = "auto") -> torch.device:
    """Return the device as SB3 does; torchrun's processes get one GPU each unless one is named."""
    device = get_device(device)
    if device.type == "cuda" and device.index is None and "LOCAL_RANK" in os.environ:
        return torch.device("cuda", int(os.environ["LOCAL_RANK"]))
    return device
