"""Medians after a warm-up, counted work, and the ceiling of a large matmul beside them."""

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

SIDE = 1024  # of the matrices whose product is the ceiling
MATMULS = 5  # in a row, so that a turn of them takes about a tenth of a second


def seconds(step: Callable[[], Any], repetitions: int, warmup: int = 1) -> tuple[float, float]:
    """The medians of `step`'s processor time (this process, all threads) and of its wall-clock.

    :param warmup: calls that are not counted: memory is fetched and caches fill
    """
    return seconds_in_turn([step], repetitions, warmup)[0]


def seconds_in_turn(
    steps: Sequence[Callable[[], Any]], repetitions: int, warmup: int = 1
) -> list[tuple[float, float]]:
    """`seconds` of several steps that take turns: what else the machine does befalls all alike."""
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
    """Which of the two counts: processor time of one thread, as other processes disturb it less.

    Where several threads or a GPU take part, their speed is a matter of wall-clock.
    """
    return processor if torch.get_num_threads() == 1 and not torch.cuda.is_available() else wall


def _wait() -> None:
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def matmul(device: str = "cpu") -> Callable[[], Any]:
    """`MATMULS` products of two square matrices by torch: what is called the ceiling.

    On AMD's CPUs with AVX-512 it is none: see `wpt_agents.fast.products`, and `onednn`.
    """
    a, b = (torch.randn(SIDE, SIDE).to(device) for _ in range(2))
    return lambda: [a @ b for _ in range(MATMULS)]


def onednn() -> Callable[[], Any]:
    """The same products as convolutions, which are oneDNN's on a CPU."""
    a, b = (torch.randn(SIDE, SIDE) for _ in range(2))
    return lambda: [product_by_convolution(a, b) for _ in range(MATMULS)]


def matmul_gflop() -> float:
    """The work of `matmul`, and of `onednn`."""
    return MATMULS * 2 * SIDE**3 / 1e9


def gflop(step: Callable[[], Any]) -> float:
    """The multiplications and additions of one call, forward and backward, in units of 1e9.

    Operations are counted as they are defined, not as the convolutions and products that compute
    them faster. What is neither a product of matrices nor a convolution counts nothing.
    """
    counter = FlopCounterMode(display=False)
    # its own walks through the modules, some of which mind
    counter.mod_tracker = _Everything()  # type: ignore[assignment]
    with definitions(), counter:
        step()
    return counter.get_total_flops() / 1e9


class _Everything(nullcontext):
    """Count for the whole step only, not for each module."""

    parents = ("Global",)


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
    with suppress(OSError, AttributeError, TypeError):  # where there is no glibc
        ctypes.CDLL(None).malloc_trim(0)  # what was freed and kept goes back to the system
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def memory_mib(field: str) -> float:
    """A figure of this process: VmRSS, resident now, or VmHWM, the most so far; Linux, else nan."""
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    lines = dict(line.split(":", 1) for line in status.read_text(encoding="utf-8").splitlines())
    return int(lines[field].split()[0]) / 1024
