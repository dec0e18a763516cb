"""Encoder and decoder of images, and the conversion of pixels."""

import itertools

import torch
from torch import Tensor, nn

from wpt_agents.model.layers import (
    BlockLinear,
    ChannelNorm,
    DownConv,
    Linear,
    LinearNorm,
    UpConv,
)
from wpt_agents.model.ops import over_rows
from wpt_agents.model.sizes import Size


def to_unit(image: Tensor) -> Tensor:
    """Scale pixels to [-0.5, 0.5]: (...) uint8 -> (...) float32."""
    return image.float().div_(255).sub_(0.5)


def to_uint8(image: Tensor) -> Tensor:
    """Invert `to_unit`, rounding and clipping: (...) float32 -> (...) uint8."""
    return ((image + 0.5) * 255).round().clamp(0, 255).to(torch.uint8)


class Encoder(nn.Module):
    """The encoder e(o): four convolutions of stride 2, 64 > 31 > 14 > 6 > 2 pixels a side.

    :param depth: channels of the first layer, doubled in every further layer
    :param channels_in: 3 for one image, 3 F for F stacked images
    """

    def __init__(self, depth: int, channels_in: int = 3) -> None:
        super().__init__()
        channels = (channels_in, depth, 2 * depth, 4 * depth, 8 * depth)
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(channels):
            # 4 x 4 kernels without padding, as in DreamerV2; DreamerV3's encoder would not have the
            # parameters that the paper counts.
            layers += [DownConv(inputs, outputs, 4), ChannelNorm(outputs), nn.SiLU()]
        self.layers = nn.Sequential(*layers)
        self.depth = depth
        self.embed_dim = 8 * depth * 2 * 2

    def forward(self, image: Tensor) -> Tensor:
        """Encode images: (..., 64, 64, channels_in) uint8 -> (..., E)."""
        assert image.shape[-3:-1] == (64, 64) and image.dtype == torch.uint8, image.shape
        row_size = 31 * 31 * self.depth  # of the first layer's output
        x = over_rows(self._features, row_size, image.flatten(0, -4))
        return x.reshape(*image.shape[:-3], self.embed_dim)

    def _features(self, image: Tensor) -> Tensor:
        features: Tensor = self.layers(to_unit(image).permute(0, 3, 1, 2))
        return features


class Decoder(nn.Module):
    """The decoder d, the mean of p(o | h, z): MLPs of h and z, then 1 > 5 > 13 > 30 > 64 pixels.

    The output is not squashed into [-0.5, 0.5]: the squared error of Eq. (1) pulls it there.
    """

    def __init__(self, size: Size) -> None:
        super().__init__()
        width = 2 * size.hidden
        code = 32 * size.depth  # as wide as the encoder's output
        depth = size.depth
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
            # Kernels of 5, 5, 6 and 6 end at 64 pixels exactly.
            UpConv(code, 4 * depth, 5),
            ChannelNorm(4 * depth),
            nn.SiLU(),
            UpConv(4 * depth, 2 * depth, 5),
            ChannelNorm(2 * depth),
            nn.SiLU(),
            UpConv(2 * depth, depth, 6),
            ChannelNorm(depth),
            nn.SiLU(),
            UpConv(depth, 3, 6),
        )
        # the last layer takes 30 x 30 x depth numbers and makes 64 x 64 x 3 of them
        self.row_size = 32 * 32 * max(depth, 12)

    def forward(self, deter: Tensor, stoch: Tensor) -> Tensor:
        """Decode states to images, about -0.5 .. 0.5: (N, D), (N, S, K) -> (N, 64, 64, 3)."""
        return over_rows(self.images, self.row_size, self.code(deter, stoch))

    def code(self, deter: Tensor, stoch: Tensor) -> Tensor:
        """Return the input of `images`: (N, D), (N, S, K) -> (N, C, 5, 5)."""
        pixel = self.from_deter(deter) + self.from_stoch(stoch.flatten(1))
        code: Tensor = self.layers[0](pixel[..., None, None])
        return code

    def images(self, code: Tensor) -> Tensor:
        """Return the images of the output of `code`: (N, C, 5, 5) -> (N, 64, 64, 3)."""
        images: Tensor = self.layers[1:](code).permute(0, 2, 3, 1)
        return images
