import torch
from torch import nn

from wpt_agents.model.images import Decoder, Encoder, to_uint8, to_unit
from wpt_agents.model.sizes import SIZES

DEBUG = SIZES["debug"]


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


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


def test_the_decoder_makes_images_and_depends_on_both_parts():
    decoder, deter, stoch = Decoder(DEBUG), noise(2, 64), noise(2, 8, 8)
    image = decoder(deter, stoch)
    assert image.shape == (2, 64, 64, 3)
    for other in (decoder(deter.roll(1, 0), stoch), decoder(deter, stoch.roll(1, 0))):
        assert not torch.allclose(image, other)


def test_pixels_survive_the_way_to_unit_and_back():
    pixels = torch.arange(256, dtype=torch.uint8)
    assert to_unit(pixels)[[0, 255]].tolist() == [-0.5, 0.5]
    assert torch.equal(to_uint8(to_unit(pixels)), pixels)
    assert to_uint8(torch.tensor([-9.0, 9.0])).tolist() == [0, 255]
