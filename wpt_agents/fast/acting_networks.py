"""The networks for acting, with few operators and weights stored in reading order."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wpt_agents.fast.tape import in_blocks, out_of_blocks, split_in_blocks
from wpt_agents.model.actor_critic import Actor
from wpt_agents.model.distributions import Noise, exponential
from wpt_agents.model.gru import split_gates
from wpt_agents.model.images import Encoder
from wpt_agents.model.rssm import RSSM, Latent

PATCHES = 256  # of several images; above it a convolution is faster than a product (measured)
WIDE_STOCH = 1024  # size of z above which selecting rows is faster than a product (measured)


class Layer(NamedTuple):
    """SiLU(LayerNorm(x W + b)) of the rows of a matrix."""

    weight: Tensor  # (inputs, outputs)
    bias: Tensor
    norm: nn.LayerNorm

    def __call__(self, x: Tensor) -> Tensor:
        """(N, inputs) -> (N, outputs)."""
        return norm_silu(torch.addmm(self.bias, x, self.weight), self.norm)


def norm_silu(x: Tensor, norm: nn.LayerNorm) -> Tensor:
    """SiLU(LayerNorm(x)) over the last axis."""
    x = torch.layer_norm(x, norm.normalized_shape, norm.weight, norm.bias, norm.eps, False)
    return F.silu(x, inplace=True)


def linear_norm(layers: Iterable[Any]) -> Layer:
    """Return a `LinearNorm` as a Layer."""
    linear, norm, _ = layers
    return Layer(linear.weight.t(), linear.bias, norm)


class OneHotProduct:
    """z W' + x for z (N, S, C), whose groups are one-hot, or zero at the start of an episode.

    If z is large, only the columns of W at the ones of z are selected. This reads 1/C of W, and
    reading is the bottleneck.

    :param weight: W, (outputs, S C)
    """

    def __init__(self, weight: Tensor, classes: int) -> None:
        wide = weight.shape[1] >= WIDE_STOCH
        self.matrix = weight.t()
        self.rows = self.matrix.contiguous() if wide else None
        self.first = torch.arange(0, weight.shape[1], classes)

    def __call__(self, x: Tensor, stoch: Tensor) -> Tensor:
        """(outputs,) or (N, outputs), and z -> (N, outputs)."""
        if self.rows is None:
            return torch.addmm(x, stoch.flatten(1), self.matrix)
        value, index = stoch.max(-1)  # 0 at the start of an episode
        index += self.first
        return F.embedding_bag(index, self.rows, mode="sum", per_sample_weights=value).add_(x)


class FastConv:
    """A convolution of stride 2, its norm and SiLU, channels last: (N, H, W, C) -> (N, H', W', C').

    A small number of patches is computed as one matrix product, which avoids the reordering of
    weights in oneDNN.
    """

    def __init__(self, weight: Tensor, bias: Tensor, norm: nn.LayerNorm) -> None:
        self.weight = weight.contiguous(memory_format=torch.channels_last)
        self.bias = bias
        self.matrix = self.weight.permute(0, 2, 3, 1).flatten(1).t()
        self.norm = norm

    def __call__(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H // 2 - 1, W // 2 - 1, C')."""
        n, height, width, channels = x.shape
        rows = height // 2 - 1
        columns = width // 2 - 1
        line = width * channels
        if n > 1 and n * rows * columns > PATCHES:
            x = F.conv2d(x.permute(0, 3, 1, 2), self.weight, self.bias, 2).permute(0, 2, 3, 1)
            return norm_silu(x, self.norm)
        # a patch is 4 lines of 4 pixels, each line contiguous in memory
        patches = x.as_strided(
            (n, rows, columns, 4, 4 * channels),
            (height * line, 2 * line, 2 * channels, line, 1),
        )
        x = torch.addmm(self.bias, patches.reshape(n * rows * columns, -1), self.matrix)
        return norm_silu(x, self.norm).view(n, rows, columns, -1)


class FastEncoder:
    """e(o), with the channels of its 2 x 2 pixels concatenated pixel by pixel."""

    def __init__(self, encoder: Encoder) -> None:
        layers = list[Any](encoder.layers)
        convs = layers[::3]
        norms = layers[1::3]
        weights = [conv.weight for conv in convs]
        biases = [conv.bias for conv in convs]
        # `to_unit`, o / 255 - 0.5, is folded into the first layer: W (o / 255 - 0.5) + b
        biases[0] = biases[0] - 0.5 * weights[0].sum((1, 2, 3))
        weights[0] = weights[0] / 255
        self.layers = [FastConv(*layer) for layer in zip(weights, biases, norms, strict=True)]

    def __call__(self, image: Tensor) -> Tensor:
        """(N, 64, 64, C) uint8 -> (N, E)."""
        assert image.shape[1:3] == (64, 64) and image.dtype == torch.uint8, image.shape
        x = image.contiguous().float()
        for layer in self.layers:
            x = layer(x)
        return x.flatten(1)


class FastFilter:
    """`filter_step`, with one matrix for each layer that has several inputs."""

    def __init__(self, rssm: RSSM) -> None:
        gru = rssm.gru
        size = rssm.size
        self.size = size
        self.unimix = rssm.unimix
        self.blocks = gru.blocks
        self.layout = gru.layout
        self.from_deter = linear_norm(gru.from_deter)
        self.from_action = linear_norm(gru.from_action)
        from_stoch, self.stoch_norm, _ = list[Any](gru.from_stoch)
        self.from_stoch = OneHotProduct(from_stoch.weight, size.classes)
        self.stoch_bias = from_stoch.bias
        width = size.deter // gru.blocks
        self.private = gru.hidden.weight[:, :width]
        # (inputs, D), with each output's weights contiguous in memory
        self.shared = gru.hidden.weight[:, width:].transpose(1, 2).flatten(0, 1).t()
        self.hidden_bias = gru.hidden.bias
        self.norm = gru.norm
        self.gates = gru.gates.weight
        gates_bias = gru.gates.bias.detach().clone()
        # The 1 that `BlockGRU` subtracts is folded into the bias.
        split_gates(gates_bias[None], gru.blocks, gru.layout)[2].sub_(1)  # of the update gate
        self.gates_bias = gates_bias.view(gru.blocks, 1, -1)
        from_deter = rssm.post_in.weight[:, : size.deter]
        from_embed = rssm.post_in.weight[:, size.deter :]
        pixels = from_embed.unflatten(1, (-1, 2, 2)).permute(0, 2, 3, 1).flatten(1)
        norm, _, self.post_out = list[Any](rssm.post_out)
        self.post = Layer(torch.cat([from_deter, pixels], 1).t(), rssm.post_in.bias, norm)

    def __call__(
        self, state: Latent, action: Tensor, embed: Tensor, generator: Noise, sample: bool
    ) -> Latent:
        """Filter one step from a state (N, ...), which is zero at the start of an episode.

        :param embed: the output of `FastEncoder`
        """
        deter = self._next_deter(state, action)
        hidden = self.post(torch.cat([deter, embed], 1))
        logits = torch.addmm(self.post_out.bias, hidden, self.post_out.weight.t())
        logits = logits.view(state.stoch.shape)
        if sample:  # same as `unimix_logits` and `sample_one_hot`
            probs = logits.softmax(-1).mul_(1 - self.unimix).add_(self.unimix / self.size.classes)
            logits = probs.div_(exponential(probs, generator))
        index = logits.argmax(-1, keepdim=True)
        return Latent(deter, torch.zeros_like(logits).scatter_(-1, index, 1.0))

    def _next_deter(self, state: Latent, action: Tensor) -> Tensor:
        from_stoch = norm_silu(self.from_stoch(self.stoch_bias, state.stoch), self.stoch_norm)
        inputs = [self.from_deter(state.deter), from_stoch, self.from_action(action)]
        shared = torch.addmm(self.hidden_bias, torch.cat(inputs, 1), self.shared)
        deter = in_blocks(state.deter, self.blocks)
        hidden = torch.baddbmm(in_blocks(shared, self.blocks), deter, self.private)
        hidden = norm_silu(out_of_blocks(hidden), self.norm)
        gates = torch.baddbmm(self.gates_bias, in_blocks(hidden, self.blocks), self.gates)
        reset, candidate, update = split_in_blocks(gates, self.layout)
        candidate = torch.sigmoid(reset).mul_(candidate).tanh_()
        return out_of_blocks(deter.lerp(candidate, torch.sigmoid(update)))


class FastActor:
    """The outputs of the actor's network, (N, 2 A)."""

    def __init__(self, actor: Actor, classes: int) -> None:
        block, self.norm, _, self.from_deter = list[Any](actor.from_deter)
        self.block = block.weight
        self.blocks = len(block.weight)
        self.block_bias = block.bias.view(self.blocks, 1, -1)
        self.from_stoch = OneHotProduct(actor.from_stoch.weight, classes)
        self.bias = self.from_deter.bias + actor.from_stoch.bias
        *hidden, self.last = list[Any](actor.layers)
        self.hidden = [linear_norm(layers) for layers in hidden]

    def __call__(self, state: Latent) -> Tensor:
        """(N, ...) -> (N, 2 A)."""
        deter = in_blocks(state.deter, self.blocks)
        x = out_of_blocks(torch.baddbmm(self.block_bias, deter, self.block))
        x = norm_silu(x, self.norm)
        x = torch.addmm(self.bias, x, self.from_deter.weight.t())
        x = self.from_stoch(x, state.stoch)
        for layer in self.hidden:
            x = layer(x)
        return torch.addmm(self.last.bias, x, self.last.weight.t())
