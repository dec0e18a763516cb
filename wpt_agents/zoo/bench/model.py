"""The gradient steps: world model alone, and all networks."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor

from wpt_agents.trajectory import Batch
from wpt_agents.updates import UPDATE
from wpt_agents.wpt import WPT
from wpt_agents.zoo.bench.timing import ceiling, cost, gflop, peak_rss_mb, seconds

ACTIONS = 6
CASES = (  # size, batch, length: what grows with each, then what the paper's batch costs
    *((size, 16, 16) for size in ("debug", "tiny", "small", "medium")),
    *(("tiny", batch, 16) for batch in (4, 8, 32)),
    *(("tiny", 16, length) for length in (8, 32, 64)),
    ("small", 16, 64),
)


def rows(quick: bool = False, threads: int = 1, precision: str = "fp32") -> Iterator[dict]:
    """One row a case; `quick` takes the debug size and one repetition."""
    torch.set_num_threads(threads)
    for size, batch, length in (("debug", 2, 8),) if quick else CASES:
        model = agent(size, precision)
        data = synthetic_batch(batch, length).to(model.device)
        about = {"size": size, "batch": batch, "length": length, "dtype": precision}
        networks = model.policy.world_model, model.policy.actor, model.policy.critic
        params = [sum(p.numel() for p in net.parameters()) for net in networks]
        for what, step, count in (
            ("world model", world_model_step(model, data), params[0]),
            ("whole update", whole_step(model, data), sum(params)),
        ):
            yield measured(step, about | {"what": what, "params": count}, 1 if quick else 3)


def measured(step: Callable[[], Any], about: dict[str, Any], repetitions: int) -> dict[str, Any]:
    """A row: time and work of a step, and the ceiling measured right before and after it."""
    work = gflop(step)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    before = ceiling(device=device)
    processor, wall = seconds(step, repetitions)
    limit = (before + ceiling(device=device)) / 2
    median = cost(processor, wall)
    return {
        **about,
        "threads": torch.get_num_threads(),
        "median_s": median,
        "wall_s": wall,
        "gflop": work,
        "gflop_per_s": work / median,
        "ceiling_gflop_per_s": limit,
        "share_of_ceiling": work / median / limit,
        "rss_mb": peak_rss_mb(),
    }


def agent(size: str, precision: str = "fp32") -> WPT:
    """An agent of six actions that has seen nothing."""
    return WPT(size=size, max_action_dim=ACTIONS, precision=precision, seed=0)


def synthetic_batch(batch: int, length: int) -> Batch:
    """Noise of the right shapes, one episode's beginning in each row."""
    generator = torch.Generator().manual_seed(0)
    shape = batch, length
    is_first = torch.zeros(shape, dtype=torch.bool)
    is_first[:, 0] = True
    action = torch.rand(*shape, ACTIONS, generator=generator) * 2 - 1
    return Batch(
        image=torch.randint(256, (*shape, 64, 64, 3), dtype=torch.uint8, generator=generator),
        action=action * ~is_first[..., None],
        reward=torch.randn(shape, generator=generator),
        is_first=is_first,
        is_terminal=torch.zeros(shape, dtype=torch.bool),
        reward_known=~is_first,
    )


def world_model_step(model: WPT, batch: Batch) -> Callable[[], Any]:
    """A pre-training step on `batch`."""

    def step() -> None:
        metrics: dict[str, list[Tensor]] = defaultdict(list)
        model._update_world_model(batch, metrics, model._generator(UPDATE, 0))

    return step


def whole_step(model: WPT, batch: Batch) -> Callable[[], Any]:
    """`WPT.update` on `batch`: world model, reward, imagination, actor and critic."""

    def step() -> None:
        metrics: dict[str, list[Tensor]] = defaultdict(list)
        generator = model._generator(UPDATE, 0)
        post = model._update_world_model(batch, metrics, generator, learn_reward=True)
        model._update_behavior(post.flatten_time(), metrics, generator)

    return step
