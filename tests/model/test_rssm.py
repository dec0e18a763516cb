import pytest
import torch
import torch.nn.functional as F

from wpt_agents.model.distributions import mode_one_hot
from wpt_agents.model.rssm import RSSM, Latent, filter_step
from wpt_agents.model.sizes import SIZES

DEBUG, A, E = SIZES["debug"], 3, 10
B, T, D = 2, 6, DEBUG.deter


def noise(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@pytest.fixture
def rssm():
    torch.manual_seed(0)
    return RSSM(DEBUG, A, E)


def some_state(n=B):
    return Latent(noise(n, D).tanh(), F.one_hot(noise(n, 8, 8).argmax(-1), 8).float())


def first(*places):
    is_first = torch.zeros(B, T, dtype=torch.bool)
    for b, t in places:
        is_first[b, t] = True
    return is_first


def slow_linear_norm(layers, x):
    linear, norm, _ = layers
    x = x @ linear.weight.T + linear.bias
    x = (x - x.mean()) / (x.var(unbiased=False) + 1e-3).sqrt() * norm.weight + norm.bias
    return x * torch.sigmoid(x)


def slow_gru(gru, h, z, a):
    """One step for one state, unit by unit: h (D,), z (S, K), a (A,) -> (D,)."""
    shared = [
        slow_linear_norm(layers, x)
        for layers, x in ((gru.from_deter, h), (gru.from_stoch, z.flatten()), (gru.from_action, a))
    ]
    per, hidden = D // 8, []
    for b in range(8):
        inputs = torch.cat([h[b * per : (b + 1) * per], *shared])
        bias = gru.hidden.bias[b * per : (b + 1) * per]
        hidden.append(inputs @ gru.hidden.weight[b] + bias)
    x = torch.cat(hidden)
    x = (x - x.mean()) / (x.var(unbiased=False) + 1e-3).sqrt() * gru.norm.weight + gru.norm.bias
    x = x * torch.sigmoid(x)
    new = torch.empty(D)
    for b in range(8):  # this block's 3 per outputs are reset, candidate, update of its own units
        gates = x[b * per : (b + 1) * per] @ gru.gates.weight[b]
        gates = gates + gru.gates.bias[3 * b * per : 3 * (b + 1) * per]
        for i in range(per):
            reset, update = torch.sigmoid(gates[i]), torch.sigmoid(gates[2 * per + i] - 1)
            candidate = torch.tanh(reset * gates[per + i])
            new[b * per + i] = update * candidate + (1 - update) * h[b * per + i]
    return new


def slow_logits(layers, x):
    probs = layers(x).view(8, 8).softmax(-1)
    return (0.99 * probs + 0.01 / 8).log()


def slow_posterior(rssm, h, e):
    x = rssm.post_in(torch.cat([h, e]))
    return slow_logits(rssm.post_out, x)


@pytest.mark.slow
def test_the_gru_is_the_slow_reference(rssm):
    state, action = some_state(), noise(B, A)
    with torch.no_grad():
        step = rssm.step(state, action)
        for b in range(B):
            slow = slow_gru(rssm.gru, state.deter[b], state.stoch[b], action[b])
            torch.testing.assert_close(step[b], slow)


def test_a_units_gates_stand_in_its_own_block(rssm):
    for parameter in (rssm.gru.gates.weight, rssm.gru.gates.bias):
        torch.nn.init.zeros_(parameter)
    before = rssm.step(some_state(), noise(B, A))
    with torch.no_grad():  # the bias of block 5, whichever gate: 24 of 192 entries
        rssm.gru.gates.bias[5 * 24 : 6 * 24] += 1
    moved = (rssm.step(some_state(), noise(B, A)) != before).any(0).nonzero().flatten()
    assert moved.tolist() == list(range(5 * 8, 6 * 8))


def test_observe_is_the_slow_step_by_step_reference(rssm):
    embed, action, is_first = noise(B, T, E), noise(B, T, A, seed=1), first((0, 0), (1, 3))
    with torch.no_grad():
        post, post_logits, prior_logits = rssm.observe(
            embed, action, is_first, some_state(), sample=False
        )
        for b in range(B):
            h, z = (x[b] for x in some_state())
            for t in range(T):
                a = action[b, t]
                if is_first[b, t]:
                    h, z, a = 0 * h, 0 * z, 0 * a
                h = slow_gru(rssm.gru, h, z, a)
                q, p = slow_posterior(rssm, h, embed[b, t]), slow_logits(rssm.prior_net, h)
                z = F.one_hot(q.argmax(-1), 8).float()
                for ours, slow in (
                    (post.deter, h),
                    (post.stoch, z),
                    (post_logits, q),
                    (prior_logits, p),
                ):
                    torch.testing.assert_close(ours[b, t], slow)


def test_imagine_is_the_slow_step_by_step_reference(rssm):
    def policy(state, t):
        return torch.tanh(state.deter[:, :A] + state.stoch[:, 0, :A] + t)

    with torch.no_grad():
        states, actions = rssm.imagine(some_state(), policy, 4, sample=False)
        for b in range(B):
            h, z = (x[b] for x in some_state())
            for t in range(4):
                torch.testing.assert_close((states.deter[b, t], states.stoch[b, t]), (h, z))
                a = torch.tanh(h[:A] + z[0, :A] + t)
                torch.testing.assert_close(actions[b, t], a)
                h = slow_gru(rssm.gru, h, z, a)
                z = mode_one_hot(slow_logits(rssm.prior_net, h))
            torch.testing.assert_close((states.deter[b, 4], states.stoch[b, 4]), (h, z))
    assert states.deter.shape == (B, 5, D) and actions.shape == (B, 4, A)


def test_is_first_inside_a_window_is_a_fresh_window(rssm):
    embed, action = noise(B, T, E), noise(B, T, A, seed=1)
    whole = rssm.observe(embed, action, first((0, 3), (1, 3)), some_state(), sample=False)
    action[:, 3] = 0  # nothing led to a first image
    fresh = rssm.observe(embed[:, 3:], action[:, 3:], first()[:, 3:], sample=False)
    torch.testing.assert_close(whole[0].deter[:, 3:], fresh[0].deter)
    torch.testing.assert_close(whole[0].stoch[:, 3:], fresh[0].stoch)
    torch.testing.assert_close([x[:, 3:] for x in whole[1:]], list(fresh[1:]))


def test_no_gradient_crosses_is_first(rssm):
    embed, action = noise(B, T, E).requires_grad_(), noise(B, T, A, seed=1).requires_grad_()
    post, *_ = rssm.observe(embed, action, first((0, 3), (1, 3)))
    (post.deter[:, 4] * noise(B, D)).sum().backward()
    assert embed.grad[:, 3].any() and action.grad[:, 4].any()
    assert not embed.grad[:, :3].any() and not action.grad[:, :4].any()


def test_the_posterior_sees_its_own_image_and_the_prior_only_earlier_ones(rssm):
    embed, action = noise(B, T, E).requires_grad_(), noise(B, T, A, seed=1).requires_grad_()
    _, post_logits, prior_logits = rssm.observe(embed, action, first((0, 0), (1, 0)))
    weight = noise(B, 8, 8)
    to_post = torch.autograd.grad((post_logits[:, 3] * weight).sum(), embed, retain_graph=True)[0]
    to_prior = torch.autograd.grad((prior_logits[:, 3] * weight).sum(), (embed, action))
    assert to_post[:, 3].any() and not to_post[:, 4:].any()
    assert to_prior[0][:, 2].any() and not to_prior[0][:, 3:].any()
    assert to_prior[1][:, 3].any() and not to_prior[1][:, 4:].any()


def test_a_sequence_may_be_filtered_in_pieces(rssm):
    embed, action, is_first = noise(B, T, E), noise(B, T, A, seed=1), first((0, 0), (1, 4))
    whole, *_ = rssm.observe(embed, action, is_first, sample=False)
    head, *_ = rssm.observe(embed[:, :2], action[:, :2], is_first[:, :2], sample=False)
    last = Latent(head.deter[:, -1], head.stoch[:, -1])
    tail, *_ = rssm.observe(embed[:, 2:], action[:, 2:], is_first[:, 2:], last, sample=False)
    torch.testing.assert_close(whole.deter, torch.cat([head.deter, tail.deter], 1))
    torch.testing.assert_close(whole.stoch, torch.cat([head.stoch, tail.stoch], 1))


@pytest.mark.parametrize("sample", [True, False])
def test_a_filter_step_is_a_sequence_of_one_image(rssm, sample):
    embed, action, is_first = noise(B, 1, E), noise(B, 1, A, seed=1), first((1, 0))[:, :1]
    keep = (~is_first).float()
    with torch.no_grad():
        whole, *_ = rssm.observe(
            embed, action, is_first, some_state(), torch.Generator().manual_seed(5), sample
        )
        step, _ = filter_step(
            rssm,
            some_state(),
            rssm.gru.from_action(action[:, 0] * keep),
            rssm.embed_half(embed[:, 0]),
            is_first[:, 0],
            torch.Generator().manual_seed(5),
            sample,
        )
    torch.testing.assert_close(whole.deter[:, 0], step.deter)
    assert torch.equal(whole.stoch[:, 0], step.stoch)


def test_the_same_generator_gives_the_same_latents(rssm):
    arguments = noise(B, T, E), noise(B, T, A), first()
    one, two, other = (
        rssm.observe(*arguments, generator=torch.Generator().manual_seed(s))[0] for s in (5, 5, 6)
    )
    assert torch.equal(one.stoch, two.stoch)
    assert not torch.equal(one.stoch, other.stoch)


def test_feat_is_deter_then_stoch():
    state = some_state()
    assert torch.equal(state.feat, torch.cat([state.deter, state.stoch.view(B, 64)], -1))


def test_standardising_equals_a_posterior_that_sees_standardised_embeddings(rssm):
    embed = 3 + noise(64, E) * torch.linspace(0.5, 4, E)
    embed[:, -1] = 7.0  # an entry that never varies is only shifted
    h = noise(64, D)
    std, mean = torch.std_mean(embed, 0)
    seen = (embed - mean) / std.clamp_min(0.01)
    *before, last = rssm.post_out
    x = torch.cat([h, seen], -1) @ rssm.post_in.weight.T + rssm.post_in.bias
    for layer in before:
        x = layer(x)
    logits = x @ (4 * last.weight).T + last.bias
    expected = rssm._log_probs(logits)
    rssm.standardise(embed)
    torch.testing.assert_close(rssm.posterior(h, embed), expected, atol=1e-4, rtol=1e-4)


def test_standardising_lets_images_change_the_initial_posterior(rssm):
    embed = 3 + 0.1 * noise(64, E)  # most of it is the same for every image
    h = torch.zeros(64, D)
    before = rssm.posterior(h, embed).exp().std(0).mean()
    rssm.standardise(embed)
    after = rssm.posterior(h, embed).exp().std(0).mean()
    assert after > 4 * before
