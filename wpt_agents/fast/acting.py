"""One step of acting in few operators, for a CPU: what `WPTPolicy.step` defines.

tests/test_acting.py holds the two equal. At batch 1 the arithmetic is little; the time goes into
calling operators, into reading weights across their order in memory, and into copying them in
another. Here the copies are kept, and made anew when a weight has changed: between two episodes,
not between two steps.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from wpt_agents.fast.scan import split_in_blocks
from wpt_agents.model.actor_critic import Actor
from wpt_agents.model.networks import Encoder, split_gates
from wpt_agents.model.rssm import RSSM, Latent

PATCHES = 256  # of several images; up to so many, a convolution is quicker as a matrix product
WIDE_STOCH = 1024  # from so many numbers in z on, picking rows is quicker than a matrix product


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
    """A `LinearNorm` as a Layer."""
    linear, norm, _ = layers
    return Layer(linear.weight.t(), linear.bias, norm)


class OneHotProduct:
    """z W' + x for a z (N, S, C) whose groups are one-hot, or zero where an episode begins.

    A wide z picks the columns of W at its ones: a C-th of W is read, and reading takes the time.

    :param weight: W, (outputs, S C)
    """

    def __init__(self, weight: Tensor, classes: int) -> None:
        self.matrix, wide = weight.t(), weight.shape[1] >= WIDE_STOCH
        self.rows = self.matrix.contiguous() if wide else None
        self.first = torch.arange(0, weight.shape[1], classes)

    def __call__(self, x: Tensor, stoch: Tensor) -> Tensor:
        """(outputs,) or (N, outputs), and z -> (N, outputs)."""
        if self.rows is None:
            return torch.addmm(x, stoch.flatten(1), self.matrix)
        value, index = stoch.max(-1)  # 0 where an episode begins
        index += self.first
        return F.embedding_bag(index, self.rows, mode="sum", per_sample_weights=value).add_(x)


class FastConv:
    """A convolution of stride 2, its norm and SiLU, channels last: (N, H, W, C) -> (N, H', W', C').

    Few patches are one matrix product; that spares oneDNN's reordering of the weights.
    """

    def __init__(self, weight: Tensor, bias: Tensor, norm: nn.LayerNorm) -> None:
        self.weight, self.bias = weight.contiguous(memory_format=torch.channels_last), bias
        self.matrix = self.weight.permute(0, 2, 3, 1).flatten(1).t()
        self.norm = norm

    def __call__(self, x: Tensor) -> Tensor:
        """(N, H, W, C) -> (N, H // 2 - 1, W // 2 - 1, C')."""
        n, height, width, channels = x.shape
        rows, columns, line = height // 2 - 1, width // 2 - 1, width * channels
        if n > 1 and n * rows * columns > PATCHES:
            x = F.conv2d(x.permute(0, 3, 1, 2), self.weight, self.bias, 2).permute(0, 2, 3, 1)
            return norm_silu(x, self.norm)
        patches = x.as_strided(
            (n, rows, columns, 4, 4 * channels),
            (height * line, 2 * line, 2 * channels, line, 1),
        )
        x = torch.addmm(self.bias, patches.reshape(n * rows * columns, -1), self.matrix)
        return norm_silu(x, self.norm).view(n, rows, columns, -1)


class FastEncoder:
    """e(o), the four channels' vectors of its 2 x 2 pixels one after the other."""

    def __init__(self, encoder: Encoder) -> None:
        layers = list[Any](encoder.layers)
        convs, norms = layers[::3], layers[1::3]
        weights, biases = [conv.weight for conv in convs], [conv.bias for conv in convs]
        # `to_unit` within the first layer's weights
        biases[0] = biases[0] - 0.5 * weights[0].sum((1, 2, 3))
        weights[0] = weights[0] / 255
        self.layers = [FastConv(*each) for each in zip(weights, biases, norms, strict=True)]

    def __call__(self, image: Tensor) -> Tensor:
        """(N, 64, 64, C) uint8 -> (N, E)."""
        assert image.shape[1:3] == (64, 64) and image.dtype == torch.uint8, image.shape
        x = image.contiguous().float()
        for layer in self.layers:
            x = layer(x)
        return x.flatten(1)


class FastFilter:
    """`RSSM.filter_step`, with the layers that see several inputs as one matrix each."""

    def __init__(self, rssm: RSSM) -> None:
        gru, size, width = rssm.gru, rssm.size, rssm.size.deter // rssm.gru.blocks
        self.size, self.unimix, self.blocks = size, rssm.unimix, gru.blocks
        self.from_deter, self.from_action = map(linear_norm, (gru.from_deter, gru.from_action))
        from_stoch, self.stoch_norm, _ = list[Any](gru.from_stoch)
        self.from_stoch = OneHotProduct(from_stoch.weight, size.classes)
        self.stoch_bias = from_stoch.bias
        self.shared = gru.shared_weight().t().contiguous().t()
        self.hidden_bias, self.own = gru.hidden.bias, gru.hidden.weight[:, :width]
        self.norm, self.gates = gru.norm, gru.gates.weight
        self.layout, gates_bias = gru.layout, gru.gates.bias.detach().clone()
        split_gates(gates_bias[None], gru.blocks, gru.layout)[2].sub_(1)  # of the update gate
        self.gates_bias = gates_bias.view(gru.blocks, 1, -1)
        from_deter, from_embed = rssm.post_in.weight.split(
            [size.deter, rssm.post_in.in_features - size.deter], 1
        )
        pixels = from_embed.unflatten(1, (-1, 2, 2)).permute(0, 2, 3, 1).flatten(1)
        norm, _, self.post_out = list[Any](rssm.post_out)
        self.post = Layer(torch.cat([from_deter, pixels], 1).t(), rssm.post_in.bias, norm)

    def __call__(
        self,
        state: Latent,
        action: Tensor,
        embed: Tensor,
        generator: Generator | None,
        sample: bool,
    ) -> Latent:
        """One step from (N, ...), reset already where an episode begins.

        :param embed: of `FastEncoder`
        """
        deter = self._next_deter(state, action)
        logits = torch.addmm(
            self.post_out.bias, self.post(torch.cat([deter, embed], 1)), self.post_out.weight.t()
        ).view(state.stoch.shape)
        if sample:  # as `sample_one_hot` draws
            probs = logits.softmax(-1).mul_(1 - self.unimix).add_(self.unimix / self.size.classes)
            logits = probs.div_(torch.empty_like(probs).exponential_(generator=generator))
        index = logits.argmax(-1, keepdim=True)
        return Latent(deter, torch.zeros_like(logits).scatter_(-1, index, 1.0))

    def _next_deter(self, state: Latent, action: Tensor) -> Tensor:
        n, blocks = len(action), self.blocks
        from_stoch = norm_silu(self.from_stoch(self.stoch_bias, state.stoch), self.stoch_norm)
        seen = self.from_deter(state.deter), from_stoch, self.from_action(action)
        inputs = torch.cat(seen, 1)
        own = in_blocks(state.deter, blocks)
        shared = torch.addmm(self.hidden_bias, inputs, self.shared)
        hidden = torch.baddbmm(in_blocks(shared, blocks), own, self.own)
        hidden = norm_silu(hidden.transpose(0, 1).reshape(n, -1), self.norm)
        gates = torch.baddbmm(self.gates_bias, in_blocks(hidden, blocks), self.gates)
        reset, candidate, update = split_in_blocks(gates, self.layout)
        candidate = torch.sigmoid(reset).mul_(candidate).tanh_()
        return own.lerp(candidate, torch.sigmoid(update)).transpose(0, 1).reshape(n, -1)


def in_blocks(x: Tensor, blocks: int) -> Tensor:
    """(N, width) -> (blocks, N, width / blocks)."""
    return x.reshape(len(x), blocks, -1).transpose(0, 1)


class FastActor:
    """The outputs of the actor's network, (N, 2 A)."""

    def __init__(self, actor: Actor, classes: int) -> None:
        block, self.norm, _, self.from_deter = list[Any](actor.from_deter)
        self.block, self.blocks = block.weight, len(block.weight)
        self.block_bias = block.bias.view(self.blocks, 1, -1)
        self.from_stoch = OneHotProduct(actor.from_stoch.weight, classes)
        self.bias = self.from_deter.bias + actor.from_stoch.bias
        *hidden, self.last = list[Any](actor.layers)
        self.hidden = [linear_norm(layers) for layers in hidden]

    def __call__(self, state: Latent) -> Tensor:
        """(N, ...) -> (N, 2 A)."""
        x = torch.baddbmm(self.block_bias, in_blocks(state.deter, self.blocks), self.block)
        x = norm_silu(x.transpose(0, 1).reshape(len(state.deter), -1), self.norm)
        x = torch.addmm(self.bias, x, self.from_deter.weight.t())
        x = self.from_stoch(x, state.stoch)
        for layer in self.hidden:
            x = layer(x)
        return torch.addmm(self.last.bias, x, self.last.weight.t())


class FastStep:
    """`WPTPolicy.step` with the weights that these networks have now; see `is_of`."""

    def __init__(self, encoder: Encoder, rssm: RSSM, actor: Actor) -> None:
        self.networks = encoder, rssm, actor
        self.encode, self.filter = FastEncoder(encoder), FastFilter(rssm)
        self.outputs = FastActor(actor, rssm.size.classes)
        self.places: list[tuple[dict[str, Any], str]] = [
            (module._parameters, name)
            for network in self.networks
            for module in network.modules()
            for name in module._parameters
        ]
        self.versions = self._versions()
        self.held = [where[name].detach() for where, name in self.places]  # no address serves twice

    @staticmethod
    def takes(encoder: Encoder, rssm: RSSM, actor: Actor) -> bool:
        """Whether these are the networks that are known here, on a CPU, and count their changes."""
        known = type(encoder) is Encoder and type(rssm) is RSSM and type(actor) is Actor
        bias = rssm.post_in.bias
        return known and bias.device.type == "cpu" and not bias.is_inference()

    def is_of(self, encoder: Encoder, rssm: RSSM, actor: Actor) -> bool:
        """Whether this was made of these networks, and no weight has changed since.

        Changes are known by autograd's version counters; whoever steps a fused optimiser, which
        does not count, calls `torch.autograd.graph.increment_version` as `Updates` does.
        """
        same = all(a is b for a, b in zip(self.networks, (encoder, rssm, actor), strict=True))
        return same and self.versions == self._versions()

    def _versions(self) -> list[tuple[int, int]]:
        now = (where[name] for where, name in self.places)
        return [(weight.data_ptr(), weight._version) for weight in now]

    def __call__(
        self,
        image: Tensor,
        state: Latent,
        action: Tensor,
        is_first: Tensor,
        generator: Generator | None = None,
        sample: bool = True,
    ) -> tuple[Latent, Tensor]:
        """The new state, and the actor's outputs (N, 2 A) there."""
        if is_first.any():
            keep = (~is_first).float()[:, None]
            state = Latent(state.deter * keep, state.stoch * keep[..., None])
            action = action * keep
        state = self.filter(state, action, self.encode(image), generator, sample)
        return state, self.outputs(state)
