"""Median times after a warm-up, counted work, and the speed of a large matmul as a ceiling."""

import ctypes
import gc
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from wpt_agents.fast.products import product_by_convolution
from wpt_agents.model.ops import definitions

SIDE = 1024  # side of the matrices whose product is the ceiling
MATMULS = 5  # per turn, which then takes about a tenth of a second


def seconds(step: Callable[[], Any], repetitions: int, warmup: int = 1) -> tuple[float, float]:
    """Return the median CPU time (this process, all threads) and wall-clock time of `step`.

    :param warmup: calls before the measurement, which allocate memory and fill caches
    """
    return seconds_in_turn([step], repetitions, warmup)[0]


def seconds_in_turn(
    steps: Sequence[Callable[[], Any]], repetitions: int, warmup: int = 1
) -> list[tuple[float, float]]:
    """`seconds` of several alternating steps, so that other load affects all of them equally."""
    times: list[list[tuple[float, float]]] = [[] for _ in steps]
    for _ in range(warmup + repetitions):
        for step, timings in zip(steps, times, strict=True):
            before = time.process_time(), time.perf_counter()
            step()
            _wait()
            timings.append((time.process_time() - before[0], time.perf_counter() - before[1]))
    counted = [zip(*timings[warmup:], strict=True) for timings in times]
    return [(statistics.median(processor), statistics.median(wall)) for processor, wall in counted]


def cost(processor: float, wall: float) -> float:
    """Return the time that counts: CPU time for one thread, which other processes affect less.

    With several threads or a GPU it is the wall-clock time.
    """
    return processor if torch.get_num_threads() == 1 and not torch.cuda.is_available() else wall


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def matmul(device: str = "cpu") -> Callable[[], Any]:
    """`MATMULS` products of two square matrices by torch, which is the ceiling.

    On AMD CPUs with AVX-512 it is not the maximum: see `wpt_agents.fast.products` and `onednn`.
    """
    a, b = (torch.randn(SIDE, SIDE).to(device) for _ in range(2))
    return lambda: [a @ b for _ in range(MATMULS)]


def onednn() -> Callable[[], Any]:
    """The same products as convolutions, which oneDNN computes on a CPU."""
    a, b = (torch.randn(SIDE, SIDE) for _ in range(2))
    return lambda: [product_by_convolution(a, b) for _ in range(MATMULS)]


def matmul_gflop() -> float:
    """Return the work of `matmul` and of `onednn`."""
    return MATMULS * 2 * SIDE**3 / 1e9


def gflop(step: Callable[[], Any]) -> float:
    """Return the multiplications and additions of one call, forward and backward, in 1e9.

    The original operations are counted, not their fast implementations. Only matrix products and
    convolutions count.
    """
    counter = FlopCounterMode(display=False)
    # its own tracking fails for some modules
    counter.mod_tracker = _Everything()  # type: ignore[assignment]
    with definitions(), counter:
        step()
    return counter.get_total_flops() / 1e9


class _Everything(nullcontext):
    """Count only for the whole step, not for each module."""

    parents = ("Global",)


def operators(step: Callable[[], Any]) -> list[tuple[str, int, float]]:
    """Return the operators of one call with count and share of time, the most expensive first."""
    activities = [torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities) as profile:
        step()
    rows = [row for row in profile.key_averages() if row.key.startswith("aten::")]
    total = sum(row.self_cpu_time_total for row in rows)
    rows.sort(key=lambda row: -row.self_cpu_time_total)
    return [(row.key, row.count, row.self_cpu_time_total / total) for row in rows]


def peak_rss_mb() -> float:
    """Return the peak memory of this process since `forget_peak`, or NaN on Windows.

    Only Linux can reset the peak; elsewhere it is the peak since the process started.
    """
    try:
        import resource
    except ImportError:
        return float("nan")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


def forget_peak() -> None:
    """Reset `peak_rss_mb` to the memory in use now."""
    gc.collect()
    with suppress(OSError, AttributeError, TypeError):  # systems without glibc
        ctypes.CDLL(None).malloc_trim(0)  # returns freed memory to the system
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def memory_mib(field: str) -> float:
    """Return VmRSS (resident now) or VmHWM (peak) of this process; nan except on Linux."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    lines = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines())
    return int(lines[field].split()[0]) / 1024
