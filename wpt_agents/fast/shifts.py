"""Shift images by copying whole rows of pixels instead of gathering single pixels."""

import torch
from torch import Tensor

from wpt_agents.data.transitions import cut_shifted
from wpt_agents.fast.conditions import on_cpu
from wpt_agents.model.behavior_cloning import shifted


def is_on_cpu_without_gradient(image: Tensor, shift: Tensor, pad: int) -> bool:
    """Return whether NumPy can shift the images: on a CPU, without gradients."""
    return on_cpu(image) and not image.requires_grad


@shifted.faster(when=is_on_cpu_without_gradient)
def shifted_by_cuts(image: Tensor, shift: Tensor, pad: int) -> Tensor:
    """`shifted`, by cropping padded images."""
    return torch.from_numpy(cut_shifted(image.numpy(), shift.numpy() + pad, pad))
