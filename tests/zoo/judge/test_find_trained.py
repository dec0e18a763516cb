"""Which agent a model file is of that lies outside of its run."""

import numpy as np
import pytest
from debug_agent import agent
from toy_env import DotEnv

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.packnet import PackNet
from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.collect.policies import SavedPolicy
from wpt_agents.zoo.judge.trained import find_trained

NARROW = {"channels": 2, "feature_dim": 4, "hidden_dim": 4, "device": "cpu"}


@pytest.mark.parametrize("kind", [DrQv2, PackNet])
def test_a_file_without_its_run_is_loaded_by_the_agent_that_wrote_it(kind, tmp_path):
    made = kind("CnnPolicy", DotEnv(actions=6), **NARROW)
    made.save(tmp_path / "model.zip")
    trained = find_trained(tmp_path / "model.zip", "dmc-walker-run")
    assert trained.task == "wpt/dmc-walker-run-v0" and trained.method.agent is kind
    image = DotEnv().reset(seed=0)[0]
    expected = made.predict(image, deterministic=True)[0]
    played = trained.load(device="cpu").predict(image, deterministic=True)[0]
    np.testing.assert_array_equal(played, expected)
    act = SavedPolicy(np.random.default_rng(0), str(tmp_path / "model.zip"), 0.0, 6)
    np.testing.assert_allclose(act(image, {}, 0), expected, atol=1e-6)


def test_a_task_of_another_robot_is_refused_with_the_file_and_the_numbers_of_actions(tmp_path):
    agent(DotEnv()).save(tmp_path / "model.zip")
    trained = find_trained(tmp_path / "model.zip", "quadruped-walk")
    with pytest.raises(ValueError, match=r"model\.zip acts in .*\(2,\).* takes 12 actions"):
        trained.load()


def test_a_file_of_wpt_or_of_no_agent_is_left_to_wpt(tmp_path):
    agent(DotEnv()).save(tmp_path / "model.zip")
    (tmp_path / "other.zip").write_bytes(b"no zip")
    for name in ("model.zip", "other.zip"):
        assert find_trained(tmp_path / name, "dmc-walker-run").method.agent is WPT
    with pytest.raises(ValueError, match=r"other.zip is not a wpt_agents model"):
        find_trained(tmp_path / "other.zip", "dmc-walker-run").load()
