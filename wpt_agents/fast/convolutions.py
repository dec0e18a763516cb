"""Faster strided convolutions for a CPU, and the reconstruction error that uses them.

An output pixel (2i + p, 2j + q) of a transposed convolution of stride 2 depends only on the kernel
entries of parity (p, q). So the four parities are four ordinary convolutions of the input, computed
here as one 3x3 convolution with four times the channels, followed by a shuffle of the pixels.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

from wpt_agents.fast.conditions import always, in_bfloat16, on_cpu
from wpt_agents.model.images import Decoder, to_unit
from wpt_agents.model.layers import UpConv
from wpt_agents.model.ops import down_conv, linear, over_rows, up_conv
from wpt_agents.model.rssm import Latent
from wpt_agents.model.world_model import pixel_weights, reconstruction_error, squared_error

# ------------------------------------------------------------------------------ down


def is_one_image_without_gradient(x: Tensor, *_: Any, **__: Any) -> bool:
    """Return whether x is a single image on a CPU that needs no gradient, as in acting."""
    return len(x) == 1 and on_cpu(x) and not torch.is_grad_enabled()


@down_conv.faster(when=is_one_image_without_gradient)
def down_conv_by_patches(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """`down_conv` of one image as a product of its patches.

    It avoids the reordering of weights in oneDNN, which is not worthwhile for a single image.
    """
    kernel = weight.shape[-1]
    patches = x[0].unfold(1, kernel, 2).unfold(2, kernel, 2).permute(1, 2, 0, 3, 4)
    out = F.linear(patches.flatten(2), weight.flatten(1), bias)
    return out.permute(2, 0, 1)[None]


# ------------------------------------------------------------------------------ up


def is_single_pixel(x: Tensor, *_: Any, **__: Any) -> bool:
    """Return whether x has one pixel, as at the start of the decoder."""
    return x.shape[-2:] == (1, 1)


@up_conv.faster(when=is_single_pixel)
def up_conv_of_a_pixel(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """`up_conv` of a single pixel as a matrix product."""
    matrix = weight.permute(0, 2, 3, 1)  # (inputs, K, K, outputs)
    out = linear(x.flatten(1), matrix.flatten(1).t()).view(len(x), *matrix.shape[1:]) + bias
    return out.permute(0, 3, 1, 2)


def has_phases(x: Tensor, weight: Tensor, bias: Tensor) -> bool:
    """Return whether `phases` can be used: on a CPU, with kernels of at most 6 x 6."""
    return on_cpu(x) and weight.shape[-1] in (5, 6)


def has_phases_in_bfloat16(x: Tensor, weight: Tensor, bias: Tensor) -> bool:
    """Return whether `phases` can be used and is computed in bfloat16."""
    return has_phases(x, weight, bias) and in_bfloat16(x)


@up_conv.faster(when=has_phases_in_bfloat16)
def up_conv_by_phases(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """`up_conv` as one 3x3 convolution, forward and backward."""
    image = interleaved(phases(x, weight, bias))
    image = image[:, :-1, :-1] if weight.shape[-1] % 2 else image
    return image.permute(0, 3, 1, 2)


@up_conv.faster(when=has_phases)
def up_conv_forward_by_phases(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """`up_conv` as one 3x3 convolution forward and unchanged backward, which is fastest."""
    image: Tensor = _ForwardByPhases.apply(x, weight, bias)  # type: ignore[no-untyped-call]
    return image


class _ForwardByPhases(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        ctx.save_for_backward(x, weight)
        return up_conv_by_phases(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        x, weight = ctx.saved_tensors
        stride, padding, dilation, transposed, groups = [2, 2], [0, 0], [1, 1], True, 1
        gradients: tuple[Tensor | None, ...] = torch.ops.aten.convolution_backward(
            *(slope, x, weight, [weight.shape[1]], stride, padding, dilation, transposed),
            *([0, 0], groups, ctx.needs_input_grad),
        )
        return gradients


def phases(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """Return the four parities of an `up_conv` as channels; see `interleaved`.

    :return: (N, H + 2, W + 2, 4 outputs) of (N, inputs, H, W), (inputs, outputs, K, K), (outputs,)
    """
    inputs, outputs, kernel, _ = weight.shape
    # A kernel of size 5 is padded to 6, so that all parities have 3 x 3 entries.
    weight = F.pad(weight, (0, 6 - kernel, 0, 6 - kernel))
    weight = weight.view(inputs, outputs, 3, 2, 3, 2).permute(3, 5, 1, 0, 2, 4).flip(-1, -2)
    weight = weight.reshape(4 * outputs, inputs, 3, 3)
    bias = bias.repeat(4)
    if not in_bfloat16(x):
        return F.conv2d(x, weight, bias, padding=2).permute(0, 2, 3, 1)
    # oneDNN's bias gradient is slow in bfloat16; the gradient of an addition is a plain sum
    out = F.conv2d(x, weight, padding=2).permute(0, 2, 3, 1)
    return out.add_(bias.to(out.dtype))


def interleaved(parities: Tensor) -> Tensor:
    """(N, H, W, 4 C) -> (N, 2H, 2W, C): the pixels (2i + p, 2j + q) of all p and q in {0, 1}."""
    n, height, width, _ = parities.shape
    pixels = parities.reshape(n, height, width, 2, 2, -1).transpose(2, 3)
    return pixels.reshape(n, 2 * height, 2 * width, -1)


def by_parity(image: Tensor) -> Tensor:
    """(N, 2H, 2W, C) -> (N, H, W, 4 C), the inverse of `interleaved`."""
    n, height, width, channels = image.shape
    pixels = image.reshape(n, height // 2, 2, width // 2, 2, channels).transpose(2, 3)
    return pixels.flatten(3)


# ------------------------------------------------------------------------------ the error


@reconstruction_error.faster(when=always)
def reconstruction_error_by_parity(
    decoder: Decoder,
    latent: Latent,
    image: Tensor,
    moving: Tensor | None = None,
    pixel_weight: float = 1.0,
) -> Tensor:
    """`reconstruction_error` with the true pixels in the order of the last layer's `phases`.

    The decoded pixels are never put into the order of an image: the true ones, which are bytes and
    need no gradient, are reordered instead. On a CPU with many images, `over_rows` computes the
    error piece by piece, so that neither the true nor the decoded images are all in memory at once.
    """

    def error(image: Tensor, code: Tensor, *moving: Tensor) -> Tensor:
        weight = None
        if moving:  # the three colours of each pixel are adjacent
            marks = by_parity(moving[0][..., None]).repeat_interleave(image.shape[-1], -1)
            weight = pixel_weights(marks, pixel_weight)
        return squared_error(to_unit(by_parity(image)), decoded_parities(decoder, code), weight)

    code = decoder.code(latent.deter, latent.stoch)
    marks = () if moving is None else (moving,)
    return over_rows(error, decoder.row_size, image, code, *marks)


def decoded_parities(decoder: Decoder, code: Tensor) -> Tensor:
    """(N, C, 5, 5) -> (N, 32, 32, 12), which `interleaved` converts to the decoder's images.

    On a CPU the last layer is computed in float32, since bfloat16 is slower with few channels.
    """
    last = decoder.layers[-1]
    assert isinstance(last, UpConv)
    x: Tensor = decoder.layers[1:-1](code)
    if not in_bfloat16(x):
        return phases(x, last.weight, last.bias)
    with torch.autocast("cpu", enabled=False):
        return phases(x.float(), last.weight, last.bias)
