"""Shifted images by copies of whole rows of pixels, where a gather moves pixel by pixel."""

import torch
from torch import Tensor

from wpt_agents.data.transitions import cut_shifted
from wpt_agents.fast.conditions import on_cpu
from wpt_agents.model.behavior_cloning import shifted


def is_on_cpu_without_gradient(image: Tensor, shift: Tensor, pad: int) -> bool:
    """Return whether NumPy can move the pixels: on a CPU, without a gradient."""
    return on_cpu(image) and not image.requires_grad


@shifted.faster(when=is_on_cpu_without_gradient)
def shifted_by_cuts(image: Tensor, shift: Tensor, pad: int) -> Tensor:
    """`shifted` as images cut out of wider ones."""
    return torch.from_numpy(cut_shifted(image.numpy(), shift.numpy() + pad, pad))
