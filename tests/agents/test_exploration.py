"""Curiosity: the losses by hand, surprise where nothing was seen, and agents that go on exactly."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, noise, recorded, same, weights
from torch import Generator
from toy_env import DotEnv

from wpt_agents.agents.curious import (
    EXPLORE,
    EXPLORERS,
    ICM,
    Ensemble,
    ICMExplorer,
    Plan2Explore,
    Scale,
    disagreement,
    ensemble_loss,
    forward_error,
    icm_loss,
    with_reward,
)
from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import led_to, stack_windows
from wpt_agents.model.rssm import Latent
from wpt_agents.model.sizes import SIZES

QUICK = {k: v for k, v in SETTINGS.items() if k in {**EXPLORE, "imagine_horizon": 0, "device": 0}}
QUICK |= {"offline_ratio": 0.0, "guidance": 0.0, "max_action_dim": 3, "device": "cpu"}


def explorer(kind, seed=0, **changes):
    return kind("WPTPolicy", DotEnv(), seed=seed, **{**QUICK, **changes})


def batch_of(*trajectories, width=3):
    return stack_windows([led_to(t, 0, len(t) + 1, width) for t in trajectories])


def generator():
    return Generator().manual_seed(0)


# The losses by hand


def test_the_forward_error_by_hand():
    # 1/2 ((1 - 0)^2 + (2 - 0)^2) = 2.5
    assert forward_error(torch.tensor([[1.0, 2.0]]), torch.zeros(1, 2)).tolist() == [2.5]


def test_icms_loss_by_hand_leaves_out_what_crosses_an_episodes_edge():
    read, action = torch.tensor([[1.0, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.0], [9.0, 9.0]])
    surprise, within = torch.tensor([2.0, 100.0]), torch.tensor([True, False])
    # (1 - 0.2) * (1^2 + 0^2) + 0.2 * 2 = 1.2; the second pair is of two episodes
    assert icm_loss(read, action, surprise, within, 0.2).item() == pytest.approx(1.2)
    assert icm_loss(read, action, surprise, torch.tensor([True, True]), 0.2).item() == (
        pytest.approx((1.2 + 0.8 * 162 + 0.2 * 100) / 2)
    )


def test_disagreement_by_hand_is_the_members_variance():
    prediction = torch.tensor([[[0.0, 4.0]], [[2.0, 4.0]]])  # 2 members, 1 state, 2 outputs
    # the variance of 0 and 2 is 1, that of 4 and 4 is 0, their mean 0.5
    assert disagreement(prediction).tolist() == [0.5]


def test_the_ensembles_loss_by_hand():
    prediction, target = torch.tensor([[[1.0, 3.0], [7.0, 7.0]]] * 2), torch.zeros(2, 2)
    # (1 + 9) / 2 = 5 for each of two members; the second state does not count
    assert ensemble_loss(prediction, target, torch.tensor([True, False])).item() == 5
    target.requires_grad_(True)
    prediction.requires_grad_(True)
    ensemble_loss(prediction, target, torch.tensor([True, True])).backward()
    assert target.grad is None and prediction.grad is not None


def test_rewards_are_scaled_by_the_running_mean_of_surprise():
    scale = Scale(keep=0.5)
    scale.see(torch.tensor([2.0, 6.0]))
    assert scale(torch.tensor(8.0)).item() == pytest.approx(2)  # the first mean is 4
    scale.see(torch.tensor([1.0]))
    # means 4 and 1 weigh 0.25 and 0.5: (0.25 * 4 + 0.5 * 1) / 0.75 = 2
    assert scale(torch.tensor(8.0)).item() == pytest.approx(4)


def test_curiosity_is_the_reward_of_images_that_follow_another_by_hand():
    batch = batch_of(recorded(length=3))
    within = torch.tensor([[True, False, True]])
    rewarded = with_reward(batch, torch.tensor([[5.0, 6.0, 7.0]]), within)
    assert rewarded.reward.tolist() == [[0, 5, 0, 7]]
    assert rewarded.reward_known.tolist() == [[False, True, False, True]]


# Surprise falls where data are


def ring(images, states, actions):
    """A walk among `images`, each action +1 or -1: (1, T, 64, 64, 3) and (1, T, 1)."""
    assert len(states) == len(actions) + 1
    action = torch.tensor([0.0, *actions]).view(1, -1, 1)
    return images[torch.tensor(states)][None], action


def walks():
    """Six pictures: steps between 0, 1 and 2 are seen, those between 3, 4 and 5 are not."""
    images = torch.from_numpy(noise(6, seed=3))
    seen = ring(images, [0, 1, 2, 1, 0, 1, 2, 1, 0], [1, 1, -1, -1, 1, 1, -1, -1])
    unseen = ring(images, [3, 4, 5, 4, 3, 4, 5, 4, 3], [1, 1, -1, -1, 1, 1, -1, -1])
    return seen, unseen


def test_icm_is_surprised_where_it_has_not_been_and_learns_what_was_done():
    torch.manual_seed(0)
    icm, (seen, unseen) = ICM(SIZES["debug"], 1), walks()
    optimizer = torch.optim.Adam(icm.parameters(), 3e-3)
    before = icm(*seen)[1].mean().item()
    for _ in range(100):
        read, surprise = icm(*seen)
        loss = icm_loss(read, seen[1][:, 1:], surprise, torch.ones_like(surprise, dtype=bool))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    read, surprise = icm(*seen)
    assert (read - seen[1][:, 1:]).abs().max() < 0.3  # which way it went is in the features
    assert surprise.mean() < 0.3 * before
    assert surprise.mean() < 0.2 * icm(*unseen)[1].mean()


def test_an_ensemble_agrees_where_it_has_been_and_disagrees_elsewhere():
    torch.manual_seed(0)
    size = SIZES["debug"]
    width = size.deter + size.stoch * size.classes
    ensemble, feat = Ensemble(size, 1, 8), torch.randn(20, width)
    target, action = torch.randn(20, 8), torch.zeros(20, 1)
    optimizer = torch.optim.Adam(ensemble.parameters(), 3e-3)
    for _ in range(150):
        loss = ensemble_loss(ensemble(feat[:10], action[:10]), target[:10], torch.ones(10))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    surprise = disagreement(ensemble(feat, action))
    assert surprise[:10].mean() < 0.1 * surprise[10:].mean()


# The agents


def test_no_gradient_of_the_ensemble_reaches_the_world_model():
    """One update of Plan2Explore leaves the world model as one of WPT does."""
    batch, outcomes = batch_of(recorded(8), recorded(8, seed=1)), []
    for kind in (WPT, Plan2Explore):
        model = explorer(kind)
        before = weights(model, "world_model.")
        if kind is Plan2Explore:
            model.policy.load_state_dict({**weights(model), **outcomes[0][0]})
        model.learner.update_world_model(batch, generator())
        outcomes.append((before, weights(model, "world_model.")))
    assert same(outcomes[0][1], outcomes[1][1])
    assert not same(*outcomes[0])


def test_the_imagined_reward_is_paid_for_the_step_before_and_teaches_the_actor_only():
    model = explorer(Plan2Explore)
    state = model.policy.world_model.rssm.initial(5)
    dream = model.policy.dream(Latent(*state), 4, generator())
    ensemble = model.policy.curiosity
    ensemble.scale.see(torch.tensor(1.0))
    reward = model.learner.worth(dream, torch.arange(5.0)).reward
    assert reward.shape == (5, 4) and (reward[:, 1:] > 0).all()
    assert reward[:, 0].tolist() == [0, 1, 2, 3, 4]
    step = disagreement(ensemble(dream.states.feat[:, 1], dream.action[:, 1]))
    torch.testing.assert_close(reward[:, 2], step)
    reward.sum().backward()
    assert all(p.grad is None for p in ensemble.parameters())
    assert all(p.grad is None for p in model.policy.world_model.parameters())
    assert all(p.grad.abs().sum() > 0 for p in model.policy.actor.layers[-1].parameters())


def test_a_replayed_state_is_paid_for_the_real_step_that_led_to_it():
    model = explorer(Plan2Explore, imagine_starts=0)
    batch = batch_of(recorded(8), recorded(8, seed=1))
    batch.is_first[0, 4] = True  # an episode's edge
    ensemble = copy.deepcopy(model.policy.curiosity)  # a copy from before the update
    post, paid_batch, _ = model.learner.update_world_model(batch, generator())
    _, worth = model.learner.dream(post, paid_batch, generator(), 0, False)
    paid = worth.reward[:, 0].view(2, 9)
    surprise = disagreement(ensemble(post.feat[:, :-1], batch.action[:, 1:]))
    within = ~batch.is_first[:, 1:]
    expected = surprise * within / surprise[within].mean()  # the first mean counts in full
    torch.testing.assert_close(paid[:, 1:], expected)
    assert (paid[:, 0] == 0).all() and paid[0, 4] == 0 and (paid[0, 5:] > 0).all()


@pytest.mark.parametrize("kind", EXPLORERS.values())
def test_the_tasks_reward_teaches_nothing(kind):
    batch, outcomes = batch_of(recorded(8), recorded(8, seed=1)), []
    for reward in (0.0, 1000.0):
        model = explorer(kind, repval_scale=1.0)
        paid = replace(
            batch,
            reward=torch.full_like(batch.reward, reward),
            reward_known=torch.ones_like(batch.is_first),
        )
        metrics = model.learner.update(paid, generator())
        assert metrics["explore/surprise"] > 0 and metrics["train/replay_value_loss"] > 0
        outcomes.append(weights(model))
    assert same(*outcomes)


def test_icms_reward_head_learns_the_scaled_surprise_of_each_step():
    model, seen = explorer(ICMExplorer), []
    batch = batch_of(recorded(8), recorded(8, seed=1))
    batch.is_first[0, 4] = True  # an episode's edge
    with torch.no_grad():
        surprise = model.policy.curiosity(batch.image, batch.action)[1]
    model.policy.world_model.observe = lambda taught, _: seen.append(taught) or stop()
    with pytest.raises(StopIteration):
        model.learner.update_world_model(batch, generator(), learn_reward=True)
    [taught] = seen
    within = ~batch.is_first[:, 1:]
    assert (taught.reward_known[:, 1:] == within).all() and not taught.reward_known[:, 0].any()
    expected = surprise / surprise[within].mean() * within  # 0 where it is unknown
    torch.testing.assert_close(taught.reward[:, 1:], expected)
    assert batch.reward.abs().sum() == 0  # the caller's batch is unchanged


def stop():
    raise StopIteration


@pytest.mark.parametrize("kind", EXPLORERS.values())
def test_an_explorer_learns_and_another_seed_plays_otherwise(kind):
    one, other = explorer(kind), explorer(kind, seed=1)
    before = weights(one, "actor.", "curiosity.")
    played = list(one.explore(3))
    assert [len(t) for t in played] == [25, 25, 25] and one.updates > 0
    after = weights(one, "actor.", "curiosity.")
    assert all((before[k] != after[k]).any() for k in ("actor.layers.0.0.weight",))
    assert any((before[k] != after[k]).any() for k in before if k.startswith("curiosity."))
    assert not np.array_equal(played[0].action, next(other.explore(1)).action)


def test_two_environments_are_too_many_to_explore():
    agent = explorer(ICMExplorer)
    agent.set_env([DotEnv(), DotEnv()])
    with pytest.raises(ValueError, match="takes one environment, got 2"):
        next(agent.explore(1))


def test_exploring_never_goes_on_with_an_episode_that_learn_left():
    agent = explorer(ICMExplorer)
    agent.learn(30)  # an episode of 25 steps, and 5 of the next
    for played in agent.explore(3):
        assert len(played) == 25


@pytest.mark.parametrize("kind", EXPLORERS.values())
def test_an_explorers_policy_acts_from_a_file_of_its_own(kind, tmp_path):
    model = explorer(kind)
    model.policy.save(tmp_path / "policy")
    loaded = type(model.policy).load(tmp_path / "policy")
    obs = np.full((3, 64, 64, 3), 90, np.uint8)
    actions = [policy.predict(obs, deterministic=True)[0] for policy in (model.policy, loaded)]
    np.testing.assert_array_equal(*actions)


def test_an_explorers_file_is_read_by_its_own_class(tmp_path):
    explorer(ICMExplorer).save(tmp_path / "curious.zip")
    for other in (WPT, Plan2Explore):
        with pytest.raises(ValueError, match=r"is of ICMExplorer: read it with ICMExplorer\.load"):
            other.load(tmp_path / "curious.zip")


@pytest.mark.parametrize("kind", EXPLORERS.values())
def test_a_loaded_explorer_goes_on_as_if_it_had_never_stopped(kind, tmp_path):
    whole = list(explorer(kind).explore(4))
    first = explorer(kind)
    played = list(first.explore(2))
    first.save(tmp_path / "explorer.zip")
    second = kind.load(tmp_path / "explorer.zip", env=DotEnv())
    for trajectory in played:
        second.replay_buffer.add(trajectory)
    played += list(second.explore(4))
    for one, other in zip(whole, played, strict=True):
        np.testing.assert_array_equal(one.action, other.action)
        np.testing.assert_array_equal(one.image, other.image)
