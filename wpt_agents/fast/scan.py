"""`filter_sequence` with manual gradients, for training on a CPU.

Autograd's backward pass has about 400 small operators per step, and accumulates the gradients of
all weights step by step. Here a backward step has about 30 operators, which compute only the
gradients of the states. The inputs of each layer and the gradients at its outputs (slopes) are
stored (tape.py), and each weight's gradient is computed at the end with one product over all steps.
A GPU would gain less, because it computes small operators while Python launches the next ones.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from wpt_agents.fast.conditions import on_cpu
from wpt_agents.fast.tape import Blocks, Gates, Linear, NormSiLU, in_blocks, out_of_blocks
from wpt_agents.model.distributions import Noise, exponential
from wpt_agents.model.rssm import RSSM, Latent, filter_sequence

aten = torch.ops.aten


class Constants(NamedTuple):
    """The settings of a scan besides its weights; see `Size`."""

    unimix: float
    gates: str
    norm_eps: float


class Steps:
    """All layers of a step, built from the weights in the order in which `scan` passes them."""

    def __init__(self, constants: Constants, weights: tuple[Tensor, ...]) -> None:
        w = iter(weights)
        eps = constants.norm_eps
        self.deter_in = Linear(next(w), next(w))
        self.deter_norm = NormSiLU(next(w), next(w), eps)
        self.stoch_in = Linear(next(w), next(w))
        self.stoch_norm = NormSiLU(next(w), next(w), eps)
        self.shared = Linear(next(w))
        self.private = Blocks(next(w))
        self.norm = NormSiLU(next(w), next(w), eps)
        self.gates_in = Blocks(next(w), next(w))
        self.post_in = Linear(next(w))
        self.post_norm = NormSiLU(next(w), next(w), eps)
        self.post_out = Linear(next(w), next(w))
        self.gates = Gates(constants.gates)
        self.unimix = constants.unimix
        self.probs: list[Tensor] = []
        self.mixed: list[Tensor] = []

    @property
    def layers(self) -> list[Any]:
        """The layers in the order of their weights."""
        return [
            *(self.deter_in, self.deter_norm, self.stoch_in, self.stoch_norm, self.shared),
            *(self.private, self.norm, self.gates_in, self.post_in, self.post_norm, self.post_out),
        ]

    def forward(
        self, deter: Tensor, stoch: Tensor, action_half: Tensor, embed_half: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute one step: the new h (N, D) and the posterior's probabilities (N, S, K)."""
        blocks = len(self.private.weight)
        from_deter = self.deter_norm.forward(self.deter_in.forward(deter))
        from_stoch = self.stoch_norm.forward(self.stoch_in.forward(stoch.flatten(1)))
        shared = self.shared.forward(torch.cat([from_deter, from_stoch], 1), action_half)
        deter = in_blocks(deter, blocks)
        private = self.private.forward(deter).transpose(0, 1)
        hidden = self.norm.forward(private.add(shared.view(private.shape)).flatten(1))
        gates = self.gates_in.forward(in_blocks(hidden, blocks))
        deter = out_of_blocks(self.gates.forward(gates, deter))
        hidden = self.post_norm.forward(self.post_in.forward(deter, embed_half))
        probs = self.post_out.forward(hidden).view(stoch.shape).softmax(-1)
        mixed = (1 - self.unimix) * probs + self.unimix / stoch.shape[-1]
        self.probs.append(probs)
        self.mixed.append(mixed)
        return deter, mixed

    def backward(self, t: int, to_deter: Tensor, to_probs: Tensor) -> tuple[Tensor, Tensor]:
        """Return the slopes at the h (N, D) and z (N, S, K) from which step t started.

        :param to_deter: (N, D), the slope at the new h, without the part through the posterior
        :param to_probs: (N, S, K), the slope at the unmixed probabilities
        """
        blocks = len(self.private.weight)
        probs = self.probs[t]
        to_logits = aten._softmax_backward_data(to_probs, probs, -1, probs.dtype)
        to_post = self.post_norm.backward(t, self.post_out.backward(to_logits.flatten(1)))
        to_deter = self.post_in.backward(to_post, to_deter)
        to_gates, through = self.gates.backward(t, in_blocks(to_deter, blocks))
        to_hidden = out_of_blocks(self.gates_in.backward(to_gates))
        to_sum = self.norm.backward(t, to_hidden)
        to_private = self.private.backward(in_blocks(to_sum, blocks))
        from_deter, from_stoch = self.shared.backward(to_sum).chunk(2, 1)
        earlier = out_of_blocks(through + to_private)
        to_deter = self.deter_in.backward(self.deter_norm.backward(t, from_deter), earlier)
        to_stoch = self.stoch_in.backward(self.stoch_norm.backward(t, from_stoch))
        return to_deter, to_stoch.view(probs.shape)


class FilterScan(torch.autograd.Function):
    """h and z of all steps, and the posteriors' log-probabilities, each (T, B, ...)."""

    @staticmethod
    def forward(
        ctx: Any,
        constants: Constants,
        generator: Noise,
        is_first: Tensor,
        action_half: Tensor,
        embed_half: Tensor,
        deter: Tensor,
        stoch: Tensor,
        *weights: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Filter a sequence.

        :param is_first: (T, B) bool
        :param action_half: (T, B, D), the contribution of actions and bias before the GRU's norm
        :param embed_half: (T, B, hidden), what images and bias add before the posterior's norm
        :param deter: (B, D), h before the first image
        :param stoch: (B, S, K), z before the first image
        :param weights: in the order of `Steps`
        """
        steps = Steps(constants, weights)
        keep = (~is_first).to(deter.dtype)
        resets = is_first.any(1).tolist()
        deters, stochs = [], []
        for t, reset in enumerate(resets):
            if reset:
                deter = deter * keep[t, :, None]
                stoch = stoch * keep[t, :, None, None]
            deter, probs = steps.forward(deter, stoch, action_half[t], embed_half[t])
            index = (probs / exponential(probs, generator)).argmax(-1, keepdim=True)
            stoch = torch.zeros_like(probs).scatter_(-1, index, 1.0)  # same as `sample_one_hot`
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
        """Return the gradients of the arguments of `forward`."""
        steps: Steps = ctx.steps
        for layer in steps.layers:
            layer.slopes.clear()  # from an earlier backward pass through the same graph
        share = 1 - steps.unimix  # the derivative of the mixed probabilities by the unmixed ones
        # z has the gradient of the probabilities (straight-through), and their logarithm is the
        # third output
        to_probs = (to_stochs + to_logits / ctx.mixed) * share
        to_deter = torch.zeros_like(to_deters[0])
        to_stoch = torch.zeros_like(to_stochs[0])
        for t in reversed(range(len(to_deters))):
            to_deter, to_stoch = steps.backward(
                t, to_deter + to_deters[t], torch.add(to_probs[t], to_stoch, alpha=share)
            )
            if ctx.resets[t]:
                keep = ctx.keep[t, :, None]
                to_deter = to_deter * keep
                to_stoch = to_stoch * keep[..., None]
        to_action = torch.stack(steps.shared.slopes[::-1])
        to_embed = torch.stack(steps.post_in.slopes[::-1])
        gradients = [g for layer in steps.layers for g in layer.gradients()]
        return None, None, None, to_action, to_embed, to_deter, to_stoch, *gradients


def learns_on_cpu(
    rssm: RSSM,
    embed_half: Tensor,
    action_embed: Tensor,
    is_first: Tensor,
    state: Latent,
    generator: Noise = None,
    sample: bool = True,
) -> bool:
    """Return whether the sequence is sampled with gradients, on a CPU."""
    return on_cpu(embed_half) and sample and torch.is_grad_enabled()


@filter_sequence.faster(when=learns_on_cpu)
def scan(
    rssm: RSSM,
    embed_half: Tensor,
    action_embed: Tensor,
    is_first: Tensor,
    state: Latent,
    generator: Noise = None,
    sample: bool = True,
) -> tuple[Latent, Tensor]:
    """`filter_sequence` with far fewer operators, always in float32."""
    with torch.autocast("cpu", enabled=False):  # it does not know `FilterScan`
        return _scan(rssm, embed_half.float(), action_embed.float(), is_first, state, generator)


def _scan(
    rssm: RSSM,
    embed_half: Tensor,
    action_embed: Tensor,
    is_first: Tensor,
    state: Latent,
    generator: Noise,
) -> tuple[Latent, Tensor]:
    gru = rssm.gru
    size = rssm.size
    private, shared = gru.hidden.weight.split([size.deter // gru.blocks, 3 * size.hidden], 1)
    # the weights of the inputs that all blocks share, as matrices (inputs, D): those of h and z, a
    matrix = shared.transpose(0, 1).flatten(1)
    state_part, action_part = matrix.split([2 * size.hidden, size.hidden])
    action_half = action_embed.transpose(0, 1) @ action_part + gru.hidden.bias
    deters, stochs, logits = FilterScan.apply(  # type: ignore[no-untyped-call]
        Constants(rssm.unimix, size.gates, size.norm_eps),
        generator,
        is_first.t(),
        action_half,
        embed_half.transpose(0, 1),
        *state,
        *(p for layers in (gru.from_deter, gru.from_stoch) for p in layers.parameters()),
        *(state_part.t(), private, *gru.norm.parameters(), *gru.gates.parameters()),
        *(rssm.post_in.weight[:, : size.deter], *rssm.post_out.parameters()),
    )
    post = Latent(deters.transpose(0, 1), stochs.transpose(0, 1))
    return post, logits.transpose(0, 1)
