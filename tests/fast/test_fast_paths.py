"""Faster twins together: losses and weights after whole updates are those of the definitions."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import agent, pretrained, recorded, weights
from torch._dynamo.backends.registry import lookup_backend

from wpt_agents.fast import pieces, products
from wpt_agents.fast.compiled import compile_loops
from wpt_agents.model.ops import definitions
from wpt_agents.model.rssm import filter_sequence


def as_of_many_rows(patch):
    patch.setattr(products, "MANY", 16)
    patch.setattr(products, "WORK", 0)
    patch.setattr(products, "AMD_AVX512", True)  # whether or not it is


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
    # images one at a time, embeddings in pieces of 3 and 2, the heads' states step by step
    monkeypatch.setattr(pieces, "PIECE", 32 * 32 * 12)
    as_of_many_rows(monkeypatch)
    taken = []
    by_convolution = seen(products.product_by_convolution, taken)
    monkeypatch.setattr(products, "product_by_convolution", by_convolution)
    fast, after = three_updates()
    assert taken
    taken.clear()
    with definitions():
        slow, expected = three_updates()
    assert not taken
    for name, values in fast.items():
        torch.testing.assert_close(values, slow[name], rtol=1e-4, atol=1e-5, msg=name)
    for name, weight in after.items():
        # Adam's first steps divide by the gradient itself, so that rounding moves a weight whose
        # gradient is nearly zero by up to the learning rate, 1e-3; hardly any is
        assert (weight - expected[name]).abs().mean() < 2e-5, name


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # at which torch looks
def test_three_compiled_updates_are_those_of_the_definition(monkeypatch):
    monkeypatch.setattr(filter_sequence, "twins", [])  # as on a GPU
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


@pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor")  # at which torch looks
def test_a_step_is_compiled_once_for_episodes_of_all_lengths():
    model, graphs = agent(), []

    def backend(graph, _):
        graphs.append(graph)
        return graph.forward

    compile_loops(model.policy, backend)
    for length in (3, 4, 5):  # an episode that ends early is judged like any other
        episode = replace(recorded(length), reward=np.zeros(length, np.float32))
        model.policy.heldout_errors(episode)
    assert len(graphs) == 1


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
