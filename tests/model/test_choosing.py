"""IBRL: the actor's action or the clone's, by the value of where it leads."""

import numpy as np
import pytest
import torch
from debug_agent import agent, assert_goes_on_exactly, noise, pretrained, recorded
from toy_env import LENGTH, DotEnv

from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.model import choosing
from wpt_agents.model.choosing import choose_by_value, value_of_action
from wpt_agents.model.observations import stack_frames
from wpt_agents.model.prior_policy import prior_action
from wpt_agents.model.rssm import Latent
from wpt_agents.training.rollout import Rollout


@pytest.fixture(scope="module")
def data():
    return TrajectoryDataset.of([recorded(seed=seed, length=12) for seed in range(6)])


def cloned(data, **changes):
    return pretrained(data, env=DotEnv(), ibrl=True, **changes).learn(LENGTH)


def test_the_action_of_the_higher_value_is_taken_and_the_actors_where_they_are_equal():
    action, proposal = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[-1.0], [-2.0], [-3.0]])
    chosen = choose_by_value(
        action, proposal, torch.tensor([5.0, 5.0, 5.0]), torch.tensor([4.0, 6.0, 5.0])
    )
    assert chosen.tolist() == [[1.0], [-2.0], [3.0]]


def test_an_action_is_worth_the_value_of_the_most_likely_state_it_leads_to():
    policy = agent(zero_init_heads=False).policy
    rssm, critic = policy.world_model.rssm, policy.target_critic
    state = Latent(torch.randn(2, 64), torch.eye(8)[torch.randint(8, (2, 8))])
    action = torch.rand(2, 4)
    deter = rssm.step(state, action)
    stoch = torch.zeros(2, 8, 8).scatter_(-1, rssm.prior(deter).argmax(-1, keepdim=True), 1.0)
    expected = critic.value(Latent(deter, stoch).feat)
    torch.testing.assert_close(value_of_action(rssm, critic, state, action), expected)


@pytest.mark.parametrize("better", ["clone", "actor"])
def test_the_better_action_is_played_and_remembered(data, monkeypatch, better):
    policy = cloned(data).policy
    values = [torch.zeros(2), torch.full((2,), 1.0 if better == "clone" else -1.0)]
    order = iter(3 * values)  # of the actor's action, of the clone's
    monkeypatch.setattr(choosing, "value_of_action", lambda *_: next(order))
    state = frames = None
    for image in noise(3, 2):
        policy.ibrl = False
        actors, _ = policy.act(image, state, None, deterministic=True)
        policy.ibrl = True
        action, state = policy.act(image, state, None, deterministic=True)
        frames = stack_frames(image, frames, None)
        clones = prior_action(policy, frames)
        assert not np.allclose(actors, clones)
        np.testing.assert_allclose(action, clones if better == "clone" else actors, atol=1e-6)
        np.testing.assert_array_equal(state[-1], action)


def test_predicting_deterministically_twice_gives_the_same(data):
    model = cloned(data)
    played = []
    for _ in range(2):
        state, actions = None, []
        for image in noise(4, 1):
            action, state = model.predict(image, state, deterministic=True)
            actions.append(action)
        played.append(np.stack(actions))
        torch.rand(3)  # whatever else draws
    np.testing.assert_array_equal(*played)


def test_guided_steps_are_the_guides(data):
    model = cloned(data)
    seen = []

    def guide(frames):
        seen.append(frames.copy())
        return np.full((len(frames), 4), 0.25, np.float32)

    rollout = Rollout(model.policy, 2, 2, lambda: (0, 2), guide)
    for step, image in enumerate(noise(3, 2)):
        action = rollout.act(image)
        assert (action == 0.25).all() == (step < 2)
        np.testing.assert_array_equal(rollout.state[-1], action)
        np.testing.assert_array_equal(rollout.state[2], rollout.frames)


def test_without_a_clone_the_actor_acts(data):
    model = agent(DotEnv(), ibrl=True, offline_ratio=0, guidance=0)
    assert not model.policy.ibrl
    model = cloned(data)
    assert model.policy.ibrl and model.hyperparameters.needs_clone
    model.reset_task()
    assert not model.policy.ibrl


def test_the_choice_can_begin_and_end_within_an_episode(data):
    model = cloned(data)
    model.learn(5, reset_num_timesteps=False)
    for ibrl in (False, True):
        model.ibrl = ibrl
        assert model.policy.ibrl == ibrl
        model.learn(5, reset_num_timesteps=False)
    state = None
    for ibrl in (True, False, True):
        model.ibrl = ibrl
        _, state = model.predict(noise(1, 1)[0], state)
        assert len(state) == 3 + ibrl


def test_an_interrupted_run_goes_on_exactly(data, tmp_path):
    loaded = assert_goes_on_exactly(cloned(data, warmup_steps=0, guidance=0.0), data, tmp_path)
    assert loaded.policy.ibrl
