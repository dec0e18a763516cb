"""One step of an optimiser, with clipped gradients, that keeps the weights finite."""

from math import inf

import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_
from torch.optim import AdamW, Optimizer


def adam(parts: list[list[nn.Parameter]], rate: float, weight_decay: float) -> Optimizer:
    """Make an Adam optimiser over parts whose gradients are clipped separately.

    :param parts: the parameters of each part
    :param rate: the learning rate
    :param weight_decay: share by which every weight shrinks in a step
    """
    groups = [{"params": part} for part in parts]
    # eps and weight decay: Table 2. The paper's decay is a share of the weights in each step.
    return AdamW(groups, rate, eps=1e-5, weight_decay=decay(rate, weight_decay), fused=True)


def decay(rate: float, weight_decay: float) -> float:
    """Return the argument of AdamW, which multiplies it by the rate in every step."""
    return weight_decay / rate if rate else 0.0


def descend(optimizer: Optimizer, loss: Tensor, name: str, grad_clip: float = inf) -> Tensor:
    """Compute the gradients of a loss and take a step.

    :param name: name of the loss, for the error
    :param grad_clip: largest norm of the gradient of each part; infinite for no clipping
    :return: the norm of the first part's gradient before clipping
    :raises FloatingPointError: a loss or gradient that is not finite; the weights stay as they were
    """
    optimizer.zero_grad()
    loss.backward()
    return take_step(optimizer, loss, name, grad_clip)


def take_step(optimizer: Optimizer, loss: Tensor, name: str, grad_clip: float) -> Tensor:
    """Clip the gradients, check that they and the loss are finite, and take a step."""
    groups = [group["params"] for group in optimizer.param_groups]
    norms = [clip_grad_norm_(weights, grad_clip) for weights in groups]
    # one test for all of them: reading a number waits for the GPU
    if not torch.isfinite(sum(norms, loss.detach())):
        raise FloatingPointError(
            f"The {name} loss is {loss.item()}, its gradient norm {float(sum(norms))}. This step "
            "was not taken and the weights are finite: save them, and look at the data or lower "
            "the learning rate"
        )
    optimizer.step()
    return norms[0]
