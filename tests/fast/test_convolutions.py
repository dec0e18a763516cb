import pytest
import torch

from wpt_agents.fast.convolutions import (
    by_parity,
    decoded_parities,
    interleaved,
    up_conv_by_phases,
)
from wpt_agents.model.images import Decoder
from wpt_agents.model.layers import DownConv, UpConv
from wpt_agents.model.ops import definitions
from wpt_agents.model.sizes import SIZES


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


@pytest.mark.parametrize("kernel", [5, 6])
@pytest.mark.parametrize("width", [1, 4, 13])
def test_an_upconv_is_the_transposed_convolution_gradients_too(kernel, width):
    layer = UpConv(3, 2, kernel).double()
    x = noise(2, 3, width, width, dtype=torch.float64).requires_grad_()
    leaves = x, layer.weight, layer.bias
    plain = torch.nn.functional.conv_transpose2d(*leaves, stride=2)
    weight = noise(*plain.shape, seed=1, dtype=torch.float64)
    result = layer(x)
    torch.testing.assert_close(result, plain, rtol=1e-12, atol=1e-12)
    expected = torch.autograd.grad((plain * weight).sum(), leaves)
    gradients = torch.autograd.grad((result * weight).sum(), leaves)
    torch.testing.assert_close(gradients, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("kernel", [5, 6])
def test_an_upconv_by_phases_is_the_transposed_convolution_on_the_way_back_too(kernel):
    layer, x = UpConv(3, 2, kernel).double(), noise(2, 3, 4, 4, dtype=torch.float64)
    leaves = x.requires_grad_(), layer.weight, layer.bias
    plain = torch.nn.functional.conv_transpose2d(*leaves, stride=2)
    weight = noise(*plain.shape, seed=1, dtype=torch.float64)
    expected = torch.autograd.grad((plain * weight).sum(), leaves)
    image = up_conv_by_phases(*leaves)  # as in bfloat16
    torch.testing.assert_close(image, plain, rtol=1e-12, atol=1e-12)
    gradients = torch.autograd.grad((image * weight).sum(), leaves)
    torch.testing.assert_close(gradients, expected, rtol=1e-12, atol=1e-12)


def test_pixels_by_parity_are_those_of_the_image():
    image = noise(2, 6, 4, 3)
    parities = by_parity(image)
    assert parities.shape == (2, 3, 2, 12)
    torch.testing.assert_close(parities[1, 2, 1], image[1, 4:6, 2:4].reshape(12))
    torch.testing.assert_close(interleaved(parities), image)


@pytest.mark.parametrize(("kernel", "width"), [(5, 5), (6, 30)])
def test_what_bfloat16_computes_otherwise_is_the_transposed_convolution_too(kernel, width):
    ours, x = UpConv(3, 2, kernel), noise(2, 3, width, width).requires_grad_()
    plain = torch.nn.functional.conv_transpose2d(x, ours.weight, ours.bias, stride=2)
    leaves, weight = (x, ours.weight, ours.bias), noise(*plain.shape, seed=1)
    expected = torch.autograd.grad((plain * weight).sum(), leaves)
    torch.testing.assert_close(ours(x), plain, rtol=1e-5, atol=1e-5)
    with torch.autocast("cpu", torch.bfloat16):
        result = ours(x)
    assert result.dtype == torch.bfloat16
    torch.testing.assert_close(result.float(), plain, rtol=0.02, atol=0.02)
    for a, b in zip(torch.autograd.grad((result * weight).sum(), leaves), expected, strict=True):
        assert (a - b).abs().max() < 0.02 * b.abs().max()


def test_a_downconv_of_a_single_image_is_the_strided_convolution():
    layer = DownConv(3, 5, 4).double()
    for side in (6, 7, 14):
        x = noise(1, 3, side, side, dtype=torch.float64)
        with torch.no_grad():
            plain = torch.nn.functional.conv2d(x, layer.weight, layer.bias, stride=2)
            torch.testing.assert_close(layer(x), plain, rtol=1e-12, atol=1e-12)


def test_the_last_layer_of_a_decoder_is_computed_in_float32():
    decoder, code = Decoder(SIZES["debug"]), noise(2, 16, 5, 5)
    with definitions():
        expected = decoder.images(code)
    with torch.autocast("cpu", torch.bfloat16):
        parities = decoded_parities(decoder, code)
    assert parities.dtype == torch.float32
    torch.testing.assert_close(interleaved(parities), expected, rtol=0.02, atol=0.02)
