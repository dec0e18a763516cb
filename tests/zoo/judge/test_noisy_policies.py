"""Noise on the actions of a policy that predicts from them: its state is that of the noisy ones."""

import numpy as np
import pytest
from debug_agent import agent, noise
from toy_env import DotEnv

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.model.prior_policy import PriorPolicy
from wpt_agents.zoo.collect.policies import SavedPolicy
from wpt_agents.zoo.judge.evaluation import NoisyPolicy


@pytest.mark.parametrize("batched", [True, False])
def test_the_world_model_sees_the_noisy_actions(batched):
    model = agent(DotEnv())
    action, state = NoisyPolicy(model, 0.5, seed=0).predict(noise(2) if batched else noise(1)[0])
    assert action.shape == ((2, 2) if batched else (2,))
    np.testing.assert_array_equal(state[-1][:, :2], np.atleast_2d(action))
    assert state[-1].shape[1] == model.max_action_dim and not state[-1][:, 2:].any()


def test_policies_that_see_images_alone_keep_them():
    model = agent(DotEnv())
    frames = DrQv2("CnnPolicy", DotEnv(), channels=2, feature_dim=4, hidden_dim=4, device="cpu")
    for policy in (PriorPolicy(model.policy), frames):
        expected = policy.predict(noise(2), deterministic=True)[1]
        action, state = NoisyPolicy(policy, 0.5, seed=0).predict(noise(2), deterministic=True)
        assert len(state) == len(expected) and action.shape == (2, 2)
        np.testing.assert_array_equal(state[0], expected[0])


def test_data_are_collected_with_the_noisy_actions_in_the_state(tmp_path):
    agent(DotEnv()).save(tmp_path / "model.zip")
    act = SavedPolicy(np.random.default_rng(0), str(tmp_path / "model.zip"), 0.5, 2)
    for step in range(2):
        action = act(noise(1)[0], {}, step)
        np.testing.assert_array_equal(act.state[-1][0, :2], action.astype(np.float32))
