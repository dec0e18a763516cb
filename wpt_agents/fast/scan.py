"""The scan of `RSSM.observe` with its gradients written out, for a CPU.

`RSSM._filter` is the definition; tests/test_scan.py holds this equal to it, gradients too. Autograd
would go back through some 400 small operators a step and add up every weight's gradient step by
step. Here going back takes some 30 operators a step, for the states' gradients alone; what the
layers saw and the slopes at their outputs are kept, and each weight gets its gradient at the end,
from one matmul over all steps.
"""

from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor
from torch.autograd.function import once_differentiable

from wpt_agents.model.distributions import exponential

aten = torch.ops.aten


class Constants(NamedTuple):
    """What a scan needs to know besides its weights; see `Size`."""

    unimix: float
    gates: str
    norm_eps: float


class Tape:
    """A layer of the scan: what it saw at each step, and the slopes that came back, last first."""

    def __init__(self) -> None:
        self.seen: list[Any] = []
        self.slopes: list[Tensor] = []

    def all_slopes(self, dim: int = 0) -> Tensor:
        """Those of all steps, first step first, joined along `dim`."""
        return torch.cat(self.slopes[::-1], dim)


class Linear(Tape):
    """x W^T + b; b is the layer's own or another one at each step."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        super().__init__()
        self.weight, self.bias, self.transposed = weight, bias, weight.t()

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
        """Of the weight, and of the bias if it is the layer's own."""
        slope = self.all_slopes()
        gradients = [slope.t() @ torch.cat(self.seen)]
        return gradients if self.bias is None else [*gradients, slope.sum(0)]


class Blocks(Tape):
    """`BlockLinear` with the blocks in front: (b, N, inputs / b) -> (b, N, outputs / b)."""

    def __init__(self, weight: Tensor, bias: Tensor | None = None) -> None:
        super().__init__()
        self.weight, self.transposed = weight, weight.transpose(1, 2)
        self.bias = None if bias is None else bias.view(len(weight), 1, -1)

    def forward(self, x: Tensor) -> Tensor:
        """One step."""
        self.seen.append(x)
        if self.bias is None:
            return torch.bmm(x, self.weight)
        return torch.baddbmm(self.bias, x, self.weight)

    def backward(self, slope: Tensor) -> Tensor:
        """(b, N, outputs / b) -> (b, N, inputs / b)."""
        self.slopes.append(slope)
        return torch.bmm(slope, self.transposed)

    def gradients(self) -> list[Tensor]:
        """Of the weight and the bias, if there is one."""
        slope = self.all_slopes(1)
        gradients = [torch.cat(self.seen, 1).transpose(1, 2) @ slope]
        return gradients if self.bias is None else [*gradients, slope.sum(1).flatten()]


class NormSiLU(Tape):
    """SiLU(LayerNorm(x)): (N, width) -> (N, width)."""

    def __init__(self, weight: Tensor, bias: Tensor, eps: float) -> None:
        super().__init__()
        self.weight, self.bias, self.eps = weight, bias, eps

    def forward(self, x: Tensor) -> Tensor:
        """One step."""
        normed, *moments = aten.native_layer_norm(
            x, self.weight.shape, self.weight, self.bias, self.eps
        )
        self.seen.append((x, normed, *moments))
        return aten.silu(normed)

    def backward(self, t: int, slope: Tensor) -> Tensor:
        """The slope at the input of step t."""
        x, normed, *moments = self.seen[t]
        self.slopes.append(aten.silu_backward(slope, normed))
        return self._backward(self.slopes[-1], x, moments, [True, False, False])[0]

    def gradients(self) -> list[Tensor]:
        """Of the weight and the bias."""
        x, _, *moments = (torch.cat(each) for each in zip(*self.seen, strict=True))
        return list(self._backward(self.all_slopes(), x, moments, [False, True, True])[1:])

    def _backward(
        self, slope: Tensor, x: Tensor, moments: list[Tensor], wanted: list[bool]
    ) -> tuple[Tensor, ...]:
        shape = self.weight.shape
        return aten.native_layer_norm_backward(
            slope, x, shape, *moments, self.weight, self.bias, wanted
        )


class Gates(Tape):
    """The GRU's gates, blocks in front: (b, N, 3 D / b) and h (b, N, D / b) -> the next h.

    :param layout: `Size.gates`
    """

    def __init__(self, layout: str) -> None:
        super().__init__()
        self.layout = layout

    def forward(self, gates: Tensor, deter: Tensor) -> Tensor:
        """One step."""
        reset, candidate, update = split_in_blocks(gates, self.layout)
        reset, update = torch.sigmoid(reset), torch.sigmoid(update - 1)
        new = torch.tanh(reset * candidate)
        self.seen.append((reset, candidate, update, new, deter))
        return torch.lerp(deter, new, update)

    def backward(self, t: int, slope: Tensor) -> tuple[Tensor, Tensor]:
        """The slopes at gates and h of step t."""
        reset, candidate, update, new, deter = self.seen[t]
        to_new = slope * update
        to_update = aten.sigmoid_backward(slope * (new - deter), update)
        to_product = aten.tanh_backward(to_new, new)
        to_reset = aten.sigmoid_backward(to_product * candidate, reset)
        return self._joined(to_reset, to_product * reset, to_update), slope - to_new

    def _joined(self, *gates: Tensor) -> Tensor:
        """The inverse of `split_in_blocks`."""
        if self.layout == "within":
            return torch.cat(gates, 2)
        flat = torch.stack(gates).permute(2, 0, 1, 3).flatten(1)  # (N, 3 D)
        return flat.unflatten(1, (len(gates[0]), -1)).transpose(0, 1)


def split_in_blocks(gates: Tensor, layout: str) -> tuple[Tensor, ...]:
    """`split_gates` with the blocks in front: (b, N, 3 D / b) -> three times (b, N, D / b)."""
    if layout == "within":
        return gates.chunk(3, 2)
    flat = gates.transpose(0, 1).flatten(1)  # (N, 3 D), the thirds of which are the gates
    return flat.unflatten(1, (3, len(gates), -1)).permute(1, 2, 0, 3).unbind(0)


class Steps:
    """All layers of a step, made of the weights in the order of `RSSM._scan`."""

    def __init__(self, constants: Constants, weights: tuple[Tensor, ...]) -> None:
        w, eps = iter(weights), constants.norm_eps
        self.deter_in, self.deter_norm = Linear(next(w), next(w)), NormSiLU(next(w), next(w), eps)
        self.stoch_in, self.stoch_norm = Linear(next(w), next(w)), NormSiLU(next(w), next(w), eps)
        self.shared, self.own = Linear(next(w)), Blocks(next(w))
        self.norm, self.gates_in = NormSiLU(next(w), next(w), eps), Blocks(next(w), next(w))
        self.post_in = Linear(next(w))
        self.post_norm, self.post_out = NormSiLU(next(w), next(w), eps), Linear(next(w), next(w))
        self.gates, self.unimix = Gates(constants.gates), constants.unimix
        self.probs: list[Tensor] = []
        self.mixed: list[Tensor] = []

    @property
    def layers(self) -> list[Any]:
        """In the order of the weights."""
        return [
            *(self.deter_in, self.deter_norm, self.stoch_in, self.stoch_norm, self.shared),
            *(self.own, self.norm, self.gates_in, self.post_in, self.post_norm, self.post_out),
        ]

    def forward(
        self, deter: Tensor, stoch: Tensor, action_half: Tensor, embed_half: Tensor
    ) -> tuple[Tensor, Tensor]:
        """One step: the new h (N, D) and the posterior's probabilities (N, S, K)."""
        blocks = len(self.own.weight)
        from_deter = self.deter_norm.forward(self.deter_in.forward(deter))
        from_stoch = self.stoch_norm.forward(self.stoch_in.forward(stoch.flatten(1)))
        shared = self.shared.forward(torch.cat([from_deter, from_stoch], 1), action_half)
        in_blocks = deter.unflatten(1, (blocks, -1)).transpose(0, 1)
        own = self.own.forward(in_blocks).transpose(0, 1)
        hidden = self.norm.forward(own.add(shared.view(own.shape)).flatten(1))
        gates = self.gates_in.forward(hidden.unflatten(1, (blocks, -1)).transpose(0, 1))
        deter = self.gates.forward(gates, in_blocks).transpose(0, 1).flatten(1)
        hidden = self.post_norm.forward(self.post_in.forward(deter, embed_half))
        probs = self.post_out.forward(hidden).view(stoch.shape).softmax(-1)
        mixed = (1 - self.unimix) * probs + self.unimix / stoch.shape[-1]
        self.probs.append(probs)
        self.mixed.append(mixed)
        return deter, mixed

    def backward(self, t: int, to_deter: Tensor, to_probs: Tensor) -> tuple[Tensor, Tensor]:
        """The slopes at the h (N, D) and z (N, S, K) that step t began with.

        :param to_deter: (N, D), the slope at the new h but for the posterior's part
        :param to_probs: (N, S, K), the slope at the unmixed probabilities
        """
        blocks = len(self.own.weight)
        probs = self.probs[t]
        to_logits = aten._softmax_backward_data(to_probs, probs, -1, probs.dtype)
        to_post = self.post_norm.backward(t, self.post_out.backward(to_logits.flatten(1)))
        to_deter = self.post_in.backward(to_post, to_deter)
        slope = to_deter.unflatten(1, (blocks, -1)).transpose(0, 1)
        to_gates, through = self.gates.backward(t, slope)
        to_hidden = self.gates_in.backward(to_gates).transpose(0, 1).flatten(1)
        to_sum = self.norm.backward(t, to_hidden)
        to_own = self.own.backward(to_sum.unflatten(1, (blocks, -1)).transpose(0, 1))
        to_shared = self.shared.backward(to_sum)
        from_deter, from_stoch = to_shared.chunk(2, 1)
        earlier = (through + to_own).transpose(0, 1).flatten(1)
        to_deter = self.deter_in.backward(self.deter_norm.backward(t, from_deter), earlier)
        to_stoch = self.stoch_in.backward(self.stoch_norm.backward(t, from_stoch))
        return to_deter, to_stoch.view(probs.shape)


class FilterScan(torch.autograd.Function):
    """h and z of all steps, and the posteriors' probabilities, each (T, B, ...)."""

    @staticmethod
    def forward(
        ctx: Any,
        constants: Constants,
        generator: Generator | None,
        is_first: Tensor,
        action_half: Tensor,
        embed_half: Tensor,
        deter: Tensor,
        stoch: Tensor,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Filters.

        :param is_first: (T, B) bool
        :param action_half: (T, B, D), what the actions and the bias add before the GRU's norm
        :param embed_half: (T, B, hidden), what images and bias add before the posterior's norm
        :param deter: (B, D), the state before the first image
        :param stoch: (B, S, K)
        :param weights: in the order that `Steps` takes them
        """
        steps = Steps(constants, weights)
        keep = (~is_first).to(deter.dtype)
        resets = is_first.any(1).tolist()
        deters, stochs = [], []
        for t, reset in enumerate(resets):
            if reset:
                deter, stoch = deter * keep[t, :, None], stoch * keep[t, :, None, None]
            deter, probs = steps.forward(deter, stoch, action_half[t], embed_half[t])
            index = (probs / exponential(probs, generator)).argmax(-1, keepdim=True)
            stoch = torch.zeros_like(probs).scatter_(-1, index, 1.0)
            deters.append(deter)
            stochs.append(stoch)
        ctx.steps, ctx.keep, ctx.resets = steps, keep, resets
        ctx.mixed = torch.stack(steps.mixed)
        return torch.stack(deters), torch.stack(stochs), torch.log(ctx.mixed)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any, to_deters: Tensor, to_stochs: Tensor, to_logits: Tensor
    ) -> tuple[Tensor | None, ...]:
        """The gradients of what `forward` took."""
        steps: Steps = ctx.steps
        for layer in steps.layers:
            layer.slopes.clear()  # of an earlier way back through the same graph
        share = 1 - steps.unimix
        # z follows the probabilities (straight-through), and their logarithm is the third output
        to_probs = (to_stochs + to_logits / ctx.mixed) * share
        to_deter, to_stoch = torch.zeros_like(to_deters[0]), torch.zeros_like(to_stochs[0])
        for t in reversed(range(len(to_deters))):
            to_deter, to_stoch = steps.backward(
                t, to_deter + to_deters[t], torch.add(to_probs[t], to_stoch, alpha=share)
            )
            if ctx.resets[t]:
                keep = ctx.keep[t, :, None]
                to_deter, to_stoch = to_deter * keep, to_stoch * keep[..., None]
        to_action = torch.stack(steps.shared.slopes[::-1])
        to_embed = torch.stack(steps.post_in.slopes[::-1])
        gradients = [g for layer in steps.layers for g in layer.gradients()]
        return None, None, None, to_action, to_embed, to_deter, to_stoch, *gradients
