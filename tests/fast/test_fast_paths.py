"""What is computed faster than it reads is the same: losses and weights after whole updates."""

from collections import defaultdict

import pytest
import torch
from debug_agent import agent, pretrained, recorded, weights
from torch import nn
from torch._dynamo.backends.registry import lookup_backend

from wpt_agents.fast.compiled import compile_loops
from wpt_agents.model import networks
from wpt_agents.model.rssm import RSSM, BlockGRU
from wpt_agents.model.world_model import WorldModel, squared_error
from wpt_agents.training import updates


def plain(layer, x):
    return nn.functional.conv_transpose2d(x, layer.weight, layer.bias, stride=2)


def error(model, latent, image):
    return squared_error(networks.to_unit(image), model.decode(latent))


def by_definition(patch):
    patch.setattr(networks.UpConv, "forward", plain)
    patch.setattr(networks.ToPixels, "forward", plain)
    patch.setattr(networks.FromPixel, "forward", plain)
    patch.setattr(WorldModel, "reconstruction_error", error)
    patch.setattr(networks, "in_pieces", lambda layers, _, *inputs: layers(*inputs))
    patch.setattr(networks, "by_convolution", lambda *_: False)
    patch.setattr(updates, "over_steps", lambda head, states: head(states.feat))
    patch.setattr(RSSM, "_scan", RSSM._filter)
    forward = BlockGRU.forward
    patch.setattr(BlockGRU, "forward", lambda self, h, z, a, shared=None: forward(self, h, z, a))


def as_of_many_rows(patch):
    patch.setattr(networks, "MANY", 16)
    patch.setattr(networks, "WORK", 0)
    patch.setattr(networks, "AMD_AVX512", True)  # whether or not it is


def three_updates(backend=None):
    model = agent(batch_size=4, batch_length=8)
    if backend is not None:
        compile_loops(model.policy, backend)
    for seed in range(2):
        model.replay_buffer.add(recorded(seed=seed))
    metrics = defaultdict(list)
    for _ in range(3):
        model.update(metrics)
    return {k: torch.stack(v) for k, v in metrics.items()}, weights(model)


def seen(function, calls):
    def call(*arguments):
        calls.append(arguments)
        return function(*arguments)

    return call


def test_three_updates_are_those_of_the_definition(monkeypatch):
    monkeypatch.setattr(networks, "PIECE", 5 * 32 * 32 * 12)  # several pieces, one incomplete
    monkeypatch.setattr(updates, "PIECE", 1)  # the heads see the dreams step by step
    as_of_many_rows(monkeypatch)
    taken = []
    monkeypatch.setattr(networks, "convolved", seen(networks.convolved, taken))
    fast, after = three_updates()
    assert taken
    with monkeypatch.context() as patch:
        by_definition(patch)
        slow, expected = three_updates()
    for name, values in fast.items():
        torch.testing.assert_close(values, slow[name], rtol=1e-4, atol=1e-5, msg=name)
    for name, weight in after.items():
        # Adam's first steps divide by the gradient itself, so that rounding moves a weight whose
        # gradient is nearly zero by up to the learning rate, 1e-3; hardly any is
        assert (weight - expected[name]).abs().mean() < 2e-5, name


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # at which torch looks
def test_three_compiled_updates_are_those_of_the_definition(monkeypatch):
    monkeypatch.setattr(RSSM, "_scan", RSSM._filter)  # the way of a GPU
    as_of_many_rows(monkeypatch)  # what can be compiled of a CPU's way
    expected, after = three_updates()
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return lookup_backend("aot_eager")(graph, inputs)  # as traced, without a C++ compiler

    compiled, weights_after = three_updates(backend)
    # the scan's first step, whose state bears no gradient, its others, and the dream: once each
    assert len(graphs) == 3
    for name, values in expected.items():
        torch.testing.assert_close(compiled[name], values, rtol=1e-4, atol=1e-5, msg=name)
    for name, weight in after.items():
        assert (weight - weights_after[name]).abs().mean() < 2e-5, name


def test_bfloat16_leaves_the_curve_of_pretraining_as_it_is():
    episodes = [recorded(seed=seed) for seed in range(4)]

    def curve(precision):
        losses = []
        pretrained(
            episodes,
            steps=40,
            precision=precision,
            callback=lambda _, metrics: losses.append(metrics["train/reconstruction_loss"]),
        )
        return torch.tensor(losses).unfold(0, 10, 10).mean(1)

    exact, rounded = curve("fp32"), curve("bf16")
    assert exact[-1] < 0.7 * exact[0]  # it learns
    torch.testing.assert_close(rounded, exact, rtol=0.05, atol=0)
