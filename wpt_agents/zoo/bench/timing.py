"""Medians after a warm-up, counted work, and the ceiling of a large matmul beside them."""

import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from wpt_agents.networks import FromPixel, UpConv


def seconds(step: Callable[[], Any], repetitions: int, warmup: int = 1) -> tuple[float, float]:
    """The medians of `step`'s processor time (this process, all threads) and of its wall-clock.

    :param warmup: calls that are not counted: memory is fetched and caches fill
    """
    processor, wall = [], []
    for i in range(warmup + repetitions):
        before = time.process_time(), time.perf_counter()
        step()
        _wait()
        if i >= warmup:
            processor.append(time.process_time() - before[0])
            wall.append(time.perf_counter() - before[1])
    return statistics.median(processor), statistics.median(wall)


def cost(processor: float, wall: float) -> float:
    """Which of the two counts: processor time of one thread, as other processes disturb it less.

    Where several threads or a GPU take part, their speed is a matter of wall-clock.
    """
    return processor if torch.get_num_threads() == 1 and not torch.cuda.is_available() else wall


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def ceiling(dtype: torch.dtype = torch.float32, device: str = "cpu", side: int = 1024) -> float:
    """GFLOP/s of a matmul of two square matrices: no network does more on this machine."""
    a, b = (torch.randn(side, side).to(device, dtype) for _ in range(2))
    return 2 * side**3 / cost(*seconds(lambda: a @ b, repetitions=5)) / 1e9


def gflop(step: Callable[[], Any]) -> float:
    """The multiplications and additions of one call, forward and backward, in units of 1e9.

    A transposed convolution counts as its definition, not as the larger padded convolution that
    computes it here; what is not matmul or convolution counts nothing.
    """
    with _by_definition(), FlopCounterMode(display=False) as counter:
        step()
    return counter.get_total_flops() / 1e9


@contextmanager
def _by_definition() -> Iterator[None]:
    def plain(layer: nn.ConvTranspose2d, x: torch.Tensor) -> torch.Tensor:
        return nn.functional.conv_transpose2d(x, layer.weight, layer.bias, stride=2)

    fast = {kind: kind.forward for kind in (UpConv, FromPixel)}
    for kind in fast:
        kind.forward = plain  # type: ignore[method-assign]
    try:
        yield
    finally:
        for kind, forward in fast.items():
            kind.forward = forward  # type: ignore[method-assign]


def operators(step: Callable[[], Any]) -> list[tuple[str, int, float]]:
    """Each operator of one call with its count and its share of the time, the dearest first."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities) as profile:
        step()
    rows = [row for row in profile.key_averages() if row.key.startswith("aten::")]
    total = sum(row.self_cpu_time_total for row in rows)
    rows.sort(key=lambda row: -row.self_cpu_time_total)
    return [(row.key, row.count, row.self_cpu_time_total / total) for row in rows]


def peak_rss_mb() -> float:
    """The most memory that this process has held so far; not a number where nobody counts it."""
    try:
        import resource
    except ImportError:  # Windows
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def resident_mb() -> float:
    """The memory that this process holds now; not a number but on Linux."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return float("nan")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20
