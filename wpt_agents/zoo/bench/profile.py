"""The time of a whole update by operator."""

from collections.abc import Iterator

import torch

from wpt_agents.zoo.bench.model import agent, synthetic_batch, whole_step
from wpt_agents.zoo.bench.timing import operators

TOP = 15


def rows(quick: bool = False, threads: int = 1, precision: str = "fp32") -> Iterator[dict]:
    """Yield the total of all operators of one update, then the most expensive ones."""
    torch.set_num_threads(threads)
    size, batch, length = ("debug", 2, 8) if quick else ("small", 16, 64)
    model = agent(size, precision)
    step = whole_step(model, synthetic_batch(batch, length).to(model.device))
    step()
    counted = operators(step)
    columns = {"size": size, "batch": batch, "length": length, "dtype": precision}
    yield {"what": "all operators", "count": sum(n for _, n, _ in counted), "share": 1.0} | columns
    for name, count, share in counted[:TOP]:
        yield {"what": name, "count": count, "share": share} | columns
