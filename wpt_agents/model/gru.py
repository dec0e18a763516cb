"""The recurrent function f of the RSSM."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from wpt_agents.model.layers import BlockLinear, LinearNorm
from wpt_agents.model.ops import shared_block_linear
from wpt_agents.model.sizes import Size


def split_gates(gates: Tensor, blocks: int, layout: str) -> tuple[Tensor, ...]:
    """Split the (N, 3 D) outputs of a GRU's last layer into its gates, each (N, b, D / b).

    :param blocks: b
    :param layout: `Size.gates`; with "across" a unit gets the gates that other blocks computed
    :return: reset, candidate and update
    """
    within = layout == "within"
    split: Tensor = gates.unflatten(1, (blocks, 3, -1) if within else (3, blocks, -1))
    return split.unbind(2 if within else 1)


class BlockGRU(nn.Module):
    """The function f: a GRU with block-diagonal recurrent weights; each block sees all of z, a."""

    def __init__(self, size: Size, action_dim: int) -> None:
        super().__init__()
        deter = size.deter
        hidden = size.hidden
        eps = size.norm_eps
        self.blocks = size.blocks
        self.layout = size.gates
        self.from_deter = LinearNorm(deter, hidden, eps)
        self.from_stoch = LinearNorm(size.stoch * size.classes, hidden, eps)
        self.from_action = LinearNorm(action_dim, hidden, eps)
        self.hidden = BlockLinear(deter + 3 * hidden * self.blocks, deter, self.blocks)
        self.norm = nn.LayerNorm(deter, eps=eps)
        self.gates = BlockLinear(deter, 3 * deter, self.blocks)

    def forward(self, deter: Tensor, stoch: Tensor, action_embed: Tensor) -> Tensor:
        """Make one step: (N, D), (N, S, K), (N, hidden) -> (N, D)."""
        inputs = [self.from_deter(deter), self.from_stoch(stoch.flatten(1)), action_embed]
        before: Tensor = deter.unflatten(1, (self.blocks, -1))
        weight = self.hidden.weight
        hidden = shared_block_linear(deter, torch.cat(inputs, -1), weight, self.hidden.bias)
        hidden = F.silu(self.norm(hidden))
        reset, candidate, update = split_gates(self.gates(hidden), self.blocks, self.layout)
        update = torch.sigmoid(update - 1)  # the GRU starts out remembering, as in DreamerV3
        # Reset multiplies the candidate instead of h, so that one layer computes all three gates.
        candidate = torch.tanh(torch.sigmoid(reset) * candidate)
        after = update * candidate + (1 - update) * before
        return after.flatten(1)
