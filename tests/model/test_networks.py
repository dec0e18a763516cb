import pytest
import torch
from torch import nn

from wpt_agents.model import networks
from wpt_agents.model.networks import (
    SIZES,
    BlockLinear,
    ChannelNorm,
    Decoder,
    DownConv,
    Encoder,
    FromPixel,
    Head,
    ToPixels,
    UpConv,
    block_linear,
    by_convolution,
    by_parity,
    frozen,
    interleaved,
    linear,
    to_uint8,
    to_unit,
    upsampled,
)

DEBUG = SIZES["debug"]


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize(
    ("layer", "kernel", "width"),
    [
        (FromPixel, 5, 1),
        (ToPixels, 6, 4),
        *((UpConv, kernel, width) for kernel in (5, 6) for width in (1, 4, 13)),
    ],
)
def test_an_upconv_is_the_transposed_convolution_gradients_too(layer, kernel, width):
    ours = layer(3, 2, kernel).double()
    x = noise(2, 3, width, width, dtype=torch.float64).requires_grad_()
    plain = torch.nn.functional.conv_transpose2d(x, ours.weight, ours.bias, stride=2)
    result, leaves = ours(x), (x, ours.weight, ours.bias)
    torch.testing.assert_close(result, plain, rtol=1e-12, atol=1e-12)
    weight = noise(*plain.shape, seed=1, dtype=torch.float64)
    theirs = torch.autograd.grad((plain * weight).sum(), leaves)
    for a, b in zip(torch.autograd.grad((result * weight).sum(), leaves), theirs, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kernel", [5, 6])
def test_an_upconv_by_phases_is_the_transposed_convolution_on_the_way_back_too(kernel):
    layer, x = UpConv(3, 2, kernel).double(), noise(2, 3, 4, 4, dtype=torch.float64)
    leaves = x.requires_grad_(), layer.weight, layer.bias
    plain = torch.nn.functional.conv_transpose2d(*leaves, stride=2)
    weight = noise(*plain.shape, seed=1, dtype=torch.float64)
    expected = torch.autograd.grad((plain * weight).sum(), leaves)
    image = upsampled(*leaves)  # as in bfloat16
    torch.testing.assert_close(image, plain, rtol=1e-12, atol=1e-12)
    found = torch.autograd.grad((image * weight).sum(), leaves)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def test_pixels_by_parity_are_those_of_the_image():
    image = noise(2, 6, 4, 3)
    parities = by_parity(image)
    assert parities.shape == (2, 3, 2, 12)
    torch.testing.assert_close(parities[1, 2, 1], image[1, 4:6, 2:4].reshape(12))
    torch.testing.assert_close(interleaved(parities), image)


@pytest.mark.parametrize(("layer", "kernel", "width"), [(UpConv, 5, 5), (ToPixels, 6, 30)])
def test_what_bfloat16_computes_otherwise_is_the_transposed_convolution_too(layer, kernel, width):
    ours, x = layer(3, 2, kernel), noise(2, 3, width, width).requires_grad_()
    plain = torch.nn.functional.conv_transpose2d(x, ours.weight, ours.bias, stride=2)
    leaves, weight = (x, ours.weight, ours.bias), noise(*plain.shape, seed=1)
    expected = torch.autograd.grad((plain * weight).sum(), leaves)
    torch.testing.assert_close(ours(x), plain, rtol=1e-5, atol=1e-5)
    with torch.autocast("cpu", torch.bfloat16):
        result = ours(x)
    assert result.dtype == (torch.float32 if layer is ToPixels else torch.bfloat16)
    torch.testing.assert_close(result.float(), plain, rtol=0.02, atol=0.02)
    for a, b in zip(torch.autograd.grad((result * weight).sum(), leaves), expected, strict=True):
        assert (a - b).abs().max() < 0.02 * b.abs().max()


def ran(step):
    """The operators that a step called."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        step()
    return {row.key.removeprefix("aten::") for row in profile.key_averages()}


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("blocks", [1, 4])
def test_many_rows_go_through_a_convolution_which_is_the_matrix_product(blocks, bias, monkeypatch):
    monkeypatch.setattr(networks, "AMD_AVX512", True)  # the arithmetic is every CPU's
    monkeypatch.setattr(networks, "WORK", 0)
    rows, inputs, outputs = 2 * networks.MANY, 12, 8
    wide = noise(rows, inputs + 3).requires_grad_()
    x = wide[:, 3:]  # as a head takes h and z from one tensor
    weight = noise(blocks, inputs // blocks, outputs // blocks, seed=1).requires_grad_()
    bias = noise(outputs, seed=2).requires_grad_() if bias else None
    leaves = [wide, weight] + ([] if bias is None else [bias])
    plain = x @ torch.block_diag(*weight) + (0 if bias is None else bias)
    found = block_linear(x, weight, bias) if blocks > 1 else linear(x, weight[0].t(), bias)
    assert "convolution" in ran(lambda: block_linear(x, weight, bias))
    assert "convolution" in ran(lambda: linear(x, weight.new_ones(5, inputs)))
    torch.testing.assert_close(found, plain, rtol=1e-5, atol=1e-5)
    slope = noise(rows, outputs, seed=3)
    expected = torch.autograd.grad(plain, leaves, slope)
    gradients = torch.autograd.grad(found, leaves, slope)
    torch.testing.assert_close(gradients, expected, rtol=1e-4, atol=1e-4)  # of sums of 512 rows
    in_time = linear(x.unflatten(0, (4, -1)), noise(5, inputs))  # (B, T, inputs)
    torch.testing.assert_close(in_time.flatten(0, 1), x @ noise(5, inputs).t())


def test_which_products_go_through_a_convolution(monkeypatch):
    monkeypatch.setattr(networks, "AMD_AVX512", True)
    rows, width = networks.MANY, networks.WORK // (networks.MANY * 64)
    assert by_convolution(noise(rows, 64), width)
    assert by_convolution(noise(4, rows // 4, 64), width)
    assert not by_convolution(noise(rows, 64), width - 1)  # too little work
    assert not by_convolution(noise(rows - 16, 64), 2 * width)
    assert not by_convolution(noise(rows + 1, 64), width)  # 16 images of equally many pixels
    assert not by_convolution(noise(rows, 64, dtype=torch.float64), width)
    assert not by_convolution(noise(rows, 64).to("meta"), width)
    with torch.autocast("cpu", torch.bfloat16):  # whose products are oneDNN's anyway
        assert not by_convolution(noise(rows, 64), width)
    monkeypatch.setattr(networks, "AMD_AVX512", False)
    assert not by_convolution(noise(rows, 64), width)


def test_a_downconv_of_a_single_image_is_the_strided_convolution():
    layer = DownConv(3, 5, 4).double()
    for side in (6, 7, 14):
        x = noise(1, 3, side, side, dtype=torch.float64)
        with torch.no_grad():
            plain = torch.nn.functional.conv2d(x, layer.weight, layer.bias, stride=2)
            torch.testing.assert_close(layer(x), plain, rtol=1e-12, atol=1e-12)


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


def test_the_encoder_is_four_strided_convolutions_of_the_centred_image():
    encoder = Encoder(4)
    image = torch.randint(256, (2, 64, 64, 3), dtype=torch.uint8)
    x = image.permute(0, 3, 1, 2) / 255 - 0.5
    for i, width in zip(range(0, 12, 3), (31, 14, 6, 2), strict=True):
        x = nn.functional.silu(encoder.layers[i + 1](encoder.layers[i](x)))
        assert x.shape[-2:] == (width, width)
    torch.testing.assert_close(encoder(image), x.flatten(1))
    assert encoder.embed_dim == x.flatten(1).shape[1]


def test_the_encoder_takes_any_leading_axes():
    encoder = Encoder(4)
    image = torch.randint(256, (2, 3, 64, 64, 3), dtype=torch.uint8)
    torch.testing.assert_close(encoder(image)[1, 2], encoder(image[1, 2][None])[0])
    assert encoder(image).shape == (2, 3, encoder.embed_dim)


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
        monkeypatch.setattr("wpt_agents.model.networks.PIECE", rows * row)
        outputs.append(net(*inputs))
        total = (outputs[-1] * noise(*outputs[-1].shape, seed=2)).sum()
        gradients.append(torch.autograd.grad(total, list(net.parameters())))
    torch.testing.assert_close(*outputs)
    torch.testing.assert_close(*gradients, rtol=1e-4, atol=1e-3)


def test_the_decoder_makes_images_and_depends_on_both_parts():
    decoder, deter, stoch = Decoder(DEBUG), noise(2, 64), noise(2, 8, 8)
    image = decoder(deter, stoch)
    assert image.shape == (2, 64, 64, 3)
    for other in (decoder(deter.roll(1, 0), stoch), decoder(deter, stoch.roll(1, 0))):
        assert not torch.allclose(image, other)


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


def test_pixels_survive_the_way_to_unit_and_back():
    pixels = torch.arange(256, dtype=torch.uint8)
    assert to_unit(pixels)[[0, 255]].tolist() == [-0.5, 0.5]
    assert torch.equal(to_uint8(to_unit(pixels)), pixels)
    assert to_uint8(torch.tensor([-9.0, 9.0])).tolist() == [0, 255]


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
