"""DrQ-v2 pushes a dot to its target, from pixels, in minutes."""

import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from toy_env import DotEnv, best_return

from wpt_agents import DrQv2

SETTINGS = {  # small networks and batches for a CPU, and noise that falls within half of the run
    "channels": 8,
    "hidden_dim": 128,
    "batch_size": 32,
    "learning_rate": 3e-4,
    "pre_activation": 1e-2,
    "tau": 0.02,
    "gamma": 0.95,
    "update_every": 1,
    "learning_starts": 250,
    "warmup_steps": 250,
    "std": "linear(1,0.1,2000)",
}


@pytest.mark.nightly  # two minutes
@pytest.mark.filterwarnings("ignore:.*Monitor.*:UserWarning")
def test_a_dot_is_pushed_to_its_target():
    model = DrQv2("CnnPolicy", DotEnv(), seed=0, device="cpu", **SETTINGS)
    model.learn(4000)
    reached, _ = evaluate_policy(model, DotEnv(), n_eval_episodes=20)
    assert reached >= 0.9 * best_return(20, seed=0)
