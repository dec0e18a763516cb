"""The time of a batch from memory, and the memory of the images."""

from collections.abc import Iterator
from functools import partial

import numpy as np

from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.bench.timing import memory_mib, seconds

LENGTH, ACTIONS = 500, 6


def rows(quick: bool = False) -> Iterator[dict]:
    """Yield a row for each number of stored images: their size, and the growth of the process."""
    for frames in (2_000,) if quick else (100_000, 10_000):
        before = memory_mib("VmRSS")
        replay = filled(frames)
        grown = memory_mib("VmRSS") - before
        sample = partial(replay.sample, 16, 64, ACTIONS, np.random.default_rng(0))
        processor, wall = seconds(sample, 3 if quick else 100, warmup=3)
        yield {
            "what": "replay sample",
            "frames": frames,
            "batch": 16,
            "length": 64,
            "threads": 1,
            "median_s": processor,
            "wall_s": wall,
            "image_mb": sum(t.image.nbytes for t in replay.trajectories) / 2**20,
            "held_mb": grown,
            "rss_mb": memory_mib("VmRSS"),
        }
        del replay, sample  # otherwise the next case would start with its memory


def filled(frames: int) -> ReplayBuffer:
    """Return episodes of 500 steps with `frames` images in total."""
    rng = np.random.default_rng(0)
    replay = ReplayBuffer()
    for _ in range(frames // (LENGTH + 1)):
        replay.add(
            Trajectory(
                rng.integers(0, 256, (LENGTH + 1, 64, 64, 3), np.uint8),
                rng.uniform(-1, 1, (LENGTH, ACTIONS)).astype(np.float32),
                rng.normal(size=LENGTH).astype(np.float32),
            )
        )
    return replay
