"""Matrix products: as convolutions on AMD CPUs, and with fewer copies everywhere.

oneDNN, which computes torch's convolutions on a CPU, uses AVX-512 on every CPU that supports it.
MKL, which computes torch's matrix products, does not use it on AMD CPUs and reaches half the speed
on the newest of them (docs/speed.md). There, products of many rows are computed as 1x1
convolutions.
"""

import platform
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from wpt_agents.fast.conditions import always, on_cpu
from wpt_agents.model.ops import block_linear, linear, shared_block_linear

MANY = 256  # minimum rows for a convolution to be faster despite reordering weights (measured)
WORK = 2**22  # minimum number of multiplications for the same
IMAGES = 16  # torch uses MKL for convolutions of fewer images, too


def cpu_model() -> str:
    """Return the system's description of the processor, including its vendor."""
    info = Path("/proc/cpuinfo")
    return info.read_text(encoding="utf-8") if info.exists() else platform.processor()


AMD_AVX512 = (
    torch.backends.mkldnn.is_available()
    and torch.backends.cpu.get_cpu_capability() == "AVX512"
    and "AuthenticAMD" in cpu_model()
)


def faster_by_convolution(x: Tensor, width: int) -> bool:
    """Return whether `product_by_convolution` is faster.

    :param x: (..., inputs)
    :param width: the number of outputs that each input contributes to
    """
    rows = x.shape[:-1].numel()
    return (
        AMD_AVX512
        and on_cpu(x)
        and x.dtype == torch.float32
        and rows >= MANY
        and rows % IMAGES == 0
        and x.numel() * width >= WORK
        and not torch.is_autocast_enabled("cpu")  # in bfloat16 oneDNN also computes matrix products
    )


def product_by_convolution(
    x: Tensor, weight: Tensor, bias: Tensor | None = None, blocks: int = 1
) -> Tensor:
    """Compute x W^T + b as a 1x1 convolution whose pixels are the rows: the same sums.

    :param x: (N, inputs), N a multiple of `IMAGES`
    :param weight: (outputs, inputs / blocks), the blocks of a block-diagonal matrix one below the
        other
    """
    # a permuted view without a copy: the channels of a pixel are contiguous in memory
    pixels = x.reshape(IMAGES, 1, -1, x.shape[-1]).permute(0, 3, 1, 2)
    out = F.conv2d(pixels, weight[..., None, None], bias, groups=blocks)
    return out.permute(0, 2, 3, 1).flatten(0, 2)


def linear_is_large(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> bool:
    """Return whether `linear` is faster as a convolution."""
    return faster_by_convolution(x, len(weight))


@linear.faster(when=linear_is_large)
def linear_by_convolution(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`linear` as a convolution."""
    return product_by_convolution(x.flatten(0, -2), weight, bias).view(*x.shape[:-1], len(weight))


def block_linear_is_large(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> bool:
    """Return whether `block_linear` is faster as a convolution."""
    return faster_by_convolution(x, weight.shape[-1])


@block_linear.faster(when=block_linear_is_large)
def block_linear_by_convolution(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`block_linear` as a grouped convolution, which needs no copy of each block's inputs."""
    return product_by_convolution(x, weight.transpose(1, 2).flatten(0, 1), bias, len(weight))


@block_linear.faster(when=always)
def block_linear_by_bmm(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """`block_linear` as one batched product that includes the bias."""
    blocks = x.unflatten(-1, (len(weight), -1)).transpose(0, 1)
    if bias is None:
        return torch.bmm(blocks, weight).transpose(0, 1).flatten(1)
    bias = bias.view(len(weight), 1, -1)
    return torch.baddbmm(bias, blocks, weight).transpose(0, 1).flatten(1)


def weights_are_fewer(private: Tensor, shared: Tensor, weight: Tensor, *_: Any, **__: Any) -> bool:
    """Return whether copying the shared inputs' weights is cheaper than copying the inputs."""
    outputs = weight.shape[0] * weight.shape[2]
    return len(private) * len(weight) >= outputs


@shared_block_linear.faster(when=weights_are_fewer)
def shared_block_linear_by_two_products(
    private: Tensor, shared: Tensor, weight: Tensor, bias: Tensor
) -> Tensor:
    """`shared_block_linear` with the weights of the shared inputs as one matrix.

    The matrix is a reordered copy of these weights, while the original function copies the shared
    inputs once for each block.
    """
    inputs = private.shape[1] // len(weight)  # of a block
    matrix = weight[:, inputs:].transpose(0, 1).flatten(1)
    return linear(shared, matrix.t(), bias) + block_linear(private, weight[:, :inputs])
