"""ResNets by the published layout, against a plain second form; R3M's files."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from wpt_agents.model.resnet import MEAN, STD, ResNet, read_r3m

# The published layout: blocks of each stage, and whether they are bottlenecks.
LAYOUT = {18: ([2, 2, 2, 2], False), 34: ([3, 4, 6, 3], False), 50: ([3, 4, 6, 3], True)}


def published_names(depth):
    """The names and shapes of torchvision's ResNet without its classifier, written out."""
    blocks, deep = LAYOUT[depth]
    names = {"conv1.weight": (64, 3, 7, 7)} | norm("bn1", 64)
    inputs = 64
    for stage, count in enumerate(blocks, 1):
        width = 32 * 2**stage
        outputs = 4 * width if deep else width
        for block in range(count):
            at = f"layer{stage}.{block}"
            if deep:
                kernels = [(width, inputs, 1), (width, width, 3), (outputs, width, 1)]
            else:
                kernels = [(width, inputs, 3), (width, width, 3)]
            for i, (after, before, side) in enumerate(kernels, 1):
                names[f"{at}.conv{i}.weight"] = (after, before, side, side)
                names |= norm(f"{at}.bn{i}", after)
            if block == 0 and (stage > 1 or deep):
                names[f"{at}.downsample.0.weight"] = (outputs, inputs, 1, 1)
                names |= norm(f"{at}.downsample.1", outputs)
            inputs = outputs
    return names


def norm(at, width):
    vectors = ("weight", "bias", "running_mean", "running_var")
    return {f"{at}.{v}": (width,) for v in vectors} | {f"{at}.num_batches_tracked": ()}


def random_weights(depth, seed=0):
    """Weights of the published layout, such that no layer's output vanishes."""
    generator = torch.Generator().manual_seed(seed)
    weights = {}
    for name, shape in published_names(depth).items():
        if name.endswith("num_batches_tracked"):
            weights[name] = torch.tensor(1)
        elif name.endswith(("running_var", "bn.weight")) or ".bn" in name or "bn1" in name[:3]:
            weights[name] = torch.rand(shape, generator=generator) + 0.5
        else:
            scale = (2 / max(int(np.prod(shape[1:])), 1)) ** 0.5
            weights[name] = scale * torch.randn(shape, generator=generator)
            if name.endswith("downsample.1.running_var"):
                weights[name] = weights[name].abs() + 0.5
    return weights


def plain_resnet(w, image, depth):
    """The same network by functions over the weights' names."""
    blocks, deep = LAYOUT[depth]

    def conv_norm(x, conv, bn, stride=1):
        kernel = w[f"{conv}.weight"]
        x = F.conv2d(x, kernel, stride=stride, padding=kernel.shape[-1] // 2)
        mean, var, scale, offset = (
            w[f"{bn}.{k}"].view(1, -1, 1, 1)
            for k in ("running_mean", "running_var", "weight", "bias")
        )
        return (x - mean) / (var + 1e-5) ** 0.5 * scale + offset

    x = image.permute(0, 3, 1, 2).float() / 255
    x = torch.stack([(x[:, c] - MEAN[c]) / STD[c] for c in range(3)], 1)
    x = F.max_pool2d(conv_norm(x, "conv1", "bn1", 2).clamp_min(0), 3, 2, 1)
    for stage, count in enumerate(blocks, 1):
        for block in range(count):
            at, stride = f"layer{stage}.{block}", 2 if stage > 1 and block == 0 else 1
            short = x
            if f"{at}.downsample.0.weight" in w:
                short = conv_norm(x, f"{at}.downsample.0", f"{at}.downsample.1", stride)
            strides = [1, stride, 1] if deep else [stride, 1]
            for i, s in enumerate(strides, 1):
                x = conv_norm(x, f"{at}.conv{i}", f"{at}.bn{i}", s)
                x = x.clamp_min(0) if i < len(strides) else x
            x = (x + short).clamp_min(0)
    return x.flatten(2).mean(2)


@pytest.mark.parametrize("depth", [18, 34, 50])
def test_the_names_and_shapes_are_the_published_ones(depth):
    ours = {k: tuple(w.shape) for k, w in ResNet(depth).state_dict().items()}
    assert ours == published_names(depth)


@pytest.mark.parametrize("depth", [18, 50])
def test_the_outputs_are_those_of_the_published_layout(depth):
    weights, network = random_weights(depth), ResNet(depth)
    network.load_state_dict(weights)
    network.train()  # and yet no batch statistics
    image = torch.randint(0, 256, (2, 224, 224, 3), dtype=torch.uint8)
    with torch.no_grad():
        ours, theirs = network(image), plain_resnet(weights, image, depth)
    assert ours.shape == (2, network.features) and theirs.std() > 0
    torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4 * theirs.abs().max().item())


@pytest.mark.parametrize("depth", [18, 34, 50])
def test_it_is_the_network_of_torchvision(depth):
    reason = "torchvision is not among our dependencies; the test above has its layout written out"
    models = pytest.importorskip("torchvision.models", reason=reason)
    weights, network = random_weights(depth), ResNet(depth)
    network.load_state_dict(weights)
    theirs = getattr(models, f"resnet{depth}")(weights=None).eval()
    theirs.fc = torch.nn.Identity()
    theirs.load_state_dict(weights)
    image = torch.randint(0, 256, (2, 224, 224, 3), dtype=torch.uint8)
    mean, std = (torch.tensor(x).view(3, 1, 1) for x in (MEAN, STD))
    with torch.no_grad():
        ours = network(image)
        expected = theirs((image.permute(0, 3, 1, 2) / 255 - mean) / std)
    torch.testing.assert_close(ours, expected, rtol=1e-3, atol=1e-4 * expected.abs().max().item())


def test_small_images_are_resized_not_cropped():
    network = ResNet(18)
    image = torch.full((1, 64, 64, 3), 200, dtype=torch.uint8)
    large = torch.full((1, 224, 224, 3), 200, dtype=torch.uint8)
    with torch.no_grad():
        torch.testing.assert_close(network(image), network(large))


def test_the_file_of_the_authors_is_read_without_its_language_parts(tmp_path):
    weights = random_weights(18)
    named = {f"module.convnet.{k}": w for k, w in weights.items()}
    named |= {"module.convnet.fc.weight": torch.ones(2), "module.lang_rew.0": torch.ones(1)}
    torch.save({"r3m": named, "global_step": 3}, tmp_path / "r3m_18.pt")
    read = read_r3m(tmp_path / "r3m_18.pt")
    assert read.keys() == weights.keys()
    network = ResNet(18)
    network.load_state_dict(read)
    assert torch.equal(network.layer4[1].conv2.weight, weights["layer4.1.conv2.weight"])


def test_a_file_of_another_layout_is_refused(tmp_path):
    torch.save({"model": torch.ones(1)}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match="does not hold R3M's network"):
        read_r3m(tmp_path / "other.pt")
