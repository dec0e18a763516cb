"""MR.Q's networks and losses, by hand."""

import math

import pytest
import torch
import torch.nn.functional as F

from wpt_agents.data.transitions import Steps
from wpt_agents.model.mrq import (
    BINS,
    ModelEncoder,
    NormedMLP,
    StateEncoder,
    ValuePair,
    actor_loss,
    encoder_loss,
    noisy,
    normed,
    reward_bins,
    reward_two_hot,
    scaled_target,
    value_loss,
    xavier_relu,
)


def test_widths_are_the_published_ones_at_64_pixels():
    encoder = StateEncoder(32, 512)
    assert encoder.last.in_features == 800  # 64 > 31 > 15 > 7 > 5, 32 channels
    assert encoder(torch.zeros(2, 3, 64, 64, 3, dtype=torch.uint8)).shape == (2, 512)


def test_an_mlp_by_hand():
    network = NormedMLP(2, 2, 1, "relu")
    with torch.no_grad():
        for layer in network.layers:
            layer.weight.copy_(torch.eye(2))
            layer.bias.zero_()
        network.last.weight.fill_(2)
        network.last.bias.fill_(3)
    # (1, 3) is normalised to (-1, 1), relu (0, 1), normalised (-1, 1), relu (0, 1): 2 * 1 + 3
    torch.testing.assert_close(
        network(torch.tensor([[1.0, 3.0]])), torch.tensor([[5.0]]), atol=1e-4, rtol=0
    )


def test_the_layer_norm_has_no_weights():
    assert not [name for name, _ in ModelEncoder(2, 4, 4, 2).named_parameters() if "norm" in name]
    assert normed(torch.tensor([[2.0, 4.0]])).tolist()[0] == pytest.approx([-1, 1], abs=1e-4)


def test_initial_weights_are_xaviers_times_the_gain_of_relu():
    layer = torch.nn.Linear(100, 50)
    xavier_relu(layer)
    limit = math.sqrt(2) * math.sqrt(6 / 150)
    assert 0.95 * limit < layer.weight.abs().max() <= limit and (layer.bias == 0).all()


def test_two_values_of_shape_2_n():
    assert ValuePair(4, 8)(torch.randn(5, 4)).shape == (2, 5)


def test_rewards_as_two_hot_have_their_own_value_as_mean():
    rewards = torch.tensor([[-3.0, 0.0, 0.2], [1.0, 7.5, 900.0]])
    weights = reward_two_hot(rewards)
    assert weights.shape == (2, 3, BINS) and ((weights > 0).sum(-1) <= 2).all()
    torch.testing.assert_close(weights.sum(-1), torch.ones(2, 3))
    torch.testing.assert_close((weights * reward_bins()).sum(-1), rewards, rtol=1e-4, atol=1e-4)
    # the bins around 0.2: 0 and e^(20/64) - 1 = 0.36684
    upper = 0.2 / (math.exp(20 / 64) - 1)
    assert weights[0, 2, 33].item() == pytest.approx(upper, abs=1e-4)
    beyond = reward_two_hot(torch.tensor([1e9, -1e9]))
    assert beyond[0, -1] == 1 and beyond[1, 0] == 1


def test_the_scaled_target_by_hand():
    next_q = torch.tensor([[4.0, 9.0], [6.0, 1.0]])
    # (2 + 0.5 * 3 * 4) / 2 = 4;  (3 + 0) / 2 = 1.5
    target = scaled_target(torch.tensor([2.0, 3.0]), torch.tensor([0.5, 0.0]), next_q, 2.0, 3.0)
    assert target.tolist() == [4.0, 1.5]


def test_the_value_loss_by_hand():
    q, target = torch.tensor([[1.5, 5.0], [1.0, 2.0]]), torch.tensor([1.0, 1.0])
    # errors .5 4 | 0 1: Huber's losses .125 3.5 | 0 .5; the largest of a row, .5 and 4, weighs it
    expected = (1 * (0.125 + 0) + 4**0.4 * (3.5 + 0.5)) / 4 / ((1 + 4**0.4) / 2)
    assert value_loss(q, target).item() == pytest.approx(expected, rel=1e-5)


def test_the_value_loss_has_the_gradient_of_hubers_loss_on_prioritised_draws():
    error = torch.tensor([[0.3, -2.0, 5.0, 0.0], [0.1, 0.5, -9.0, 3.0]])
    q = error.clone().requires_grad_()
    value_loss(q, torch.zeros(4)).backward()
    priority = error.abs().amax(0).clamp_min(1) ** 0.4  # the larger error of both, at least 1
    huber = error.clamp(-1, 1)  # the gradient of Huber's loss
    # the mean over draws with probability priority / sum, in place of 1 / 4 each; two critics
    expected = priority / priority.sum() * huber / 2
    torch.testing.assert_close(q.grad, expected)


def test_the_actors_loss_by_hand():
    # -(1 + 2 + 3 + 0) / 4 + 0.1 * (9 + 1) / 2
    loss = actor_loss(torch.tensor([[1.0, 2.0], [3.0, 0.0]]), torch.tensor([[3.0], [1.0]]), 0.1)
    assert loss.item() == pytest.approx(-1.0)


def test_noise_is_clipped_and_actions_stay_in_their_bounds():
    moved = noisy(torch.zeros(1000, 1), 5.0, 0.3, None)
    assert moved.abs().max() == pytest.approx(0.3)
    assert noisy(torch.ones(1000, 1), 5.0, math.inf, None).abs().max() == 1


def steps_of(inside, end, n=4, horizon=3):
    generator = torch.Generator().manual_seed(0)
    image = torch.randint(0, 256, (n, 3, 64, 64, 3), generator=generator).byte()
    action = torch.rand(n, horizon, 2, generator=generator)
    reward = torch.randn(n, horizon, generator=generator)
    return Steps(
        image, action, reward, end, inside, image[:, None].expand(-1, horizon, -1, -1, -1, -1)
    )


def test_the_encoders_loss_is_the_sum_over_its_own_predictions():
    torch.manual_seed(0)
    encoder, target = ModelEncoder(2, 6, 8, 2), torch.randn(4, 3, 6)
    end = torch.zeros(4, 3)
    end[1, 1] = 1
    inside = torch.ones(4, 3)
    inside[1, 2] = 0  # behind the end
    batch = steps_of(inside, end)
    loss = encoder_loss(encoder, batch, target, (1.0, 0.1, 0.2))
    z, expected = encoder.state(batch.image), 0.0
    for h in range(3):
        z_sa = encoder.pair(torch.cat([z, F.elu(encoder.action(batch.action[:, h]))], 1))
        out = encoder.model(z_sa)
        z = out[:, 1:7]
        for n in range(4):
            if h == 2 and n == 1:
                continue
            log_p = out[n, 7:].log_softmax(0)
            cross = -(reward_two_hot(batch.reward[n, h]) * log_p).sum()
            missed = ((z[n] - target[n, h]) ** 2).mean()
            expected += (missed + 0.1 * cross + 0.2 * (out[n, 0] - end[n, h]) ** 2) / 4
    torch.testing.assert_close(loss, expected)
