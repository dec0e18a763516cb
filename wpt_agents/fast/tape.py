"""Layers with manual gradients, which record their inputs and the gradients at their outputs.

The gradients at a layer's outputs are called slopes here.
"""

from typing import Any, cast

import torch
from torch import Tensor

aten = torch.ops.aten


class Tape:
    """A layer of the scan: its inputs at each step, and the slopes at its outputs, last first."""

    def __init__(self) -> None:
        self.seen: list[Any] = []
        self.slopes: list[Tensor] = []

    def all_slopes(self, dim: int = 0) -> Tensor:
        """Join the slopes of all steps along `dim`, first step first."""
        return torch.cat(self.slopes[::-1], dim)


class Linear(Tape):
    """x W^T + b, where b is the layer's own or another one at each step."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        super().__init__()
        self.weight = weight
        self.bias = bias
        self.transposed = weight.t()

    def forward(self, x: Tensor, bias: Tensor | None = None) -> Tensor:
        """(N, inputs) -> (N, outputs)."""
        self.seen.append(x)
        bias = self.bias if bias is None else bias
        assert bias is not None, "neither the layer nor the step has a bias"
        return torch.addmm(bias, x, self.transposed)

    def backward(self, slope: Tensor, other: Tensor | None = None) -> Tensor:
        """(N, outputs) -> (N, inputs), plus `other`."""
        self.slopes.append(slope)
        return slope @ self.weight if other is None else torch.addmm(other, slope, self.weight)

    def gradients(self) -> list[Tensor]:
        """Return the gradient of the weight, and of the bias if it is the layer's own."""
        slope = self.all_slopes()
        gradients = [slope.t() @ torch.cat(self.seen)]
        return gradients if self.bias is None else [*gradients, slope.sum(0)]


class Blocks(Tape):
    """`BlockLinear` with the blocks in front: (b, N, inputs / b) -> (b, N, outputs / b)."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        super().__init__()
        self.weight = weight
        self.transposed = weight.transpose(1, 2)
        self.bias = None if bias is None else bias.view(len(weight), 1, -1)

    def forward(self, x: Tensor) -> Tensor:
        """(b, N, inputs / b) -> (b, N, outputs / b)."""
        self.seen.append(x)
        if self.bias is None:
            return torch.bmm(x, self.weight)
        return torch.baddbmm(self.bias, x, self.weight)

    def backward(self, slope: Tensor) -> Tensor:
        """(b, N, outputs / b) -> (b, N, inputs / b)."""
        self.slopes.append(slope)
        return torch.bmm(slope, self.transposed)

    def gradients(self) -> list[Tensor]:
        """Return the gradient of the weight, and of the bias if there is one."""
        slope = self.all_slopes(1)
        gradients = [torch.cat(self.seen, 1).transpose(1, 2) @ slope]
        return gradients if self.bias is None else [*gradients, slope.sum(1).flatten()]


class NormSiLU(Tape):
    """SiLU(LayerNorm(x)): (N, width) -> (N, width)."""

    def __init__(self, weight: Tensor, bias: Tensor, eps: float) -> None:
        super().__init__()
        self.weight = weight
        self.bias = bias
        self.eps = eps

    def forward(self, x: Tensor) -> Tensor:
        """(N, width) -> (N, width)."""
        normed, *moments = aten.native_layer_norm(
            x, self.weight.shape, self.weight, self.bias, self.eps
        )
        self.seen.append((x, normed, *moments))
        return cast(Tensor, aten.silu(normed))

    def backward(self, t: int, slope: Tensor) -> Tensor:
        """Return the slope at the input of step t."""
        x, normed, *moments = self.seen[t]
        self.slopes.append(aten.silu_backward(slope, normed))
        return self._backward(self.slopes[-1], x, moments, [True, False, False])[0]

    def gradients(self) -> list[Tensor]:
        """Return the gradients of weight and bias."""
        x, _, *moments = (torch.cat(steps) for steps in zip(*self.seen, strict=True))
        return list(self._backward(self.all_slopes(), x, moments, [False, True, True])[1:])

    def _backward(
        self, slope: Tensor, x: Tensor, moments: list[Tensor], mask: list[bool]
    ) -> tuple[Tensor, ...]:
        arguments = slope, x, self.weight.shape, *moments, self.weight, self.bias, mask
        return cast(tuple[Tensor, ...], aten.native_layer_norm_backward(*arguments))


class Gates(Tape):
    """The GRU's gates, blocks in front: (b, N, 3 D / b) and h (b, N, D / b) -> the next h.

    :param layout: `Size.gates`
    """

    def __init__(self, layout: str) -> None:
        super().__init__()
        self.layout = layout

    def forward(self, gates: Tensor, deter: Tensor) -> Tensor:
        """Return the next h, as `BlockGRU` computes it from its gates."""
        reset, candidate, update = split_in_blocks(gates, self.layout)
        reset = torch.sigmoid(reset)
        update = torch.sigmoid(update - 1)
        new = torch.tanh(reset * candidate)
        self.seen.append((reset, candidate, update, new, deter))
        return torch.lerp(deter, new, update)

    def backward(self, t: int, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slopes at gates and h of step t."""
        reset, candidate, update, new, deter = self.seen[t]
        to_new = slope * update
        to_update = aten.sigmoid_backward(slope * (new - deter), update)
        to_product = aten.tanh_backward(to_new, new)
        to_reset = aten.sigmoid_backward(to_product * candidate, reset)
        return self._joined(to_reset, to_product * reset, to_update), slope - to_new

    def _joined(self, *gates: Tensor) -> Tensor:
        """Invert `split_in_blocks`."""
        if self.layout == "within":
            return torch.cat(gates, 2)
        flat = torch.stack(gates).permute(2, 0, 1, 3).flatten(1)  # (N, 3 D)
        return in_blocks(flat, len(gates[0]))


def split_in_blocks(gates: Tensor, layout: str) -> tuple[Tensor, ...]:
    """`split_gates` with the blocks in front: (b, N, 3 D / b) -> three times (b, N, D / b)."""
    if layout == "within":
        return gates.chunk(3, 2)
    flat = gates.transpose(0, 1).flatten(1)  # (N, 3 D), the thirds of which are the gates
    return flat.view(len(flat), 3, len(gates), -1).permute(1, 2, 0, 3).unbind(0)


def in_blocks(x: Tensor, blocks: int) -> Tensor:
    """(N, width) -> (b, N, width / b)."""
    return x.reshape(len(x), blocks, -1).transpose(0, 1)


def out_of_blocks(x: Tensor) -> Tensor:
    """(b, N, width / b) -> (N, width), the inverse of `in_blocks`."""
    return x.transpose(0, 1).flatten(1)
