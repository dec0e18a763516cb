"""RLPD's networks and losses, by hand."""

import math

import torch
import torch.nn.functional as F
from torch.distributions import Normal, TransformedDistribution
from torch.distributions.transforms import TanhTransform

from wpt_agents.agents.optimistic import optimistic_reward, reward_ensemble_loss
from wpt_agents.agents.rlpd import (
    actor_loss,
    critic_loss,
    td_target,
    temperature_loss,
)
from wpt_agents.model.ensembles import CriticEnsemble, RewardEnsemble
from wpt_agents.model.tanh_actor import TanhActor, tanh_sample


def test_a_critic_of_the_ensemble_equals_the_layers_written_out():
    critic = CriticEnsemble(10, 4, 8, 3, members=3)
    embed, action = torch.randn(5, 10), torch.randn(5, 3)
    q, k = critic(embed, action), 1
    first, norm, _, second, other, _, last = critic.layers
    x = torch.cat([critic.trunk(embed), action], -1)
    for layer, scale in ((first, norm), (second, other)):
        x = x @ layer.weight[k] + layer.bias[k]
        x = F.relu(F.layer_norm(x, (8,), scale.weight[k, 0], scale.bias[k, 0]))
    expected = (x @ last.weight[k] + last.bias[k]).squeeze(-1)
    torch.testing.assert_close(q[k], expected)
    assert q.shape == (3, 5) and not torch.allclose(q[0], q[1])


def test_log_prob_is_that_of_a_squashed_gaussian():
    mean, log_std = torch.tensor([[0.3, -1.0]]), torch.tensor([[-0.5, 0.2]])
    action, log_prob = tanh_sample(mean, log_std, torch.Generator().manual_seed(0))
    squashed = TransformedDistribution(Normal(mean, log_std.exp()), [TanhTransform()])
    torch.testing.assert_close(log_prob, squashed.log_prob(action).sum(-1), atol=1e-4, rtol=1e-4)


def test_log_prob_stays_finite_where_tanh_saturates():
    _, log_prob = tanh_sample(torch.full((1, 1), 40.0), torch.zeros(1, 1))
    # log(1 - tanh² 40) = 2 (log 2 - 40) up to rounding
    assert abs(log_prob.item() - 78) < 8


def test_the_log_std_is_bounded():
    actor = TanhActor(10, 4, 8, 2)
    actor.layers[-1].bias.data[2:] = torch.tensor([50.0, -50.0])
    _, log_std = actor(torch.zeros(1, 10))
    assert log_std.tolist() == [[2.0, -20.0]]


def test_td_target_by_hand():
    # 1 + 0.5 * 4 = 3 and 2 + 0 * 9 = 2
    reward, discount, next_q = (torch.tensor(x) for x in ([1.0, 2.0], [0.5, 0.0], [4.0, 9.0]))
    assert td_target(reward, discount, next_q).tolist() == [3.0, 2.0]


def test_critic_loss_by_hand():
    q, target = torch.tensor([[1.0, 2.0], [3.0, 5.0]]), torch.tensor([2.0, 4.0])
    # (1 + 4 + 1 + 1) / 4
    assert critic_loss(q, target).item() == 1.75


def test_actor_loss_by_hand():
    q, log_prob = torch.tensor([[1.0, 2.0], [3.0, 6.0]]), torch.tensor([-1.0, 2.0])
    # ((0.5 * -1 - 2) + (0.5 * 2 - 4)) / 2 = -2.75
    assert actor_loss(log_prob, q, 0.5).item() == -2.75


def test_the_temperature_falls_while_the_entropy_is_above_its_target():
    log_alpha = torch.tensor(math.log(0.1), requires_grad=True)
    loss = temperature_loss(log_alpha, torch.tensor([-3.0, -1.0]), target_entropy=-1.0)
    # 0.1 * (2 - (-1)) = 0.3, and d/d log α of it is the same
    torch.testing.assert_close(loss, torch.tensor(0.3))
    loss.backward()
    torch.testing.assert_close(log_alpha.grad, torch.tensor(0.3))


def test_optimistic_reward_by_hand():
    prediction = torch.tensor([[1.0, 2.0], [3.0, 2.0]])
    reward, bonus = optimistic_reward(prediction, 0.5)
    # mean 2, deviation 1: 2 + 0.5;  mean 2, deviation 0: 2
    assert reward.tolist() == [2.5, 2.0] and bonus.tolist() == [0.5, 0.0]


def test_a_member_learns_only_from_the_rows_that_it_is_shown():
    prediction = torch.zeros(2, 3, requires_grad=True)
    shown = torch.tensor([[True, False, True], [False, True, False]])
    loss = reward_ensemble_loss(prediction, torch.tensor([1.0, 2.0, 3.0]), shown)
    # (1 + 9 + 4) / 3
    torch.testing.assert_close(loss, torch.tensor(14 / 3))
    loss.backward()
    assert ((prediction.grad != 0) == shown).all()


def test_the_bonus_falls_on_repeated_data_and_stays_on_unseen_data():
    torch.manual_seed(0)
    ensemble = RewardEnsemble(8, 32, 5)
    seen, unseen = torch.randn(64, 8).tanh(), 3 * torch.randn(64, 8)
    reward = seen[:, 0]
    optimizer = torch.optim.Adam(ensemble.parameters(), 3e-3)

    def bonus(latent):
        return optimistic_reward(ensemble(latent), 1.0)[1].mean().item()

    before = bonus(seen)
    for _ in range(200):
        shown = torch.rand(5, 64) < 0.8
        loss = reward_ensemble_loss(ensemble(seen), reward, shown)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert bonus(seen) < 0.3 * before and bonus(unseen) > 3 * bonus(seen)
