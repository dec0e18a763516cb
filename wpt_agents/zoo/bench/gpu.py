"""Pre-training and whole updates on a GPU: time, peak memory, and idle time of the GPU.

On a GPU a step can be limited by arithmetic or by launches: the CPU launches the operators one by
one, and the GPU is idle while launching takes longer than computing. The profiler measures the
kernel time; the rest of the wall-clock time is the share of launches.
"""

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from wpt_agents.zoo.bench.model import agent, count, synthetic_batch, whole_step, world_model_step
from wpt_agents.zoo.bench.timing import gflop, seconds
from wpt_agents.zoo.bench.work import launches

REPETITIONS = 10  # timed steps after a warm-up of 3


def rows(quick: bool = False, precision: str = "fp32", compiled: bool = False) -> Iterator[dict]:
    """One row for a step of pre-training, and one for a whole update, at the paper's size.

    `kernel_s` is the computing time of the GPU, `launch_share` the share of the step in which it is
    idle, and `launches` the number of operators that a step calls.

    :param quick: use the size debug on any device
    :raises ValueError: if there is no GPU, unless `quick`
    """
    if not quick and not torch.cuda.is_available():
        raise ValueError(
            "bench gpu needs a GPU, and torch finds none (torch.cuda.is_available() is False). "
            "--quick runs the same code on this machine's CPU"
        )
    size, batch, length = ("debug", 2, 8) if quick else ("paper", 16, 64)
    model = agent(size, precision, compiled)
    uncompiled = agent(size, precision) if compiled else model
    data = synthetic_batch(batch, length).to(model.device)
    networks = model.policy.world_model, model.policy.actor, model.policy.critic
    columns = {"size": size, "batch": batch, "length": length, "dtype": precision}
    columns |= {"compiled": True} if compiled else {}
    for what, make, params in (
        ("pre-training", world_model_step, count(networks[0])),
        ("whole update", whole_step, count(*networks)),
    ):
        step = make(model, data)
        counted = make(uncompiled, data)
        yield {"what": what, **columns, "params": params, **measured(step, counted, quick)}


def measured(
    step: Callable[[], Any], counted: Callable[[], Any], quick: bool = False
) -> dict[str, float]:
    """Measure a step after a warm-up for compilation and caches.

    :param counted: the same step uncompiled, whose work is counted
    """
    repetitions, warmup = (1, 1) if quick else (REPETITIONS, 3)
    _, wall = seconds(step, repetitions, warmup)
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    kernels = kernel_seconds(step)
    flops = gflop(counted)
    return {
        "wall_s": wall,
        "kernel_s": kernels,
        "launch_share": max(0.0, 1 - kernels / wall),
        "launches": launches(counted),
        "peak_gpu_gb": torch.cuda.max_memory_allocated() / 1e9 if torch.cuda.is_available() else 0,
        "tflop": flops / 1e3,
        "tflop_per_s": flops / 1e3 / wall,
    }


def kernel_seconds(step: Callable[[], Any]) -> float:
    """Return the kernel time of a call of `step`, 0 without a GPU."""
    if not torch.cuda.is_available():
        step()
        return 0.0
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiler:
        step()
        torch.cuda.synchronize()
    return sum(row.self_device_time_total for row in profiler.key_averages()) / 1e6
