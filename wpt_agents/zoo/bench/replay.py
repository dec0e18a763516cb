"""The time of a batch from memory, with and without marked pixels, and the memory of the images."""

import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

from wpt_agents.data.replay import ReplayBuffer, mix
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.zoo.bench.timing import memory_mib, seconds

LENGTH, ACTIONS = 500, 6
BATCH = 16, 64  # Table 2's


def rows(quick: bool = False) -> Iterator[dict]:
    """Yield two rows for each number of stored images: a batch, and one for `pixel_weight`.

    Columns are the time of a batch, the size of the images, and the growth of the process. For
    `pixel_weight`, `background_s` is the time to compute the background of an episode, once.
    """
    for frames in (2_000,) if quick else (100_000, 10_000):
        before = memory_mib("VmRSS")
        replay = filled(frames)
        grown = memory_mib("VmRSS") - before
        sizes = {
            "frames": frames,
            "image_mb": sum(t.image.nbytes for t in replay.trajectories) / 2**20,
            "held_mb": grown,
        }
        yield sampling("replay sample", replay, quick) | sizes
        start = time.process_time()
        for trajectory in replay.trajectories:
            _ = trajectory.background  # is kept
        background_s = (time.process_time() - start) / len(replay.trajectories)
        marked = sampling("replay sample, pixel_weight", replay, quick, mark=True)
        yield marked | {"background_s": background_s} | sizes
        del replay  # otherwise the next case would start with its memory


def sampling(what: str, replay: ReplayBuffer, quick: bool, mark: bool = False) -> dict[str, Any]:
    """Return a row with the time of a batch.

    :param mark: mark the pixels that move
    """
    rng = np.random.default_rng(0)
    sample = partial(mix, replay, None, 0.0, *BATCH, ACTIONS, rng, mark=mark)
    processor, wall = seconds(sample, 3 if quick else 100, warmup=3)
    return {
        "what": what,
        "batch": BATCH[0],
        "length": BATCH[1],
        "threads": 1,
        "median_s": processor,
        "wall_s": wall,
        "rss_mb": memory_mib("VmRSS"),
    }


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
