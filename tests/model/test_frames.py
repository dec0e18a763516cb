"""The networks over stacked frames: widths, input scaling, initial weights."""

import pytest
import torch
from torch import nn

from wpt_agents.model.frames import FrameEncoder, Trunk, mlp, orthogonal, xavier


@pytest.mark.parametrize(
    ("channels", "strides", "width"),
    [
        ((32, 32, 32, 32), (2, 1, 1, 1), 20_000),  # DrQ-v2: 64 > 31 > 29 > 27 > 25
        ((32, 64, 128, 256), (2, 2, 2, 2), 2_304),  # RLPD: 64 > 31 > 15 > 7 > 3
    ],
)
def test_widths_are_those_of_the_published_networks(channels, strides, width):
    encoder = FrameEncoder(channels, strides)
    assert encoder.embed_dim == width
    assert encoder(torch.zeros(2, 3, 64, 64, 3, dtype=torch.uint8)).shape == (2, width)


def test_pixels_are_divided_by_255_and_centred_and_colours_of_a_frame_stay_together():
    encoder = FrameEncoder((1,), (1,), centre=0.5)
    nn.init.zeros_(encoder.layers[0].weight)
    nn.init.zeros_(encoder.layers[0].bias)
    encoder.layers[0].weight.data[0, 4, 1, 1] = 1  # frame 1, green
    image = torch.zeros(1, 3, 64, 64, 3, dtype=torch.uint8)
    image[:, 1, ..., 1] = 204
    # 204 / 255 - 0.5 = 0.3
    torch.testing.assert_close(encoder(image), torch.full((1, 62 * 62), 0.3))


@pytest.mark.parametrize(("channel", "seen"), [(0, 0.4), (3, -0.8), (6, -0.1)])
def test_differences_of_neighbouring_frames_replace_all_frames_but_the_newest(channel, seen):
    encoder = FrameEncoder((1,), (1,), centre=0.5, differences=2.0)
    nn.init.zeros_(encoder.layers[0].weight)
    nn.init.constant_(encoder.layers[0].bias, 1.0)  # above ReLU's corner
    encoder.layers[0].weight.data[0, channel, 1, 1] = 1
    image = torch.zeros(1, 3, 64, 64, 3, dtype=torch.uint8)
    for frame, red in enumerate((153, 204, 102)):  # 0.6, 0.8 and 0.4
        image[:, frame, ..., 0] = red
    # 2 (0.8 - 0.6) = 0.4, 2 (0.4 - 0.8) = -0.8, 0.4 - 0.5 = -0.1
    torch.testing.assert_close(encoder(image), torch.full((1, 62 * 62), 1 + seen))


def test_initial_weights_are_orthogonal_with_gain_sqrt_2_in_convolutions():
    network = nn.Sequential(nn.Conv2d(9, 4, 3), nn.Linear(8, 5)).apply(orthogonal)
    for layer, gain in zip(network, (2.0, 1.0), strict=True):  # the squared gain
        rows = layer.weight.flatten(1)
        torch.testing.assert_close(rows @ rows.T, gain * torch.eye(len(rows)), atol=1e-5, rtol=0)
        assert (layer.bias == 0).all()


def test_xavier_fills_the_uniform_range():
    layer = nn.Linear(100, 50)
    xavier(layer)
    limit = (6 / 150) ** 0.5
    assert 0.95 * limit < layer.weight.abs().max() <= limit and (layer.bias == 0).all()


def test_a_trunk_and_an_mlp_by_hand():
    trunk, layers = Trunk(2, 2), mlp(2, 2, 1)
    with torch.no_grad():
        trunk[0].weight.copy_(torch.eye(2))
        trunk[0].bias.zero_()
        for layer in layers[::2]:
            layer.weight.fill_(1)
            layer.bias.zero_()
    # (1, 3) has mean 2 and deviation 1: normalised (-1, 1)
    z = trunk(torch.tensor([[1.0, 3.0]]))
    torch.testing.assert_close(z, torch.tensor([[-1.0, 1.0]]).tanh(), atol=1e-4, rtol=0)
    # (1, 2) > relu(3, 3) > relu(6, 6) > 12
    torch.testing.assert_close(layers(torch.tensor([[1.0, 2.0]])), torch.tensor([[12.0]]))
