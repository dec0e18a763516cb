"""The reward loss may train the states, too, by a weight."""

from collections import defaultdict

import numpy as np
import pytest
import torch
from debug_agent import agent, recorded, same, weights

from wpt_agents.model.layers import scale_gradient

STATES = "world_model.encoder", "world_model.rssm", "world_model.decoder"


def updated(rewards, **changes):
    """An agent after two updates on an episode of these rewards.

    The reward head starts at zero, so that only from the second update on can it move the states.
    """
    model = agent(**changes)
    model.replay_buffer.add(recorded(reward=np.asarray(rewards, np.float32)))
    metrics = defaultdict(list)
    for _ in range(2):
        model.update(metrics)
    return model, metrics


@pytest.mark.parametrize("weight", [0.0, 0.5, 1.0, 3.0])
def test_the_gradient_is_scaled_and_the_value_is_not(weight):
    x = torch.tensor([1.0, -2.0], requires_grad=True)
    assert torch.equal(scale_gradient(x, weight), x)
    (scale_gradient(x, weight) * torch.tensor([5.0, 7.0]) + 0 * x).sum().backward()
    assert x.grad.tolist() == [5 * weight, 7 * weight]


def test_states_are_learnt_from_rewards_only_if_reward_grad_says_so():
    small, large = np.zeros(8), np.arange(8)
    one, two = updated(small)[0], updated(large)[0]
    assert same(weights(one, *STATES), weights(two, *STATES))
    head = "world_model.reward_head"
    assert not same(weights(one, head), weights(two, head))
    for weight in (0.5, 1.0):
        one, two = (updated(rewards, reward_grad=weight)[0] for rewards in (small, large))
        for part in STATES[:2]:
            assert not same(weights(one, part), weights(two, part))
