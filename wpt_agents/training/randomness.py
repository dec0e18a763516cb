"""Random numbers that depend on a seed, a purpose and a counter, and on nothing else.

There is no state to save: an agent that is loaded and continues draws what it would have drawn if
it had never stopped.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import torch
from torch import Generator, device


class Purpose(IntEnum):
    """The purposes of random numbers. The values are part of every seed: never reuse one."""

    PRETRAIN = 0
    UPDATE = 1
    CLONE = 2
    WINDOW = 3
    WARMUP = 4
    ACT = 5
    RETRIEVE = 6
    INITIALISE = 7
    REDRAW = 8  # of the networks, for the next task of a sequence
    CONTINUE = 9  # the continue head
    ENSEMBLE = 10  # the further reward heads
    ADAPT = 11  # of the world model to the retrieved trajectories
    IMITATE = 12  # the prior actor, from fixed latent states
    RESET = 100  # of the environment, before an explorer's episode


@dataclass(frozen=True)
class Streams:
    """Independent streams of random numbers.

    Example::

        Streams(seed=0).numpy(Purpose.CLONE, 7)  # always the same numbers
    """

    seed: int

    def numpy(self, purpose: Purpose, counter: int) -> np.random.Generator:
        """Return NumPy's generator at the beginning of a stream."""
        # a list of integers: NumPy mixes them, so that near seeds give independent streams
        return np.random.default_rng([self.seed, int(purpose), counter])

    def torch(self, purpose: Purpose, counter: int, device: device | str = "cpu") -> Generator:
        """Return torch's generator at the beginning of a stream."""
        return Generator(device).manual_seed(self.integer(purpose, counter))

    @contextmanager
    def weights(self, purpose: Purpose, counter: int, device: device) -> Iterator[None]:
        """Draw initial weights, which come from torch's own generators, from a stream."""
        with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
            torch.manual_seed(self.integer(purpose, counter))
            yield

    def integer(self, purpose: Purpose, counter: int) -> int:
        """Return a seed for other generators."""
        return torch_seed(self.numpy(purpose, counter))


def free_seed() -> int:
    """Return a seed for an agent without one; SB3's `set_random_seed` makes it repeatable."""
    return int(np.random.randint(2**31))


def torch_seed(rng: np.random.Generator) -> int:
    """Return a seed for torch's generators."""
    return int(rng.integers(2**31))  # what every generator accepts as a seed
