"""One step of acting: images to actions, one environment or several at once."""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import torch

from wpt_agents.model.ops import definitions
from wpt_agents.zoo.bench.model import agent, count
from wpt_agents.zoo.bench.timing import cost, peak_rss_mb, seconds_in_turn


def rows(quick: bool = False, threads: int = 1) -> Iterator[dict]:
    """Yield a row for each size, number of environments and implementation.

    `params` counts the parameters used for acting. The original and the fast implementation are
    timed alternately.
    """
    torch.set_num_threads(threads)
    sizes, counts = (("debug",), (1,)) if quick else (("tiny", "small", "medium"), (1, 4, 16))
    for size in sizes:
        policy = agent(size).policy
        params = count(policy.world_model.encoder, policy.world_model.rssm, policy.actor)
        for n in counts:
            image = np.random.default_rng(0).integers(0, 256, (n, 64, 64, 3)).astype(np.uint8)
            state = policy.initial_state(n)
            first = np.zeros(n, bool)
            act = partial(policy.act, image, state, first)
            forms: dict[str, Callable[[], Any]] = {
                "policy step": act,
                "policy step, by definition": partial(by_definition, act),
            }
            repetitions, warmup = (3, 1) if quick else (200, 20)
            times = seconds_in_turn(list(forms.values()), repetitions, warmup)
            for what, (processor, wall) in zip(forms, times, strict=True):
                yield {
                    "what": what,
                    "size": size,
                    "params": params,
                    "batch": n,
                    "threads": threads,
                    "dtype": "fp32",
                    "median_s": cost(processor, wall),
                    "wall_s": wall,
                    "rss_mb": peak_rss_mb(),
                }


def by_definition(act: Callable[[], Any]) -> None:
    """Act without the fast implementations."""
    with definitions():
        act()
