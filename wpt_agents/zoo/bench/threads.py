"""Updates per second with one and several threads, with and without other busy processes.

OpenMP threads wait for each other by spinning, which takes a core from other processes. The wait
policy is read when torch is loaded, so each case is measured in a new process.
"""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch

from wpt_agents.zoo.bench.model import agent, synthetic_batch, world_model_step

CASE = "tiny", 16, 8  # size, batch, length
QUICK = "debug", 2, 4
POLICY = "OMP_WAIT_POLICY"


def rows(quick: bool = False) -> Iterator[dict]:
    """Yield a row for each number of threads and wait policy, without and with neighbours.

    The neighbours are busy processes on half of the cores.
    """
    size, batch, length = QUICK if quick else CASE
    cores = available_cores()
    several = max(cores, 2)
    for neighbours in (0, max(cores // 2, 1)):
        with busy(neighbours):
            for threads, policy in ((1, "default"), (several, "default"), (several, "passive")):
                rate = measured(threads, policy, size, batch, length, 0.2 if quick else 10.0)
                yield {
                    "what": "pre-training",
                    "size": size,
                    "batch": batch,
                    "length": length,
                    "threads": threads,
                    "wait policy": policy,
                    "busy neighbours": neighbours,
                    "updates_per_s": rate,
                }


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep a number of cores busy with processes in an endless loop."""
    with ExitStack() as stack:
        for _ in range(processes):
            process = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(process.wait)
            stack.callback(process.kill)
        yield


def measured(
    threads: int, policy: str, size: str, batch: int, length: int, seconds: float
) -> float:
    """Return the updates per second of a new process with these threads and this wait policy."""
    environment = {name: value for name, value in os.environ.items() if name != POLICY}
    environment["OMP_NUM_THREADS"] = str(threads)
    if policy != "default":
        environment[POLICY] = policy.upper()
    words = [str(word) for word in (threads, size, batch, length, seconds)]
    done = subprocess.run(
        [sys.executable, "-m", __spec__.name, *words],
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return float(done.stdout)


def updates_per_second(threads: int, size: str, batch: int, length: int, seconds: float) -> float:
    """Pre-train for some seconds of wall-clock time in this process, and count the updates."""
    torch.set_num_threads(threads)
    model = agent(size)
    step = world_model_step(model, synthetic_batch(batch, length).to(model.device))
    for _ in range(3):
        step()
    count = 0
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        step()
        count += 1
    return count / (time.perf_counter() - start)


if __name__ == "__main__":
    THREADS, SIZE, BATCH, LENGTH, SECONDS = sys.argv[1:]
    print(updates_per_second(int(THREADS), SIZE, int(BATCH), int(LENGTH), float(SECONDS)))
