"""ResNets with the names of torchvision's weights, to load the network that R3M's authors publish.

The layout is that of He et al., 2015, with the stride of a bottleneck in its 3x3 convolution.
"""

from typing import Self

import torch
from torch import Tensor, nn

DEPTHS = {18: (2, 2, 2, 2), 34: (3, 4, 6, 3), 50: (3, 4, 6, 3)}  # blocks of the four stages
MEAN = 0.485, 0.456, 0.406  # of ImageNet's pixels, by colour
STD = 0.229, 0.224, 0.225  # and their standard deviations
SIDE = 224  # pixels of the images that the published networks were trained on


class Block(nn.Module):
    """A residual block: two 3x3 convolutions, or a bottleneck of 1x1, 3x3 and 1x1 convolutions."""

    def __init__(self, inputs: int, width: int, stride: int, bottleneck: bool) -> None:
        super().__init__()
        outputs = 4 * width if bottleneck else width
        shapes = [(inputs, width, 3, stride), (width, width, 3, 1)]
        if bottleneck:
            shapes = [(inputs, width, 1, 1), (width, width, 3, stride), (width, outputs, 1, 1)]
        self.layers = len(shapes)
        for i, (before, after, kernel, step) in enumerate(shapes, 1):
            conv = nn.Conv2d(before, after, kernel, step, kernel // 2, bias=False)
            setattr(self, f"conv{i}", conv)
            setattr(self, f"bn{i}", nn.BatchNorm2d(after))
        self.downsample: nn.Module = nn.Identity()
        if stride > 1 or inputs != outputs:
            conv = nn.Conv2d(inputs, outputs, 1, stride, bias=False)
            self.downsample = nn.Sequential(conv, nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(N, C, H, W) -> (N, C', H', W')."""
        shortcut = self.downsample(x)
        for i in range(1, self.layers + 1):
            x = getattr(self, f"bn{i}")(getattr(self, f"conv{i}")(x))
            x = x.relu() if i < self.layers else x
        out: Tensor = (x + shortcut).relu()
        return out


class ResNet(nn.Module):
    """A ResNet without its classifier, always in evaluation mode.

    :param depth: 18, 34 or 50
    :ivar features: width of the output, 512 or 2,048
    """

    mean: Tensor
    std: Tensor

    def __init__(self, depth: int = 18) -> None:
        super().__init__()
        bottleneck = depth >= 50
        self.conv1 = nn.Conv2d(3, 64, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        channels = 64
        for stage, blocks in enumerate(DEPTHS[depth]):
            width = 64 * 2**stage
            layers = []
            for block in range(blocks):
                stride = 2 if stage > 0 and block == 0 else 1
                layers.append(Block(channels, width, stride, bottleneck))
                channels = 4 * width if bottleneck else width
            setattr(self, f"layer{stage + 1}", nn.Sequential(*layers))
        self.features = channels
        self.register_buffer("mean", torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(STD).view(3, 1, 1), persistent=False)
        self.train(False)

    def train(self, mode: bool = True) -> Self:
        """Stay in evaluation mode: batch norms use the statistics of their own training data."""
        return super().train(False)

    def forward(self, image: Tensor) -> Tensor:
        """Encode images of 0 to 255, resized to 224 x 224: (N, H, W, 3) -> (N, features)."""
        x = image.permute(0, 3, 1, 2).float() / 255
        if x.shape[-2:] != (SIDE, SIDE):
            x = nn.functional.interpolate(x, (SIDE, SIDE), mode="bilinear", antialias=True)
        x = self.maxpool(self.bn1(self.conv1((x - self.mean) / self.std)).relu())
        for stage in range(1, 5):
            x = getattr(self, f"layer{stage}")(x)
        features: Tensor = x.mean((2, 3))
        return features


def read_r3m(path: str) -> dict[str, Tensor]:
    """Read the ResNet of a file that R3M's authors publish, without running any code in it.

    The file holds `{"r3m": {"module.convnet.<name>": ..., "module.lang_enc.<name>": ..., ...}}`;
    the parts for language are left out.

    :param path: the file
    :return: the weights of a `ResNet` by name
    :raises ValueError: a file of another layout
    """
    content = torch.load(path, map_location="cpu", weights_only=True)
    prefix = "module.convnet."
    weights = content.get("r3m", {}) if isinstance(content, dict) else {}
    network = {k.removeprefix(prefix): w for k, w in weights.items() if k.startswith(prefix)}
    if not network:
        raise ValueError(
            f"{path} does not hold R3M's network: no 'r3m' with names like '{prefix}conv1.weight'. "
            "Pass one of the files r3m_18.pt, r3m_34.pt or r3m_50.pt of its authors"
        )
    return {k: w for k, w in network.items() if not k.startswith("fc.")}
