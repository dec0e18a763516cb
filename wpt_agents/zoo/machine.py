"""What this machine has of what a command asks for: an engine's package, a GPU."""

import importlib
import os
from collections.abc import Mapping
from types import ModuleType
from typing import Any

import torch

from wpt_agents.files.names import unknown_name
from wpt_agents.model.sizes import SIZES, Size, find_size

ENGINES = {"none": "", "local": "", "ray": "ray", "slurm": "submitit"}  # and their packages


def import_extra(name: str, extra: str) -> ModuleType:
    """The module of an extra, or the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ValueError(f'{name} is not installed: pip install "wpt-agents[{extra}]"') from None


def check_machine(engine: str, device: str) -> None:
    """Refuses an engine whose package is not here, and a device for runs on this machine."""
    if engine not in ENGINES:
        raise unknown_name("engine", engine, ENGINES)
    if package := ENGINES[engine]:
        import_extra(package, engine)
    else:
        check_device(device)


def check_device(device: str) -> None:
    """Refuses a device that torch does not find; SB3 would take the CPU without a word."""
    try:
        target = torch.device("cpu" if device == "auto" else device)
    except RuntimeError:
        raise ValueError(f"--device {device}: write auto, cpu, cuda, or cuda:1") from None
    if target.type == "cuda" and (target.index or 0) >= torch.cuda.device_count():
        raise ValueError(
            f"--device {device}: torch {torch.__version__} finds {torch.cuda.device_count()} CUDA "
            "GPUs here; take --device cpu, or a build of torch with CUDA and a driver"
        )


def choose_threads(size: str | Size | Mapping[str, Any]) -> None:
    """Let torch compute networks narrower than those of `small` on one thread.

    They gain little by a second one, and threads that wait for each other keep a core busy, so that
    they halve the speed where another process needs it (docs/speed.md). Wider networks use all
    cores, as torch does by default. OMP_NUM_THREADS overrides this choice.
    """
    if "OMP_NUM_THREADS" not in os.environ and find_size(size).units < SIZES["small"].units:
        torch.set_num_threads(1)
