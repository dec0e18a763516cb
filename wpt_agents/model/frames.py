"""Networks over stacked frames: the encoder and the trunk of DrQ-v2, RLPD and R3M."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wpt_agents.data.trajectory import IMAGE_SIZE
from wpt_agents.model.behavior_cloning import FRAMES


class FrameEncoder(nn.Module):
    """3x3 convolutions without padding, each followed by ReLU, over frames stacked as channels.

    :param channels: number of channels of each layer
    :param strides: stride of each layer
    :param frames: F, the number of frames that are stacked
    :param centre: number that is subtracted from the pixels after their division by 255
    :param differences: if above 0, all frames but the newest are replaced by the differences of
        neighbours times this number, so that small movements are large inputs
    :ivar embed_dim: E, the width of the output
    """

    def __init__(
        self,
        channels: Sequence[int],
        strides: Sequence[int],
        frames: int = FRAMES,
        centre: float = 0.0,
        differences: float = 0.0,
    ) -> None:
        super().__init__()
        assert len(channels) == len(strides), (channels, strides)
        self.centre = centre
        self.differences = differences
        inputs = [3 * frames, *channels[:-1]]
        self.layers = nn.ModuleList(
            nn.Conv2d(i, o, 3, stride)
            for i, o, stride in zip(inputs, channels, strides, strict=True)
        )
        side = IMAGE_SIZE
        for stride in strides:
            side = (side - 3) // stride + 1
        self.embed_dim = channels[-1] * side**2

    def forward(self, image: Tensor) -> Tensor:
        """Encode stacks of frames, oldest first: (N, F, 64, 64, 3) uint8 -> (N, E)."""
        x = image.permute(0, 1, 4, 2, 3).float() / 255 - self.centre
        if self.differences:
            x = torch.cat([self.differences * x.diff(dim=1), x[:, -1:]], 1)
        x = x.flatten(1, 2)
        for layer in self.layers:
            x = F.relu(layer(x))
        return x.flatten(1)  # no norm and no pooling: DrQ-v2's `Trunk` normalises what follows


class Trunk(nn.Sequential):
    """Map the encoder's output e to z = tanh(LayerNorm(W e + b)): (N, E) -> (N, Z).

    :param embed_dim: E
    :param features: Z
    """

    def __init__(self, embed_dim: int, features: int) -> None:
        super().__init__(nn.Linear(embed_dim, features), nn.LayerNorm(features), nn.Tanh())


def mlp(inputs: int, hidden: int, outputs: int) -> nn.Sequential:
    """Make an MLP of two hidden layers with ReLU: (N, inputs) -> (N, outputs)."""
    return nn.Sequential(
        nn.Linear(inputs, hidden),
        nn.ReLU(),
        nn.Linear(hidden, hidden),
        nn.ReLU(),
        nn.Linear(hidden, outputs),
    )


def orthogonal(module: nn.Module) -> None:
    """Set DrQ-v2's initial weights: orthogonal, gain sqrt 2 in convolutions, zero biases.

    Apply it with `network.apply(orthogonal)`.
    """
    if isinstance(module, nn.Linear | nn.Conv2d):
        gain = nn.init.calculate_gain("relu") if isinstance(module, nn.Conv2d) else 1.0
        nn.init.orthogonal_(module.weight, gain)
        assert module.bias is not None
        nn.init.zeros_(module.bias)


def xavier(module: nn.Module) -> None:
    """Set RLPD's initial weights: Xavier uniform with zero biases, by `network.apply(xavier)`."""
    if isinstance(module, nn.Linear | nn.Conv2d):
        nn.init.xavier_uniform_(module.weight)
        assert module.bias is not None
        nn.init.zeros_(module.bias)
