"""Conditions that several fast implementations share."""

from typing import Any

import torch
from torch import Tensor


def always(*args: Any, **kwargs: Any) -> bool:
    """Return True: this implementation is faster on every device and for every shape."""
    return True


def on_cpu(x: Tensor) -> bool:
    """Return whether x is in the CPU's memory."""
    return x.device.type == "cpu"


def in_bfloat16(x: Tensor) -> bool:
    """Return whether products and convolutions of x are computed in bfloat16 on a CPU."""
    return on_cpu(x) and torch.is_autocast_enabled("cpu")
