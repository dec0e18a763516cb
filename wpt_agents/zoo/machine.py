"""What a command needs on this machine, an engine's package or a GPU, and its threads."""

import importlib
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import torch

from wpt_agents.files.names import unknown_name
from wpt_agents.model.sizes import SIZES, Size, find_size

ENGINES = {"none": "", "local": "", "ray": "ray", "slurm": "submitit"}  # and their packages


def import_extra(name: str, extra: str) -> ModuleType:
    """Import the module of an extra, or raise an error with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == name.split(".")[0]
        # If it is there, it lacks for example a shared library, or a package that it needs.
        reason = "is not installed" if missing else f"cannot be imported ({error})"
        raise ValueError(f'{name} {reason}: pip install "wpt-agents[{extra}]"') from error


def check_machine(engine: str, device: str) -> None:
    """Raise an error if the engine's package is not installed or the device is not available."""
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if package := ENGINES[engine]:
        import_extra(package, engine)
    else:
        check_device(device)


def check_device(device: str) -> None:
    """Raise an error if torch does not find the device; SB3 would use the CPU without a warning."""
    try:
        target = torch.device("cpu" if device == "auto" else device)
    except RuntimeError:
        raise ValueError(f"--device {device}: write auto, cpu, cuda, or cuda:1") from None
    if target.type == "cuda" and (target.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"--device {device}: torch {torch.__version__} finds {torch.cuda.device_count()} CUDA "
            "GPUs here; use --device cpu, or a build of torch with CUDA and a driver"
        )


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread, so that sums have a fixed order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def choose_threads(size: str | Size | Mapping[str, Any]) -> None:
    """Let torch compute networks narrower than those of `small` on one thread.

    A second thread brings little, and threads that wait for each other keep a core busy, which
    halves the speed if another process needs it (docs/speed.md). Wider networks use all cores, as
    torch does by default. OMP_NUM_THREADS overrides this choice.
    """
    if "OMP_NUM_THREADS" not in os.environ and find_size(size).units < SIZES["small"].units:
        torch.set_num_threads(1)
