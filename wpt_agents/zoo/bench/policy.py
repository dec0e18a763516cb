"""One step of acting: images to actions, one environment or several at once."""

from collections.abc import Iterator

import numpy as np
import torch

from wpt_agents.policy import State
from wpt_agents.zoo.bench.model import agent
from wpt_agents.zoo.bench.timing import cost, peak_rss_mb, seconds


def rows(quick: bool = False, threads: int = 1) -> Iterator[dict]:
    """One row a size and number of environments; params are those that acting uses."""
    torch.set_num_threads(threads)
    sizes, counts = (("debug",), (1,)) if quick else (("tiny", "small", "medium"), (1, 4, 16))
    for size in sizes:
        policy = agent(size).policy
        rssm, encoder = policy.world_model.rssm, policy.world_model.encoder
        params = sum(p.numel() for net in (encoder, rssm, policy.actor) for p in net.parameters())
        for n in counts:
            image = np.random.default_rng(0).integers(0, 256, (n, 64, 64, 3)).astype(np.uint8)
            state: State = policy.initial_state(n)
            first = np.zeros(n, bool)

            def step() -> None:
                nonlocal state
                _, state = policy.act(image, state, first)  # noqa: B023  # called at once

            processor, wall = seconds(step, 3 if quick else 200, warmup=1 if quick else 20)
            yield {
                "what": "policy step",
                "size": size,
                "params": params,
                "batch": n,
                "threads": threads,
                "dtype": "fp32",
                "median_s": cost(processor, wall),
                "wall_s": wall,
                "rss_mb": peak_rss_mb(),
            }
