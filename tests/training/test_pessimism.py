"""Several reward heads: dreams are paid their mean minus what they disagree by."""

from collections import defaultdict

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, agent, recorded, same, weights

from wpt_agents.agents.wpt import WPT
from wpt_agents.model.distributions import two_hot_mean
from wpt_agents.model.world_model import pessimistic_reward

MEMBERS = "world_model.reward_members"


def filled(**changes):
    """An agent with something to learn from."""
    model = agent(**changes)
    model.replay_buffer.add(recorded(reward=np.arange(8, dtype=np.float32)))
    return model


def updated(model, times=1):
    metrics = defaultdict(list)
    for _ in range(times):
        model.update(metrics)
    return metrics


def test_the_pessimistic_reward_by_hand():
    # the mean of 1, 2 and 6 is 3, and the variance (4 + 1 + 9) / 3
    rewards = torch.tensor([[1.0, 2.0, 6.0], [5.0, 5.0, 5.0]])
    deviation = (14 / 3) ** 0.5
    expected = torch.tensor([3 - 0.5 * deviation, 5.0])
    torch.testing.assert_close(pessimistic_reward(rewards, 0.5), expected)
    assert pessimistic_reward(rewards, 0.0).tolist() == [3.0, 5.0]


def test_its_gradient_by_hand_and_where_all_agree():
    rewards = torch.tensor([[1.0, 2.0, 6.0], [5.0, 5.0, 5.0]], requires_grad=True)
    pessimistic_reward(rewards, 0.5).sum().backward()
    # d/dr_i (μ - β σ) = 1/3 - β (r_i - μ) / (3 σ), and 1/3 where σ is 0
    deviation = (14 / 3) ** 0.5
    slopes = [1 / 3 - 0.5 * (r - 3) / (3 * deviation) for r in (1, 2, 6)]
    torch.testing.assert_close(rewards.grad, torch.tensor([slopes, [1 / 3] * 3]))


def test_by_default_there_is_one_head_and_further_ones_change_no_other_number():
    one, three = filled(), filled(reward_ensemble=3)
    assert same(weights(one), weights(three))  # until the first update
    losses = [updated(model) for model in (one, three)]
    assert not [name for name in weights(one) if name.startswith(MEMBERS)]
    assert len(three.policy.world_model.reward_members) == 2
    for name in ("train/reconstruction_loss", "train/reward_loss"):
        assert losses[0][name] == losses[1][name]
    alike = weights(one, "world_model.encoder", "world_model.rssm", "world_model.reward_head")
    assert all(torch.equal(weight, weights(three)[name]) for name, weight in alike.items())


def test_all_heads_learn_the_rewards_and_the_mean_is_predicted():
    model = filled(reward_ensemble=3, learning_rate=1e-2)
    metrics = updated(model, 60)
    world_model = model.policy.world_model
    feat = torch.randn(5, 64 + 64)
    heads = [world_model.reward_head, *world_model.reward_members]
    predictions = torch.stack([two_hot_mean(head(feat)) for head in heads])
    torch.testing.assert_close(world_model.reward(feat), predictions.mean(0))
    assert predictions.std(0).min() > 0  # three different heads
    assert metrics["train/reward_disagreement"][-1] > 0
    before = [p.detach().clone() for p in world_model.reward_members.parameters()]
    model.update(metrics)
    assert not any(map(torch.equal, before, world_model.reward_members.parameters()))


def test_dreams_are_paid_by_the_schedule_of_the_pessimism():
    model = filled(reward_ensemble=3, pessimism="linear(2,0,100)")
    updated(model, 3)
    policy, learner = model.policy, model.learner
    start = policy.world_model.rssm.initial(6)
    dream = policy.dream(start, 3, torch.Generator().manual_seed(0))
    rewards = policy.world_model.rewards(dream.states.but_last().feat)
    for step, beta in ((0, 2.0), (50, 1.0), (100, 0.0)):
        paid = learner.worth(dream, torch.zeros(6), step).reward
        expected = rewards.mean(-1) - beta * rewards.std(-1, correction=0)
        torch.testing.assert_close(paid, expected, rtol=1e-4, atol=1e-5)


def test_the_pessimism_reaches_the_actor_through_the_deviation():
    gradients = []
    for pessimism in (0.0, 5.0):
        model = filled(reward_ensemble=3, pessimism=pessimism)
        model.fit_reward_ensemble()
        for head in model.policy.world_model.heads:  # which would start at zero
            torch.nn.init.normal_(head.layers[-1].weight, generator=torch.Generator())
        start = model.policy.world_model.rssm.initial(6)
        generator = torch.Generator().manual_seed(0)
        dream = model.policy.dream(start, 3, generator)
        model.learner.worth(dream, torch.zeros(6)).reward.sum().backward()
        gradients.append([p.grad for p in model.policy.actor.parameters() if p.grad is not None])
        assert not [p for p in model.policy.world_model.parameters() if p.grad is not None]
    assert gradients[0] and not all(map(torch.allclose, *gradients))


def test_a_saved_ensemble_learns_on_exactly_and_a_model_without_takes_one_up(tmp_path):
    model = filled(reward_ensemble=3, pessimism=1.0)
    updated(model, 2)
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model")
    loaded.replay_buffer = model.replay_buffer
    assert same(weights(model), weights(loaded))
    for one in (model, loaded):
        updated(one)
    assert same(weights(model), weights(loaded))
    filled().save(tmp_path / "without")
    later = WPT.load(tmp_path / "without", reward_ensemble=2)
    later.replay_buffer = model.replay_buffer
    updated(later)
    assert len(later.policy.world_model.reward_members) == 1
    loaded.reset_task()
    assert not loaded.policy.world_model.reward_members and loaded.learner.members_optimizer is None


def test_a_task_that_ends_has_an_ensemble_and_a_continue_head(tmp_path):
    model = agent(ClockEnv(terminates=True), reward_ensemble=2).learn(35)
    model.save(tmp_path / "model")
    assert same(weights(model), weights(WPT.load(tmp_path / "model")))
    assert len(model.policy.world_model.heads) == 3


def test_pessimism_wants_several_heads():
    with pytest.raises(ValueError, match=r"pessimism='linear\(1,0,10\)'.*reward_ensemble=3"):
        agent(pessimism="linear(1,0,10)")
