"""The policies of the model-free agents as SB3's own files hold them, and who uses a dataset."""

import warnings

import numpy as np
import pytest
from debug_agent import recorded
from toy_env import DotEnv

from wpt_agents import JSRL, MRQ, R3M, RLPD, DrQv2, PackNet

NARROW = {"channels": 4, "hidden_dim": 8}
AGENTS = [
    (DrQv2, {"feature_dim": 6, "frame_differences": 4.0}),
    (JSRL, {"feature_dim": 6, "bc_size": "debug"}),
    (MRQ, {"latent_dim": 6}),
    (PackNet, {"feature_dim": 6, "tasks": 2}),
    (R3M, {"feature_dim": 6}),
    (RLPD, {"feature_dim": 6, "critics": 3, "label": "optimistic", "reward_members": 2}),
]


@pytest.mark.parametrize(
    ("agent", "widths"), AGENTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_policy_of_other_widths_is_saved_and_loaded(agent, widths, tmp_path):
    env = DotEnv()
    policy = agent("CnnPolicy", env, **NARROW, **widths).policy
    policy.save(tmp_path / "policy.pth")
    loaded = type(policy).load(tmp_path / "policy.pth", device="cpu")
    weights = loaded.state_dict()
    assert weights.keys() == policy.state_dict().keys()
    assert all(weights[name].equal(weight) for name, weight in policy.state_dict().items())
    image = env.reset(seed=0)[0]
    np.testing.assert_array_equal(
        loaded.predict(image, deterministic=True)[0], policy.predict(image, deterministic=True)[0]
    )


@pytest.mark.parametrize(
    ("agent", "uses"),
    [(DrQv2, False), (MRQ, False), (PackNet, False), (JSRL, True), (R3M, True), (RLPD, True)],
)
def test_a_dataset_that_an_agent_has_no_use_for_is_reported(agent, uses):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent("CnnPolicy", DotEnv(), dataset=[recorded()], **NARROW)
    said = [w.filename for w in caught if "dataset= has no effect" in str(w.message)]
    assert said == ([] if uses else [__file__])
