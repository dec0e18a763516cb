"""Gradient steps: of the world model alone, and of all networks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from torch import nn

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Batch, MarkedBatch
from wpt_agents.training.randomness import Purpose
from wpt_agents.zoo.bench.timing import (
    cost,
    forget_peak,
    gflop,
    matmul,
    matmul_gflop,
    onednn,
    peak_rss_mb,
    seconds_in_turn,
)
from wpt_agents.zoo.machine import one_thread
from wpt_agents.zoo.plan.methods import defaults
from wpt_agents.zoo.plan.presets import keywords

ACTIONS = 6
CASES = (  # size, batch, length; `bench scaling` shows what grows with each
    *((size, 16, 16) for size in ("debug", "tiny", "mid", "small", "medium")),
    *((size, 16, 64) for size in ("tiny", "small")),
)

# Keywords of WPT that the cases or other options set.
FIXED = {"size", "max_action_dim", "precision", "compile", "batch_size", "batch_length"}


def rows(
    quick: bool = False,
    threads: int = 1,
    precision: str = "fp32",
    compiled: bool = False,
    settings: Sequence[str] = (),
) -> Iterator[dict]:
    """Yield a row for each case; `quick` uses the debug size and one repetition.

    :param settings: keywords of WPT as "key=value", except those that a case or another option sets
    """
    torch.set_num_threads(threads)
    changes = keywords(settings, defaults(WPT).keys() - FIXED)
    for case in (("debug", 2, 8),) if quick else CASES:
        yield from updates(*case, precision, 1 if quick else 5, compiled, changes)


def updates(
    size: str,
    batch: int,
    length: int,
    precision: str,
    repetitions: int,
    compiled: bool = False,
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> Iterator[dict[str, Any]]:
    """Yield a row for the world model's step, and one for the whole update.

    :param changes: further keywords of WPT
    """
    model = agent(size, precision, compiled, **changes)
    plain = agent(size, precision, **changes) if compiled else model
    data = synthetic_batch(batch, length)
    data = (with_marks(data) if model.hyperparameters.marks else data).to(model.device)
    columns = {"size": size, "batch": batch, "length": length, "dtype": precision}
    columns |= {"compiled": True} if compiled else {}
    networks = model.policy.world_model, model.policy.actor, model.policy.critic
    for what, make, params, imagined in (
        ("world model", world_model_step, count(networks[0]), 0),
        ("whole update", whole_step, count(*networks), imagined_states(model, data)),
    ):
        row = {"what": what, "params": params, "imagined": imagined}
        case = make(model, data), columns | row
        yield from measured_in_turn([case], repetitions, counted=[make(plain, data)])


def count(*networks: nn.Module) -> int:
    """Return the number of parameters of the networks."""
    return sum(p.numel() for net in networks for p in net.parameters())


def measured_in_turn(
    cases: Sequence[tuple[Callable[[], Any], dict[str, Any]]],
    repetitions: int,
    counted: Sequence[Callable[[], Any]] | None = None,
) -> list[dict[str, Any]]:
    """Return a row for each step, alternating with the ceiling: time, work, memory.

    With several CPU threads, each step is also timed on a single thread: `times_one_thread`.

    :param counted: the same steps uncompiled, because the work of compiled code cannot be counted
    """
    steps = [step for step, _ in cases]
    threads = torch.get_num_threads()
    work = [gflop(step) for step in counted or steps]
    memory = [_peak_mb(step) for step in steps]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    alone = [one_thread()(step) for step in steps] if threads > 1 and device == "cpu" else []
    limits = {"ceiling_gflop_per_s": matmul(device=device)}
    limits |= {"onednn_gflop_per_s": onednn()} if device == "cpu" else {}
    timings = seconds_in_turn([*limits.values(), *steps, *alone], repetitions)
    rates = {
        name: matmul_gflop() / cost(*took) for name, took in zip(limits, timings, strict=False)
    }
    times = timings[len(limits) :]
    rows = []
    for i, (_, columns) in enumerate(cases):
        processor, wall = times[i]
        median = cost(processor, wall)
        speed = work[i] / median
        faster = {"times_one_thread": times[len(cases) + i][1] / wall} if alone else {}
        rows.append(
            {
                **columns,
                "threads": threads,
                "median_s": median,
                "wall_s": wall,
                "gflop": work[i],
                "gflop_per_s": speed,
                "share_of_ceiling": speed / rates["ceiling_gflop_per_s"],
                **rates,
                "rss_mb": memory[i],
                **faster,
            }
        )
    return rows


def _peak_mb(step: Callable[[], Any]) -> float:
    forget_peak()
    step()
    return peak_rss_mb()


def agent(size: str, precision: str = "fp32", compiled: bool = False, **changes: Any) -> WPT:
    """Return an untrained agent with six actions."""
    changes |= {"precision": precision, "compile": compiled}
    return WPT(size=size, max_action_dim=ACTIONS, seed=0, **changes)


def synthetic_batch(batch: int, length: int) -> Batch:
    """Return noise of the right shapes, with the start of an episode in each row."""
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


def with_marks(batch: Batch) -> MarkedBatch:
    """Return the batch with a tenth of its pixels marked as moving, for `pixel_weight`."""
    generator = torch.Generator().manual_seed(0)
    moving = torch.rand(batch.image.shape[:-1], generator=generator) < 0.1
    return MarkedBatch(**vars(batch), moving=moving)


def world_model_step(model: WPT, batch: Batch, learn_reward: bool = False) -> Callable[[], Any]:
    """Return a pre-training step on `batch`; `learn_reward` includes the reward head."""
    return lambda: model.learner.update_world_model(batch, generator(model), learn_reward)


def whole_step(model: WPT, batch: Batch) -> Callable[[], Any]:
    """Return `WPT.update` on `batch`: world model, reward, imagination, actor and critic."""
    return lambda: model.learner.update(batch, generator(model))


def imagined_states(model: WPT, batch: Batch) -> int:
    """Return the number of imagined states of an update: `imagine_starts` times the horizon."""
    starts = model.learner.draw_starts(batch, generator(model))
    return len(starts) * model.imagine_horizon


def generator(model: WPT) -> torch.Generator:
    """Return the random numbers of a model's first update."""
    return model.streams.torch(Purpose.UPDATE, 0, model.device)
