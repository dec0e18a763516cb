"""It learns: a dot is pushed to its target, from scratch, from pixels (`--seeds 3` for three)."""

import numpy as np
import pytest
from stable_baselines3.common.evaluation import evaluate_policy
from toy_env import LENGTH, SPEED, DotEnv, best_action, best_return

from wpt_agents import WPT

SETTINGS = {
    "size": "tiny",
    "max_action_dim": 3,  # one more than the dot has: the padding must not matter
    "batch_size": 16,
    "batch_length": 8,
    "imagine_horizon": 8,
    "imagine_starts": 32,
    "gamma": 0.9,
    "target_fraction": 0.1,
    "ent_coef": 3e-3,
    "actor_critic_learning_rate": 1e-3,
    "train_ratio": 64,
    "learning_starts": 250,
    "warmup_steps": 500,
    "offline_ratio": 0,
    "guidance": 0,
}


def test_no_action_beats_the_best_one():
    env = DotEnv()
    env.reset(seed=3)
    start, rng = env.dot.copy(), np.random.default_rng(0)
    env.step(best_action(env))
    best = env.reward()
    for action in rng.uniform(-1, 1, (200, 2)):
        env.dot = start.copy()
        env.step(action.astype(np.float32))
        assert env.reward() <= best + 1e-6


def test_the_optimum_is_known():
    # from (-.9, -.9) to (.5, .5) each axis takes 7 steps of .2: |d| = 1.2 √2, 1.0 √2, ..., 0
    env = DotEnv()
    env.reset(seed=0)
    env.dot = np.array([-0.9, -0.9])
    total = sum(env.step(best_action(env))[1] for _ in range(LENGTH))
    distances = [max(1.4 - SPEED * (t + 1), 0) * 2**0.5 for t in range(LENGTH)]
    assert total == pytest.approx(sum(1 - d / 2 for d in distances))


@pytest.mark.filterwarnings("ignore:.*Monitor.*:UserWarning")
def test_a_dot_is_pushed_to_its_target_from_scratch(learning_seed):
    model = WPT("WPTPolicy", DotEnv(), seed=learning_seed, **SETTINGS)
    model.learn(1800)
    reached, _ = evaluate_policy(model, DotEnv(), n_eval_episodes=20)
    assert reached >= 0.9 * best_return(20, seed=0)
