import math

import pytest
import torch

from wpt_agents.model.actor_critic import lambda_return
from wpt_agents.model.distributions import two_hot_loss
from wpt_agents.model.dreamer_v3 import (
    advantage,
    continue_loss,
    reinforce_loss,
    replay_return,
    replay_value_loss,
)


def bools(*rows):
    return torch.tensor(rows, dtype=torch.bool)


def test_the_advantage_by_hand():
    reward, value = torch.tensor([[1.0, 2.0]]), torch.tensor([[9.0, 3.0, 4.0]])
    returns = lambda_return(reward, value, 0.5, 0.5)  # V_1 = 4, see test_lambda_return_by_hand
    # the action at step 0 leads to V_1: A_0 = r_0 + .5 V_1 - v_0 = 1 + 2 - 9
    assert advantage(reward, value, returns, 0.5).tolist() == [[-6.0]]
    # where the episode ends at step 1 with probability .5, it is worth half: 1 + .25 * 4 - 9
    discount = torch.full((1, 2), 0.25)
    assert advantage(reward, value, returns, discount).tolist() == [[-7.0]]


def test_an_exact_critic_leaves_no_advantage():
    reward = torch.tensor([[1.0, 2.0, 3.0]])
    value = torch.tensor([[1 + 0.9 * (2 + 0.9 * (3 + 0.9 * 5)), 2 + 0.9 * (3 + 4.5), 3 + 4.5, 5.0]])
    value[0, 1] = 2 + 0.9 * (3 + 0.9 * 5)
    value[0, 2] = 3 + 0.9 * 5
    returns = lambda_return(reward, value, 0.9, 0.95)
    torch.testing.assert_close(advantage(reward, value, returns, 0.9), torch.zeros(1, 2))


def test_reinforce_by_hand():
    # -(1 * (-.5 * 4/2 + .1 * 3) + .5 * (-2 * -2/2 + .1 * 1)) / 2 = -(-.7 + 1.05) / 2
    loss = reinforce_loss(
        torch.tensor([[-0.5, -2.0]]),
        torch.tensor([[4.0, -2.0]]),
        torch.tensor([[3.0, 1.0]]),
        torch.tensor([1.0, 0.5]),
        ent_coef=0.1,
        return_scale=2.0,
    )
    assert loss.item() == pytest.approx(-0.175)


def test_reinforce_raises_the_probability_of_what_was_better_than_expected():
    log_prob = torch.zeros(1, 2, requires_grad=True)
    better = torch.tensor([[1.0, -1.0]])
    reinforce_loss(log_prob, better, torch.zeros(1, 2), torch.ones(2)).backward()
    assert log_prob.grad[0, 0] < 0 < log_prob.grad[0, 1]  # descent goes the other way


def test_replayed_returns_by_hand():
    reward, bootstrap = torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[7.0, 5.0, 4.0]])
    no = bools([False, False, False])
    # V_2 = b_2 = 4; V_1 = 2 + .5 (.5 * 4 + .5 * 4) = 4; V_0 = 1 + .5 (.5 * 5 + .5 * 4) = 3.25
    expected = torch.tensor([[3.25, 4.0, 4.0]])
    torch.testing.assert_close(replay_return(reward, bootstrap, no, no, 0.5, 0.5), expected)
    # an episode that is cut at step 1 is worth its bootstrap: V_1 = 5, V_0 = 1 + .5 * 5
    cut = bools([False, True, False])
    expected = torch.tensor([[3.5, 5.0, 4.0]])
    torch.testing.assert_close(replay_return(reward, bootstrap, cut, no, 0.5, 0.5), expected)
    # one that terminates there its reward: V_1 = v_1 = 2, V_0 = 1 + .5 (.5 * 2 + .5 * 2)
    expected = torch.tensor([[2.0, 2.0, 4.0]])
    torch.testing.assert_close(replay_return(reward, bootstrap, cut, cut, 0.5, 0.5), expected)
    end = bools([False, False, True])
    assert replay_return(reward, bootstrap, end, end)[0, 2] == 3


def test_the_replay_value_loss_counts_known_rewards_only():
    logits = torch.randn(1, 2, 255, generator=torch.Generator().manual_seed(0))
    returns, known = torch.tensor([[3.0, -8.0]]), bools([True, False])
    expected = two_hot_loss(logits, returns)[0, 0]
    torch.testing.assert_close(replay_value_loss(logits, returns, known), expected)
    assert replay_value_loss(logits, returns, bools([False, False])) == 0


def test_the_continue_loss_by_hand():
    # p(go on) = .8 at all three, the last of which belongs to another task: -(ln .8 + ln .2) / 2
    logits = torch.full((1, 3), math.log(4.0), requires_grad=True)
    loss = continue_loss(logits, bools([False, True, True]), bools([True, True, False]))
    assert loss.item() == pytest.approx(-(math.log(0.8) + math.log(0.2)) / 2)
    loss.backward()
    # the slope of -ln sigmoid(x) is sigmoid(x) - 1, that of -ln(1 - sigmoid(x)) is sigmoid(x)
    torch.testing.assert_close(logits.grad, torch.tensor([[-0.1, 0.4, 0.0]]))
