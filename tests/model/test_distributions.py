import math

import numpy as np
import pytest
import torch
from scipy.stats import truncnorm

from wpt_agents.model.distributions import (
    BINS,
    TruncatedNormal,
    kl_one_hot,
    mode_one_hot,
    sample_one_hot,
    symexp,
    symlog,
    two_hot,
    two_hot_loss,
    two_hot_mean,
    unimix_logits,
)

ALL = torch.tensor([True])
# mean, std: centred, to the side, saturated at either end, narrow and wide
NORMALS = [(0.0, 1.0), (0.3, 0.5), (-0.9, 0.2), (1.0, 0.1), (-1.0, 1.0), (0.999, 0.35)]


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def normal(mean, std, mask=ALL):
    return TruncatedNormal(torch.tensor([mean]), torch.tensor([std]), mask)


def reference(mean, std):
    return truncnorm((-1 - mean) / std, (1 - mean) / std, loc=mean, scale=std)


def test_symlog_by_hand_and_back():
    # symlog(e - 1) = ln(e) = 1, symlog(-(e^2 - 1)) = -2
    x = torch.tensor([0.0, math.e - 1, -(math.e**2 - 1)])
    torch.testing.assert_close(symlog(x), torch.tensor([0.0, 1.0, -2.0]))
    torch.testing.assert_close(symexp(symlog(x)), x)


def test_two_hot_by_hand():
    # 5 bins over [-20, 20]: -20, -10, 0, 10, 20. symlog(e^4 - 1) = 4 lies 0.4 of the way to 10
    weights = two_hot(torch.tensor([math.exp(4) - 1, 0.0, -1e30, 1e30]), 5)
    rows = [[0, 0, 0.6, 0.4, 0], [0, 0, 1, 0, 0], [1, 0, 0, 0, 0], [0, 0, 0, 0, 1]]
    torch.testing.assert_close(weights, torch.tensor(rows).float(), atol=1e-6, rtol=0)


def test_two_hot_of_what_is_not_finite_is_nan_and_no_error():
    assert two_hot(torch.tensor([math.nan, 1.0]), 5).isnan().any(-1).tolist() == [True, False]


def test_two_hot_round_trip_over_a_million_either_way():
    size = torch.logspace(-4, 6, 500)
    x = torch.cat([-size, torch.zeros(1), size])
    weights = two_hot(x)
    assert ((weights > 0).sum(-1) <= 2).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(len(x)))
    torch.testing.assert_close(two_hot_mean(weights.log()), x, rtol=1e-4, atol=1e-5)


def test_bins_over_another_range_by_hand():
    # 5 bins over [-8, 8]: -8, -4, 0, 4, 8. symlog(e^3 - 1) = 3 lies 3/4 of the way from 0 to 4
    x = torch.tensor([math.exp(3) - 1, 1e30])
    weights = two_hot(x, 5, 8.0)
    expected = torch.tensor([[0, 0, 0.25, 0.75, 0], [0, 0, 0, 0, 1.0]])
    torch.testing.assert_close(weights, expected, atol=1e-6, rtol=0)
    clipped = torch.tensor([math.exp(3) - 1, math.exp(8) - 1])
    torch.testing.assert_close(two_hot_mean(weights.log(), 8.0), clipped)
    # -(1/4 ln 1/5 + 3/4 ln 1/5) of even logits, whatever the range
    even = torch.zeros(2, 5)
    torch.testing.assert_close(two_hot_loss(even, x, 8.0), torch.full((2,), math.log(5)))


def test_two_hot_mean_is_the_symexp_of_the_mean_bin():
    # Half on -20 + 130 * 40 / 254, half on -20 + 140 * 40 / 254: symexp of bin 135's place
    logits = torch.full((BINS,), -1e9)
    logits[[130, 140]] = 7.0
    expected = math.expm1(-20 + 135 * 40 / 254)
    torch.testing.assert_close(two_hot_mean(logits), torch.tensor(expected))


def test_two_hot_loss_is_the_cross_entropy():
    # 3 bins -20, 0, 20; symlog(e^5 - 1) = 5: weights 0, 3/4, 1/4.
    # logits 0, ln 2, ln 5: p = 1/8, 2/8, 5/8, so loss = -(3/4 ln 1/4 + 1/4 ln 5/8)
    logits = torch.tensor([[0.0, math.log(2), math.log(5)]])
    expected = -(0.75 * math.log(1 / 4) + 0.25 * math.log(5 / 8))
    loss = two_hot_loss(logits, torch.tensor([math.exp(5) - 1]))
    torch.testing.assert_close(loss, torch.tensor([expected]))


def test_unimix_by_hand():
    # softmax(ln 1, ln 3) = 1/4, 3/4; with a fifth of the uniform: .8 / 4 + .1 = .3 and .7
    logits = torch.tensor([0.0, math.log(3)])
    torch.testing.assert_close(unimix_logits(logits, 0.2).exp(), torch.tensor([0.3, 0.7]))


def test_with_unimix_no_class_is_impossible_and_the_kl_stays_finite():
    logits = torch.tensor([[1e4, 0, 0, 0], [0, 1e4, 0, 0]]).requires_grad_()
    sure, other = unimix_logits(logits).unbind()
    assert sure.exp().min() >= 0.01 / 4 - 1e-7
    torch.testing.assert_close(sure.exp().sum(), torch.tensor(1.0))
    kl = kl_one_hot(sure[None], other[None])
    # .9925 (ln .9925 - ln .0025) + .0025 (ln .0025 - ln .9925) = .99 ln 397
    torch.testing.assert_close(kl, torch.tensor(0.99 * math.log(397)))
    kl.backward()
    assert torch.isfinite(logits.grad).all()


def test_one_hot_samples_have_the_probabilities():
    probs = torch.tensor([0.5, 0.3, 0.15, 0.05])
    n = 40_000
    samples = sample_one_hot(probs.log().expand(n, 4), seeded())
    assert ((samples == 0) | (samples == 1)).all() and (samples.sum(-1) == 1).all()
    # Chi-square with 3 degrees of freedom exceeds 16.3 once in a thousand
    assert ((samples.sum(0) - n * probs) ** 2 / (n * probs)).sum() < 16.3


def test_groups_are_sampled_independently_and_by_the_generator():
    logits = torch.full((20_000, 2, 3), 1 / 3).log()
    one, two = (sample_one_hot(logits, seeded(3)) for _ in range(2))
    assert torch.equal(one, two)
    joint = torch.einsum("nj,nk->jk", one[:, 0], one[:, 1]) / 20_000
    torch.testing.assert_close(joint, torch.full((3, 3), 1 / 9), atol=0.01, rtol=0)


@pytest.mark.parametrize("draw", [lambda x: sample_one_hot(x, seeded()), mode_one_hot])
def test_straight_through_gradient_is_that_of_the_probabilities(draw):
    logits = torch.randn(5, 3, 4, generator=seeded(), requires_grad=True)
    weight = torch.randn(5, 3, 4, generator=seeded(1))
    (draw(unimix_logits(logits)) * weight).sum().backward()
    # d/dx_j sum_k w_k (.99 p_k + c) = .99 p_j (w_j - sum_k w_k p_k), the softmax's Jacobian
    probs = logits.detach().softmax(-1)
    expected = 0.99 * probs * (weight - (weight * probs).sum(-1, keepdim=True))
    torch.testing.assert_close(logits.grad, expected)


def test_the_mode_is_the_likeliest_class():
    assert mode_one_hot(torch.tensor([[0.2, 0.7, 0.1]]).log()).tolist() == [[0, 1, 0]]


def test_kl_by_hand():
    # group 1: .5 ln(.5 / .25) + .5 ln(.5 / .75) = .5 ln(4 / 3); group 2: equal, 0
    left = torch.tensor([[0.5, 0.5], [0.9, 0.1]]).log()
    right = torch.tensor([[0.25, 0.75], [0.9, 0.1]]).log()
    torch.testing.assert_close(kl_one_hot(left, right), torch.tensor(0.5 * math.log(4 / 3)))


@pytest.mark.parametrize(("mean", "std"), NORMALS)
def test_log_prob_and_entropy_are_scipys(mean, std):
    ours, scipys = normal(mean, std), reference(mean, std)
    x = torch.linspace(-1, 1, 21)
    torch.testing.assert_close(
        ours.log_prob(x[:, None]).double(), torch.tensor(scipys.logpdf(x)), rtol=1e-4, atol=1e-4
    )
    assert ours.entropy().item() == pytest.approx(scipys.entropy(), abs=1e-4)


@pytest.mark.parametrize(("mean", "std"), NORMALS)
def test_action_samples_follow_the_truncated_normal(mean, std):
    n, scipys = 20_000, reference(mean, std)
    dist = TruncatedNormal(torch.full((n, 1), mean), torch.full((n, 1), std), ALL)
    x = np.sort(dist.rsample(seeded()).numpy()[:, 0])
    assert np.abs(x).max() <= 1
    # Kolmogorov-Smirnov: sqrt(n) D exceeds 1.95 once in a thousand
    distance = np.abs(scipys.cdf(x) - (np.arange(n) + 0.5) / n).max() + 0.5 / n
    assert np.sqrt(n) * distance < 1.95


@pytest.mark.parametrize(("mean", "std"), [(0.0, 1.0), (0.3, 0.5), (-0.8, 0.3)])
def test_rsample_gradient_is_the_finite_difference(mean, std):
    at = torch.tensor([mean, std], requires_grad=True)

    def sample(x):  # the same uniform numbers each time
        ones = torch.ones(200)
        return TruncatedNormal(x[0] * ones, x[1] * ones, ALL).rsample(seeded()).sum()

    sample(at).backward()
    for i, slope in enumerate(at.grad):
        step = torch.zeros(2)
        step[i] = 1e-3
        rise = sample(at.detach() + step) - sample(at.detach() - step)
        assert slope.item() == pytest.approx(rise.item() / 2e-3, rel=0.01)


def test_entropy_gradient_is_finite_where_the_mean_is_saturated():
    mean = torch.tensor([1.0, -1.0], requires_grad=True)
    std = torch.tensor([0.1, 0.1], requires_grad=True)
    dist = TruncatedNormal(mean, std, torch.tensor([True, True]))
    (dist.entropy() + dist.rsample(seeded()).sum()).backward()
    assert torch.isfinite(mean.grad).all() and torch.isfinite(std.grad).all()


def test_padded_entries_are_zero_and_count_nothing():
    mask = torch.tensor([True, False])
    mean, std = torch.tensor([[0.2, 0.9]]), torch.tensor([[0.5, 0.1]])
    padded, alone = TruncatedNormal(mean, std, mask), normal(0.2, 0.5)
    assert padded.rsample(seeded())[0, 1] == padded.mode[0, 1] == 0
    torch.testing.assert_close(
        padded.log_prob(torch.tensor([[0.1, 7.0]]))[0], alone.log_prob(torch.tensor([0.1]))
    )
    torch.testing.assert_close(padded.entropy()[0], alone.entropy())


def test_padded_entries_get_no_gradient():
    mean = torch.tensor([0.2, 0.9], requires_grad=True)
    std = torch.tensor([0.5, 0.1], requires_grad=True)
    dist = TruncatedNormal(mean, std, torch.tensor([True, False]))
    sample = dist.rsample(seeded())
    (sample.sum() + dist.log_prob(sample) + dist.entropy()).backward()
    assert mean.grad[0] != 0 and std.grad[0] != 0
    assert mean.grad[1] == std.grad[1] == 0
