import pytest
import torch
from torch import nn

from wpt_agents.model.layers import BlockLinear, ChannelNorm, Head, frozen
from wpt_agents.model.sizes import SIZES

DEBUG = SIZES["debug"]


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def test_block_linear_is_a_block_diagonal_matrix():
    layer = BlockLinear(6, 9, 3).double()
    matrix = torch.block_diag(*layer.weight)  # (6, 9)
    x = noise(4, 6, dtype=torch.float64)
    torch.testing.assert_close(layer(x), x @ matrix + layer.bias)


def test_block_linear_is_drawn_by_its_blocks_own_fan_in():
    # 256 / 8 = 32 inputs a block: uniform in +-1 / sqrt(32), of std 1 / sqrt(3 * 32) = 0.102
    torch.manual_seed(0)
    weight = BlockLinear(256, 768, 8).weight
    assert weight.std().item() == pytest.approx(0.102, rel=0.02)
    assert weight.abs().max() <= 32**-0.5


def test_channel_norm_standardises_each_pixel_over_its_channels():
    x = 5 * noise(2, 7, 3, 4) + 2
    centred = x - x.mean(1, keepdim=True)
    expected = centred / (centred.square().mean(1, keepdim=True) + 1e-3).sqrt()
    torch.testing.assert_close(ChannelNorm(7)(x), expected)


def test_a_head_sums_its_two_parts_and_ignores_the_order_of_rows():
    head, feat = Head(DEBUG, 2, 5), noise(3, 4, 64 + 64)
    deter, stoch = feat[..., :64].flatten(0, 1), feat[..., 64:].flatten(0, 1)
    expected = head.layers(head.from_deter(deter) + head.from_stoch(stoch)).view(3, 4, 5)
    torch.testing.assert_close(head(feat), expected)
    torch.testing.assert_close(head(feat[1:2]), expected[1:2])


def test_a_head_started_at_zero_answers_zero_and_still_learns():
    head = Head(DEBUG, 2, 5, zero_init=True)
    out = head(noise(3, 128))
    assert not out.any()
    out.sum().backward()
    assert head.layers[-1].weight.grad.any()


def test_gradients_pass_through_frozen_modules_and_leave_them_alone():
    layer, never = nn.Linear(2, 2), nn.Linear(2, 2).requires_grad_(False)
    x = noise(1, 2).requires_grad_()
    with frozen(layer, never):
        out = never(layer(x)).sum()
    out.backward()  # outside, as the update does
    assert x.grad.any()
    assert layer.weight.grad is None and layer.weight.requires_grad
    assert not never.weight.requires_grad


def test_frozen_modules_thaw_when_the_block_fails():
    layer = nn.Linear(2, 2)
    with pytest.raises(RuntimeError), frozen(layer):
        raise RuntimeError
    assert layer.weight.requires_grad
