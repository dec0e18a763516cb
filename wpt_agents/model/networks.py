"""Building blocks: sizes, the convolutional encoder and decoder, MLPs, block-linear layers."""

import itertools
import math
import platform
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from wpt_agents.files.names import unknown_name

NORM_EPS = 1e-3
GATES = ("within", "across")
PIECE = 2**22  # numbers in the largest tensor that a stack of layers makes on a CPU: 16 MB
MANY, WORK = 256, 2**22  # rows and multiplications from which on a convolution pays for a product
IMAGES = 16  # of which a convolution takes these rows for the pixels


def cpu_model() -> str:
    """What the system says of the processor, its maker among it."""
    told = Path("/proc/cpuinfo")
    return told.read_text() if told.exists() else platform.processor()


AMD_AVX512 = (
    torch.backends.mkldnn.is_available()
    and torch.backends.cpu.get_cpu_capability() == "AVX512"
    and "AuthenticAMD" in cpu_model()
)


@dataclass(frozen=True)
class Size:
    """The widths of all networks and the learning rates that suit them.

    :param deter: width of h
    :param hidden: width inside the RSSM
    :param stoch: groups of z
    :param classes: classes in a group of z
    :param depth: channels of the first convolution
    :param units: width of the heads: actor, critic, reward
    :param learning_rate: of world model and reward head
    :param actor_critic_learning_rate: of actor and critic
    :param stabilised: DreamerV3's zero-initialised heads and normalised returns
    :param blocks: blocks of the block-diagonal layers
    :param gates: how the GRU's last layer orders its gates: "within" each block, as DreamerV3, or
        "across" the blocks, as the weights that the paper's authors publish
    :param norm_eps: eps of every layer norm but those over a convolution's channels (1e-3)
    :param imagine_starts: states that dreams start from in an update; 0 for all of them
    """

    deter: int
    hidden: int
    stoch: int
    classes: int
    depth: int
    units: int
    learning_rate: float = 1e-4
    actor_critic_learning_rate: float = 8e-5
    stabilised: bool = True
    blocks: int = 8
    gates: str = "within"
    norm_eps: float = NORM_EPS
    imagine_starts: int = 0

    def __post_init__(self) -> None:
        for name in ("deter", "hidden", "stoch", "classes", "depth", "units", "blocks"):
            value = getattr(self, name)
            if not isinstance(value, int) or isinstance(value, bool) or value < 1:
                raise ValueError(f"Size.{name} must be a whole number of at least 1, got {value!r}")
        for name in ("deter", "hidden", "units"):
            value = getattr(self, name)
            if value * (1 if name == "deter" else 2) % self.blocks:
                raise ValueError(f"Size.{name}={value} cannot be divided into {self.blocks} blocks")
        if self.gates not in GATES:
            raise unknown_name("gate layout", self.gates, GATES)
        for name in ("norm_eps", "learning_rate", "actor_critic_learning_rate"):
            value = getattr(self, name)
            if not isinstance(value, int | float) or not 0 < value < math.inf:
                raise ValueError(f"Size.{name} must be a number above 0, got {value!r}")


# `paper`: Table 2 prints 12288 as hidden and 1536 as deterministic; only the other way round does
# the world model count the 280 M parameters of the text (tests/test_world_model.py counts them).
SIZES = {
    "debug": Size(64, 32, 8, 8, 4, 32, 1e-3, 1e-3),
    "tiny": Size(128, 64, 8, 8, 8, 128, 1e-3, 4e-4),
    "mid": Size(512, 128, 32, 8, 16, 256, 6e-4, 3e-4, imagine_starts=128),
    "small": Size(256, 128, 16, 16, 16, 256, 6e-4, 3e-4),
    "medium": Size(1024, 512, 32, 32, 32, 512, 2e-4, 1e-4),
    "paper": Size(12288, 1536, 32, 96, 96, 512, 1e-4, 8e-5, stabilised=False),
}


def find_size(size: str | Size | Mapping[str, Any]) -> Size:
    """Return the size of this name, or with these fields.

    :raises ValueError: an unknown name or field, a missing field, a value that makes no sense
    """
    if isinstance(size, Size):
        return size
    if not isinstance(size, Mapping):
        if not isinstance(size, str) or size not in SIZES:
            raise unknown_name("size", size, SIZES)
        return SIZES[size]
    known = {field.name: field.default is MISSING for field in fields(Size)}
    for name in size:
        if name not in known:
            raise unknown_name("field of Size", name, known)
    lacking = [name for name, required in known.items() if required and name not in size]
    if lacking:
        raise ValueError(f"size={dict(size)} lacks {', '.join(lacking)}")
    return Size(**size)


def plain_size(size: str | Size | Mapping[str, Any]) -> str | dict[str, Any]:
    """Return the name of a size, or its fields if it has none: what a model file can store."""
    found = find_size(size)
    return next((name for name, each in SIZES.items() if each == found), asdict(found))


def split_gates(gates: Tensor, blocks: int, layout: str) -> tuple[Tensor, ...]:
    """Reset, candidate and update of a GRU, each (N, b, D / b), of its last layer's (N, 3 D).

    :param layout: `Size.gates`; "across" gives a unit the gates that other blocks computed
    """
    if layout == "within":
        return gates.unflatten(1, (blocks, 3, -1)).unbind(2)
    return gates.unflatten(1, (3, blocks, -1)).unbind(1)


class ChannelNorm(nn.LayerNorm):
    """Layer norm over the channels of (N, C, H, W)."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=NORM_EPS)

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C, H, W)."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The product x W^T + b: (..., inputs), (outputs, inputs) -> (..., outputs)."""
    if not by_convolution(x, len(weight)):
        return F.linear(x, weight, bias)
    return convolved(x.flatten(0, -2), weight, bias).unflatten(0, x.shape[:-1])


def block_linear(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    """The like by a block-diagonal W: (N, inputs), (b, inputs/b, outputs/b) -> (N, outputs)."""
    assert x.dim() == 2, x.shape
    if by_convolution(x, weight.shape[-1]):
        return convolved(x, weight.transpose(1, 2).flatten(0, 1), bias, len(weight))
    blocks = x.unflatten(-1, (len(weight), -1)).transpose(0, 1)
    if bias is None:
        return torch.bmm(blocks, weight).transpose(0, 1).flatten(1)
    bias = bias.view(len(weight), 1, -1)
    return torch.baddbmm(bias, blocks, weight).transpose(0, 1).flatten(1)


def by_convolution(x: Tensor, width: int) -> bool:
    """Whether `convolved` is the quicker way: for many rows in float32 on AMD's AVX-512.

    oneDNN's convolutions use these instructions wherever there are any. MKL's products of
    matrices, which are torch's, do without them on AMD's CPUs, at half the speed on the newest.

    :param width: how many outputs each input has
    """
    rows = x.shape[:-1].numel()
    return (
        AMD_AVX512
        and x.device.type == "cpu"
        and x.dtype == torch.float32
        and rows >= MANY
        and rows % IMAGES == 0
        and x.numel() * width >= WORK
        and not torch.is_autocast_enabled("cpu")
    )


def convolved(x: Tensor, weight: Tensor, bias: Tensor | None = None, blocks: int = 1) -> Tensor:
    """The product x W^T + b as a 1x1 convolution whose pixels are the rows; the same sums.

    Of 16 images, as torch hands a convolution of fewer to MKL, too.

    :param x: (N, inputs), N a multiple of 16
    :param weight: (outputs, inputs / blocks), the blocks of a block-diagonal matrix one below the
        other
    """
    pixels = x.reshape(IMAGES, 1, -1, x.shape[-1]).permute(0, 3, 1, 2)  # channels last in memory
    out = F.conv2d(pixels, weight[..., None, None], bias, groups=blocks)
    return out.permute(0, 2, 3, 1).flatten(0, 2)


class Linear(nn.Linear):
    """`nn.Linear` by `linear`."""

    def forward(self, x: Tensor) -> Tensor:
        """(..., inputs) -> (..., outputs)."""
        return linear(x, self.weight, self.bias)


class BlockLinear(nn.Module):
    """A linear layer whose weight is block-diagonal: `blocks` times (inputs/b -> outputs/b).

    The fan-in of a unit is its block's width, and the weights are drawn accordingly.
    """

    def __init__(self, inputs: int, outputs: int, blocks: int) -> None:
        super().__init__()
        assert inputs % blocks == outputs % blocks == 0, (inputs, outputs, blocks)
        self.weight = nn.Parameter(torch.empty(blocks, inputs // blocks, outputs // blocks))
        self.bias = nn.Parameter(torch.empty(outputs))
        bound = 1 / math.sqrt(inputs // blocks)
        nn.init.uniform_(self.weight, -bound, bound)
        nn.init.uniform_(self.bias, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs) -> (N, outputs)."""
        return block_linear(x, self.weight, self.bias)


class LinearNorm(nn.Sequential):
    """Linear, layer norm, SiLU."""

    def __init__(self, inputs: int, outputs: int, eps: float = NORM_EPS) -> None:
        super().__init__(Linear(inputs, outputs), nn.LayerNorm(outputs, eps=eps), nn.SiLU())


class DownConv(nn.Conv2d):
    """A convolution of stride 2; of a single image, as when acting, a matrix product of patches.

    That spares the reordering of the weights, which one image does not repay.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, stride=2)

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) -> (N, outputs, (H - K) // 2 + 1, (W - K) // 2 + 1)."""
        if len(x) != 1 or torch.is_grad_enabled() or x.device.type != "cpu":
            return super().forward(x)
        kernel = self.kernel_size[0]
        patches = x[0].unfold(1, kernel, 2).unfold(2, kernel, 2).permute(1, 2, 0, 3, 4)
        out = F.linear(patches.flatten(2), self.weight.flatten(1), self.bias)
        return out.permute(2, 0, 1)[None]


class Encoder(nn.Module):
    """e(o): four strided convolutions, 64 > 31 > 14 > 6 > 2, flattened.

    :param depth: channels of the first layer, doubled in each that follows
    :param channels_in: 3 for one image, 3 F for F stacked ones
    """

    def __init__(self, depth: int, channels_in: int = 3) -> None:
        super().__init__()
        channels = (channels_in, depth, 2 * depth, 4 * depth, 8 * depth)
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(channels):
            layers += [DownConv(inputs, outputs, 4), ChannelNorm(outputs), nn.SiLU()]
        self.layers = nn.Sequential(*layers)
        self.depth, self.embed_dim = depth, 8 * depth * 2 * 2

    def forward(self, image: Tensor) -> Tensor:
        """(..., 64, 64, channels_in) uint8 -> (..., E)."""
        assert image.shape[-3:-1] == (64, 64) and image.dtype == torch.uint8, image.shape
        x = in_pieces(self._features, 31 * 31 * self.depth, image.flatten(0, -4))
        return x.flatten(1).unflatten(0, image.shape[:-3])

    def _features(self, image: Tensor) -> Tensor:
        return self.layers(to_unit(image).permute(0, 3, 1, 2))  # channels_last in memory


class UpConv(nn.ConvTranspose2d):
    """A transposed convolution of stride 2; on a CPU as one 3x3 convolution and a pixel shuffle.

    An output pixel (2i + p, 2j + q) sees the kernel's entries of parity (p, q) only, so the four
    parities are four ordinary convolutions of the input, here done at once. Exactly the same sums.
    """

    bias: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        assert kernel in (5, 6), kernel
        super().__init__(inputs, outputs, kernel, stride=2)

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # its size is no choice
        """(N, inputs, H, W) -> (N, outputs, 2H + K - 2, 2W + K - 2)."""
        if x.device.type != "cpu":
            return F.conv_transpose2d(x, self.weight, self.bias, stride=2)
        up = upsampled if in_bfloat16(x) else Upsample.apply
        return up(x, self.weight, self.bias)

    def parities(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) -> (N, H + 2, W + 2, 4 outputs), which `interleaved` makes an image."""
        return phases(x, self.weight, self.bias)


def phases(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """(N, inputs, H, W), (inputs, outputs, K, K), (outputs,) -> (N, H + 2, W + 2, 4 outputs)."""
    inputs, outputs, kernel, _ = weight.shape
    weight = F.pad(weight, (0, 6 - kernel, 0, 6 - kernel))
    weight = weight.view(inputs, outputs, 3, 2, 3, 2).permute(3, 5, 1, 0, 2, 4).flip(-1, -2)
    weight, bias = weight.reshape(4 * outputs, inputs, 3, 3), bias.repeat(4)
    if not in_bfloat16(x):
        return F.conv2d(x, weight, bias, padding=2).permute(0, 2, 3, 1)
    # oneDNN's gradient of a bias in bfloat16 is slow; that of an addition is a plain sum
    out = F.conv2d(x, weight, padding=2).permute(0, 2, 3, 1)
    return out.add_(bias.to(out.dtype))


def upsampled(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """The image that `phases` are of: (N, outputs, 2H + K - 2, 2W + K - 2)."""
    image = interleaved(phases(x, weight, bias))
    image = image[:, :-1, :-1] if weight.shape[-1] % 2 else image
    return image.permute(0, 3, 1, 2)


class Upsample(torch.autograd.Function):
    """There as `upsampled`, back as the transposed convolution: what is quicker on a CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """The image."""
        ctx.save_for_backward(x, weight)
        return upsampled(x, weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, slope: Tensor) -> tuple[Tensor | None, ...]:
        """The slopes of x, weight and bias."""
        x, weight = ctx.saved_tensors
        return torch.ops.aten.convolution_backward(
            *(slope, x, weight, [weight.shape[1]], [2, 2], [0, 0], [1, 1], True, [0, 0], 1),
            ctx.needs_input_grad,
        )


class ToPixels(UpConv):
    """The last `UpConv`; both ways by phases, as its image is compared in their order.

    On a CPU in float32 always, as bfloat16 takes longer for few channels.
    """

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # as in `UpConv`
        """(N, inputs, H, W) -> (N, outputs, 2H + K - 2, 2W + K - 2)."""
        return interleaved(self.parities(x)).permute(0, 3, 1, 2)

    def parities(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) -> (N, H + 2, W + 2, 4 outputs)."""
        if not in_bfloat16(x):
            return super().parities(x)
        with torch.autocast("cpu", enabled=False):
            return super().parities(x.float())


def interleaved(parities: Tensor) -> Tensor:
    """(N, H, W, 4 C) -> (N, 2H, 2W, C): the pixels (2i + p, 2j + q) of all p and q in {0, 1}."""
    pixels = parities.unflatten(-1, (2, 2, -1)).transpose(2, 3)
    return pixels.flatten(3, 4).flatten(1, 2)


def by_parity(image: Tensor) -> Tensor:
    """(N, 2H, 2W, C) -> (N, H, W, 4 C), the inverse of `interleaved`."""
    pixels = image.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).transpose(2, 3)
    return pixels.flatten(3)


def in_bfloat16(x: Tensor) -> bool:
    """Whether a convolution of `x` is about to be computed in bfloat16, on a CPU."""
    return x.device.type == "cpu" and torch.is_autocast_enabled("cpu")


class FromPixel(nn.ConvTranspose2d):
    """A transposed convolution of a single pixel, computed as the matrix product that it is."""

    def forward(self, x: Tensor) -> Tensor:  # type: ignore[override]  # as in `UpConv`
        """(N, inputs, 1, 1) -> (N, outputs, K, K), channels last in memory."""
        assert x.shape[-2:] == (1, 1), x.shape
        weight = self.weight.permute(0, 2, 3, 1)  # (inputs, K, K, outputs)
        out = linear(x.flatten(1), weight.flatten(1).t()).unflatten(1, weight.shape[1:]) + self.bias
        return out.permute(0, 3, 1, 2)


class Decoder(nn.Module):
    """The mean of p(o | h, z): two MLPs summed, then 1 > 5 > 13 > 30 > 64; no squashing."""

    def __init__(self, size: Size) -> None:
        super().__init__()
        width, code, depth = 2 * size.hidden, 32 * size.depth, size.depth
        self.from_deter = nn.Sequential(
            BlockLinear(size.deter, width, size.blocks),
            nn.LayerNorm(width, eps=size.norm_eps),
            nn.SiLU(),
            Linear(width, code),
        )
        self.from_stoch = nn.Sequential(
            LinearNorm(size.stoch * size.classes, width, size.norm_eps), Linear(width, code)
        )
        self.layers = nn.Sequential(
            FromPixel(code, 4 * depth, 5),
            ChannelNorm(4 * depth),
            nn.SiLU(),
            UpConv(4 * depth, 2 * depth, 5),
            ChannelNorm(2 * depth),
            nn.SiLU(),
            UpConv(2 * depth, depth, 6),
            ChannelNorm(depth),
            nn.SiLU(),
            ToPixels(depth, 3, 6),
        )
        self.largest = 32 * 32 * max(depth, 12)  # numbers of an image where it has most

    def forward(self, deter: Tensor, stoch: Tensor) -> Tensor:
        """(N, D), (N, S, K) -> (N, 64, 64, 3), about -0.5 .. 0.5."""
        return in_pieces(self.images, self.largest, self.code(deter, stoch))

    def code(self, deter: Tensor, stoch: Tensor) -> Tensor:
        """(N, D), (N, S, K) -> (N, C, 5, 5), from which `images` makes the images."""
        pixel = self.from_deter(deter) + self.from_stoch(stoch.flatten(1))
        return self.layers[0](pixel[..., None, None])

    def images(self, code: Tensor) -> Tensor:
        """(N, C, 5, 5) -> (N, 64, 64, 3), about -0.5 .. 0.5, all at once."""
        return self.layers[1:](code).permute(0, 2, 3, 1)

    def parities(self, code: Tensor) -> Tensor:
        """(N, C, 5, 5) -> (N, 32, 32, 12), which `interleaved` makes the images."""
        last = self.layers[-1]
        assert isinstance(last, ToPixels)
        return last.parities(self.layers[1:-1](code))


class Head(nn.Module):
    """An MLP over s = [h, z]: the two parts enter by a sum, then `layers` hidden layers."""

    def __init__(self, size: Size, layers: int, outputs: int, zero_init: bool = False) -> None:
        super().__init__()
        width = 2 * size.units
        self.from_deter = nn.Sequential(
            BlockLinear(size.deter, width, size.blocks),
            nn.LayerNorm(width, eps=size.norm_eps),
            nn.SiLU(),
            Linear(width, size.units),
        )
        self.from_stoch = Linear(size.stoch * size.classes, size.units)
        hidden = [LinearNorm(size.units, size.units, size.norm_eps) for _ in range(layers)]
        last = Linear(size.units, outputs)
        self.layers = nn.Sequential(*hidden, last)
        self.deter_dim, self.units = size.deter, size.units
        if zero_init:
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def forward(self, feat: Tensor) -> Tensor:
        """(..., D + S*K) -> (..., outputs)."""
        flat = feat.reshape(-1, feat.shape[-1])
        return in_pieces(self._rows, 2 * self.units, flat).unflatten(0, feat.shape[:-1])

    def _rows(self, feat: Tensor) -> Tensor:
        deter, stoch = feat[:, : self.deter_dim], feat[:, self.deter_dim :]
        return self.layers(self.from_deter(deter) + self.from_stoch(stoch))


def in_pieces(layers: Callable[..., Tensor], largest: int, *inputs: Tensor) -> Tensor:
    """`layers(*inputs)`, on a CPU for a few of their rows at a time.

    Memory beyond 32 MB is not kept by glibc's malloc but given back, and fetched from the system
    page by page at the next call, which takes about as long as the arithmetic.

    :param largest: the numbers that a row has where it has most
    """
    rows = max(1, PIECE // largest)
    rows -= rows % IMAGES if rows > IMAGES else 0  # see `by_convolution`
    if inputs[0].device.type != "cpu" or len(inputs[0]) <= rows:
        return layers(*inputs)
    pieces = zip(*(x.split(rows) for x in inputs), strict=True)
    return torch.cat([layers(*piece) for piece in pieces])


def to_unit(image: Tensor) -> Tensor:
    """uint8 pixels -> float32 in [-0.5, 0.5]."""
    return image.float().div_(255).sub_(0.5)


def to_uint8(image: Tensor) -> Tensor:
    """The inverse of `to_unit`, rounded and clipped."""
    return ((image + 0.5) * 255).round().clamp(0, 255).to(torch.uint8)


@contextmanager
def frozen(*modules: nn.Module) -> Iterator[None]:
    """Gradients pass through these modules and leave their parameters alone."""
    parameters = [p for m in modules for p in m.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
