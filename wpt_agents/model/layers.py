"""Layers that several networks share, and `Head`, the MLP behind actor, critic and reward."""

import math
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from wpt_agents.model.ops import block_linear, down_conv, linear, over_rows, up_conv
from wpt_agents.model.sizes import NORM_EPS, Size


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of each pixel: (N, C, H, W) -> (N, C, H, W)."""

    def __init__(self, channels: int) -> None:
        # Not `Size.norm_eps`: the authors' convolutions have 1e-3 as well.
        super().__init__(channels, eps=NORM_EPS)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H, W)."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Linear(nn.Linear):
    """`nn.Linear`, computed by `ops.linear`."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)."""
        return linear(x, self.weight, self.bias)


class BlockLinear(nn.Module):
    """A linear layer whose weight is block-diagonal: `blocks` blocks of inputs/b -> outputs/b.

    The fan-in of a unit is inputs/b, and the initial weights are scaled accordingly.
    """

    def __init__(self, inputs: int, outputs: int, blocks: int) -> None:
        super().__init__()
        assert inputs % blocks == outputs % blocks == 0, (inputs, outputs, blocks)
        self.weight = nn.Parameter(torch.empty(blocks, inputs // blocks, outputs // blocks))
        self.bias = nn.Parameter(torch.empty(outputs))
        # `nn.init` would take inputs * outputs for the fan-in of a 3-D weight, as the authors' code
        # does, and draw weights that are 10 to 68 times too small.
        bound = 1 / math.sqrt(inputs // blocks)  # as `nn.Linear` draws its weights
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) -> (N, outputs)."""
        return block_linear(x, self.weight, self.bias)


class LinearNorm(nn.Sequential):
    """Linear layer, layer norm, SiLU."""

    def __init__(self, inputs: int, outputs: int, eps: float = NORM_EPS) -> None:
        super().__init__(Linear(inputs, outputs), nn.LayerNorm(outputs, eps=eps), nn.SiLU())


class DownConv(nn.Conv2d):
    """A convolution of stride 2 without padding."""

    bias: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) -> (N, outputs, (H - K) // 2 + 1, (W - K) // 2 + 1)."""
        return down_conv(x, self.weight, self.bias)


class UpConv(nn.ConvTranspose2d):
    """A transposed convolution of stride 2 without padding."""

    bias: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, stride=2)

    def forward(self, x: Tensor, output_size: list[int] | None = None) -> Tensor:
        """(N, inputs, H, W) -> (N, outputs, 2H + K - 2, 2W + K - 2)."""
        assert output_size is None, "the output's size follows from the input's"
        return up_conv(x, self.weight, self.bias)


class Head(nn.Module):
    """An MLP of s = [h, z]: the sum of a layer of h and one of z, then `layers` hidden layers.

    :param size: the widths
    :param layers: number of hidden layers
    :param outputs: width of the output
    :param zero_init: start with the output 0 everywhere
    """

    def __init__(self, size: Size, layers: int, outputs: int, zero_init: bool = False) -> None:
        super().__init__()
        width = 2 * size.units
        self.from_deter = nn.Sequential(
            # Block-diagonal, because h is up to 12288 wide.
            BlockLinear(size.deter, width, size.blocks),
            nn.LayerNorm(width, eps=size.norm_eps),
            nn.SiLU(),
            Linear(width, size.units),
        )
        self.from_stoch = Linear(size.stoch * size.classes, size.units)
        hidden = [LinearNorm(size.units, size.units, size.norm_eps) for _ in range(layers)]
        last = Linear(size.units, outputs)
        self.layers = nn.Sequential(*hidden, last)
        self.deter_dim = size.deter
        self.units = size.units
        if zero_init:
            # Equal logits of symmetric bins: every first prediction is exactly 0, as in DreamerV3.
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, feat: Tensor) -> Tensor:
        """Return the outputs: (..., D + S*K) -> (..., outputs)."""
        out = over_rows(self._rows, 2 * self.units, feat.reshape(-1, feat.shape[-1]))
        return out.reshape(*feat.shape[:-1], out.shape[-1])

    def _rows(self, feat: Tensor) -> Tensor:
        deter = feat[:, : self.deter_dim]
        stoch = feat[:, self.deter_dim :]
        out: Tensor = self.layers(self.from_deter(deter) + self.from_stoch(stoch))
        return out


def scale_gradient(x: Tensor, weight: float) -> Tensor:
    """Return x with a gradient that is multiplied by `weight`; 0 detaches it."""
    if weight == 0:
        return x.detach()
    return x if weight == 1 else weight * x + (1 - weight) * x.detach()


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Let gradients pass through these modules without reaching their parameters."""
    parameters = [p for m in modules for p in m.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
