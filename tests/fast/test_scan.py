from dataclasses import replace

import pytest
import torch

from wpt_agents.fast.scan import scan
from wpt_agents.model.ops import definitions
from wpt_agents.model.rssm import RSSM, Latent, filter_sequence
from wpt_agents.model.sizes import SIZES

A, E, B, T = 3, 10, 4, 7
SIZE = SIZES["debug"]


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def ways(unimix, size=SIZE):
    """An RSSM, and what both ways through it take."""
    torch.manual_seed(0)
    rssm = RSSM(size, A, E, unimix)
    is_first = torch.zeros(B, T, dtype=torch.bool)
    is_first[:, 0] = is_first[1, 3] = is_first[2, 6] = True
    is_first[3, 0] = False  # continues from the first state
    leaves = [
        noise(B, T, size.hidden),
        noise(B, T, size.hidden, seed=1),
        noise(B, size.deter, seed=2),
        noise(B, size.stoch, size.classes, seed=3).softmax(-1),
    ]
    return rssm, [x.requires_grad_() for x in leaves], is_first


def outcome(way, rssm, leaves, is_first):
    """The outputs of a way, and twice the gradients of a weighted sum of them."""
    embed_half, action_embed, deter, stoch = leaves
    generator = torch.Generator().manual_seed(5)
    post, logits = way(rssm, embed_half, action_embed, is_first, Latent(deter, stoch), generator)
    outputs = [post.deter, post.stoch, logits]
    total = sum((x * noise(*x.shape, seed=9)).sum() for x in outputs)
    layers = rssm.gru.from_action, rssm.prior_net  # outside the scan
    outside = {id(p) for layer in layers for p in layer.parameters()}
    weights = {n: p for n, p in rssm.named_parameters() if id(p) not in outside}
    del weights["post_in.bias"]  # is in embed_half, here a leaf
    inputs = dict(zip(("embed", "action", "deter", "stoch"), leaves, strict=True)) | weights
    first, second = (
        torch.autograd.grad(total, list(inputs.values()), retain_graph=True) for _ in range(2)
    )
    return outputs, dict(zip(inputs, first, strict=True)), dict(zip(inputs, second, strict=True))


@pytest.mark.parametrize(
    ("unimix", "size"),
    [(0.0, SIZE), (0.01, SIZE), (0.01, replace(SIZE, gates="across", norm_eps=0.3))],
)
def test_the_scan_by_hand_is_the_loop_with_its_gradients(unimix, size):
    rssm, leaves, is_first = ways(unimix, size)
    plain, plain_gradients, _ = outcome(filter_sequence.definition, rssm, leaves, is_first)
    fast, gradients, again = outcome(scan, rssm, leaves, is_first)
    assert torch.equal(fast[1].argmax(-1), plain[1].argmax(-1))  # the same draws
    torch.testing.assert_close(fast, plain, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients, plain_gradients, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(gradients, again, rtol=0, atol=0)  # the way back gone twice
    assert all(g.any() for g in gradients.values())


def test_observe_takes_the_scan_when_it_learns_on_a_cpu():
    rssm, _, is_first = ways(0.01)
    arguments = noise(B, T, E), noise(B, T, A), is_first

    def node(sample=True):
        return type(rssm.observe(*arguments, sample=sample)[0].deter.grad_fn.next_functions[0][0])

    assert node().__name__ == "FilterScanBackward"
    assert node(sample=False).__name__ != "FilterScanBackward"
    with torch.no_grad():
        assert rssm.observe(*arguments)[0].deter.grad_fn is None
    with definitions():
        assert node().__name__ != "FilterScanBackward"


def test_in_bfloat16_the_scan_stays_in_float32():
    rssm, _, is_first = ways(0.01)
    embed, action = noise(B, T, E), noise(B, T, A)
    with torch.autocast("cpu", torch.bfloat16):
        post, logits, prior_logits = rssm.observe(
            embed, action, is_first, generator=torch.Generator().manual_seed(5)
        )
        embed_half = rssm.embed_half(embed).float()
        keep = (~is_first[..., None]).float()
        action_embed = rssm.gru.from_action(action * keep).float()
    inputs = embed_half, action_embed, is_first, rssm.initial(B)
    with definitions():
        expected, expected_logits = filter_sequence(rssm, *inputs, torch.Generator().manual_seed(5))
    assert post.deter.dtype == logits.dtype == torch.float32
    torch.testing.assert_close((post, logits), (expected, expected_logits), rtol=1e-4, atol=1e-5)
    (post.deter.sum() + prior_logits.sum()).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in rssm.gru.parameters())
