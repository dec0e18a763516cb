"""The origin of a result: commit, machine, and package versions."""

import platform
import shutil
import subprocess
from contextlib import suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from wpt_agents.fast.products import cpu_model

PACKAGES = (
    *("wpt-agents", "torch", "numpy", "gymnasium", "stable-baselines3", "mujoco"),
    *("dm-control", "metaworld"),
)


@cache
def commit() -> str | None:
    """Return the checkout's commit, with '+' if files differ; None outside a checkout.

    It is determined once, when the first run starts, because the loaded code does not change later.
    """
    root = Path(__file__).parents[2]
    if shutil.which("git") is None or not (root / ".git").exists():
        return None
    answer = subprocess.run(
        ["git", "describe", "--always", "--dirty=+", "--abbrev=12", "--exclude=*"],
        cwd=root,
        capture_output=True,
        text=True,
        check=False,
    )
    return answer.stdout.strip() or None


def cpu() -> str:
    """Return the processor's name, family and model, as far as the system tells them.

    The name alone is not enough: virtual machines often hide the generation in it.
    """
    lines = (line.partition(":") for line in cpu_model().splitlines())
    fields = {key.strip(): value.strip() for key, _, value in lines}
    if "model name" not in fields:
        return platform.processor()
    numbers = (f"{key} {fields[key]}" for key in ("cpu family", "model") if key in fields)
    return ", ".join((fields["model name"], *numbers))


def versions() -> dict[str, str]:
    """Return the versions of the packages; a simulator may not be installed, as on Python 3.13."""
    installed = {}
    for name in PACKAGES:
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def system() -> dict[str, Any]:
    """Return the machine and the versions of a run."""
    return {
        "commit": commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": cpu(),
        "threads": torch.get_num_threads(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "versions": versions(),
    }
