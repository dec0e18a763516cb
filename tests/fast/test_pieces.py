import pytest
import torch

from wpt_agents.fast import pieces
from wpt_agents.model.images import Decoder, Encoder
from wpt_agents.model.layers import Head
from wpt_agents.model.sizes import SIZES

DEBUG = SIZES["debug"]


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(
    ("net", "inputs", "row"),
    [
        (Encoder(4), [torch.arange(7 * 64 * 64 * 3).view(7, 64, 64, 3).byte()], 31 * 31 * 4),
        (Decoder(DEBUG), [noise(7, 64), noise(7, 8, 8, seed=1)], 32 * 32 * 12),
        (Head(DEBUG, 2, 5), [noise(7, 128)], 64),
    ],
)
def test_rows_in_pieces_are_those_of_all_rows_at_once(net, inputs, row, monkeypatch):
    outputs, gradients = [], []
    for rows in (7, 3):  # 3 + 3 + 1
        monkeypatch.setattr(pieces, "PIECE", rows * row)
        outputs.append(net(*inputs))
        total = (outputs[-1] * noise(*outputs[-1].shape, seed=2)).sum()
        gradients.append(torch.autograd.grad(total, list(net.parameters())))
    torch.testing.assert_close(*outputs)
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-3)


def test_a_piece_has_rows_that_a_convolution_can_take(monkeypatch):
    monkeypatch.setattr(pieces, "PIECE", 1000)
    assert [pieces.rows_of_a_piece(size) for size in (2000, 100, 30, 10)] == [1, 10, 32, 96]
