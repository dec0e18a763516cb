"""Process many rows in chunks, on a CPU.

glibc's malloc returns blocks of more than 32 MB to the system, which zeroes them page by page at
the next allocation. That takes about as long as the arithmetic, so tensors are kept smaller.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from wpt_agents.fast.conditions import on_cpu
from wpt_agents.fast.products import IMAGES
from wpt_agents.model.ops import over_rows
from wpt_agents.model.rssm import Latent, over_steps

PIECE = 2**22  # elements in the largest tensor of a chunk: 16 MB of float32


def rows_of_a_piece(row_size: int) -> int:
    """Return the number of rows per chunk, as a multiple that convolutions accept."""
    rows = max(1, PIECE // row_size)
    return rows - rows % IMAGES if rows > IMAGES else rows


def has_many_rows(layers: Callable[..., Tensor], row_size: int, *inputs: Tensor) -> bool:
    """Return whether the rows do not fit into one chunk, on a CPU."""
    return on_cpu(inputs[0]) and len(inputs[0]) > rows_of_a_piece(row_size)


@over_rows.faster(when=has_many_rows)
def over_rows_in_pieces(layers: Callable[..., Tensor], row_size: int, *inputs: Tensor) -> Tensor:
    """`over_rows` for a few rows at a time."""
    rows = rows_of_a_piece(row_size)
    pieces = zip(*(x.split(rows) for x in inputs), strict=True)
    return torch.cat([layers(*piece) for piece in pieces])


def has_many_features(head: Callable[[Tensor], Tensor], states: Latent) -> bool:
    """Return whether the features of all steps are too large for one tensor, on a CPU."""
    deter, stoch = states
    return on_cpu(deter) and deter.numel() + stoch.numel() > PIECE


@over_steps.faster(when=has_many_features)
def over_steps_one_by_one(head: Callable[[Tensor], Tensor], states: Latent) -> Tensor:
    """`over_steps` step by step."""
    return torch.stack([head(state.feat) for state in states.steps()], 1)
