"""The origin of a result: commit, machine, and package versions."""

import platform
import shutil
import subprocess
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

PACKAGES = ("wpt-agents", "torch", "numpy", "gymnasium", "stable-baselines3", "mujoco")


SIMULATORS = ("dm-control", "metaworld")


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


def system() -> dict[str, Any]:
    """Return the machine and the versions of a run."""
    return {
        "commit": commit(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "threads": torch.get_num_threads(),
        "cuda": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
        "versions": {name: version(name) for name in PACKAGES + SIMULATORS},
    }
