"""`learn` says at its start and at its end that it makes no update, with a remedy that works."""

import re
import warnings
from dataclasses import replace

import gymnasium as gym
import pytest
from debug_agent import ClockEnv, agent, pretrained, recorded
from gymnasium.vector import SyncVectorEnv
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.atari_wrappers import MaxAndSkipEnv
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import DotEnv
from wpt_envs.wrappers import RepeatAction

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.training.ends import time_limit
from wpt_agents.training.environments import as_vec_env
from wpt_agents.training.outlook import Outlook

SCRATCH = {"offline_ratio": 0.0, "guidance": 0.0, "warmup_steps": 0}
ENDLESS = 10**9
SHORT = {"max_trajectory_length": 150}  # so that the tests need not collect 1,000 steps
COSTLY = {"train_ratio": 0.05, "learning_starts": 250}
LEARNS = Outlook(
    start=0,
    stop=100,
    n_envs=1,
    replay=False,
    opened=0,
    longest=1000,
    limit=50,
    price=16,
    credit=0,
    learning_starts=60,
    warmup_pays=True,
    warmup_steps=0,
    cheaper="",
)


def said(model, steps, **kwargs):
    """The warnings of a call of `learn`."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(steps, **kwargs)
    return [str(w.message) for w in caught if str(w.message).startswith("learn(")]


@pytest.mark.parametrize(
    ("changes", "needed"),
    [
        ({}, 60),  # learning_starts, when one episode of 50 has ended
        ({"learning_starts": 10}, 50),  # the episode
        ({"learning_starts": 10, "replay": True}, 16),  # the price
        ({"learning_starts": 10, "replay": True, "credit": 10}, 10),
        ({"warmup_pays": False}, 76),  # the price is collected behind learning_starts
        ({"start": 40, "learning_starts": 0, "limit": 30, "opened": 10}, 20),
        ({"limit": 5000, "longest": 70}, 70),  # a part of an episode
        ({"n_envs": 4, "learning_starts": 0}, 200),  # four episodes of 50 at once
        ({"n_envs": 4, "replay": True, "learning_starts": 30}, 32),
    ],
)
def test_the_first_update_by_hand(changes, needed):
    assert replace(LEARNS, **changes).needed(over=False) == needed


def test_an_episode_of_unknown_length_may_end_soon_until_the_call_is_over():
    unknown = replace(LEARNS, limit=None, learning_starts=0)
    assert unknown.no_update(over=False) is None
    assert unknown.needed(over=True) == 1000
    assert "max_trajectory_length" in unknown.no_update(over=True)


CASES = {
    "learning_starts": (lambda: agent(ClockEnv(), **SCRATCH | {"learning_starts": 100}), 40),
    "an endless episode": (lambda: agent(ClockEnv(ENDLESS), **SCRATCH | SHORT), 100),
    "train_ratio": (lambda: agent(ClockEnv(), **SCRATCH | {"train_ratio": 0.1}), 40),
    "all at once": (
        lambda: agent(
            ClockEnv(ENDLESS), **SCRATCH | SHORT | {"train_ratio": 0.05, "learning_starts": 250}
        ),
        100,
    ),
    "two environments": (
        lambda: agent(DummyVecEnv([lambda: ClockEnv(ENDLESS)] * 2), **SCRATCH | SHORT),
        100,
    ),
    "a time limit": (
        lambda: agent(limited(ClockEnv(200), 200), **SCRATCH),
        100,
    ),
    "drqv2": (lambda: drqv2(), 40),
}


def limited(env, steps):
    """An environment that says how long its episodes are, as those of `gym.make` do."""
    env.spec = gym.envs.registration.EnvSpec("Clock-v0", max_episode_steps=steps)
    return env


@pytest.mark.parametrize(
    ("wrap", "limit"),
    [
        (lambda env: TimeLimit(env, 90), 90),
        (lambda env: RepeatAction(TimeLimit(env, 90), 4), 23),  # 22 repeats, and 2 steps
        (lambda env: TimeLimit(RepeatAction(env, 4), 90), 90),
        (lambda env: TimeLimit(RepeatAction(TimeLimit(env, 90), 4), 20), 20),
        (lambda env: RepeatAction(TimeLimit(RepeatAction(env, 2), 90), 3), 30),
        (lambda env: RepeatAction(limited(env, 90), 4), 23),
        (lambda env: MaxAndSkipEnv(TimeLimit(env, 90), 3), 30),
        (lambda env: RepeatAction(env, 4), None),
    ],
)
@pytest.mark.parametrize("vector", [DummyVecEnv, SyncVectorEnv])
def test_an_action_repeat_outside_of_a_time_limit_divides_it(vector, wrap, limit):
    env = as_vec_env(vector([lambda: wrap(ClockEnv(ENDLESS))]))
    assert time_limit(env) == limit


def drqv2():
    settings = {"channels": 2, "feature_dim": 8, "hidden_dim": 16, "batch_size": 4}
    settings |= {"learning_starts": 30, "update_every": 20, "warmup_steps": 0, "seed": 0}
    return DrQv2("CnnPolicy", ClockEnv(), device="cpu", **settings)


@pytest.mark.parametrize("case", CASES)
def test_each_cause_is_named_at_the_end_and_both_remedies_work(case):
    make, steps = CASES[case]
    model = make()
    texts = said(model, steps)
    assert model.updates == 0 and "made no update" in texts[-1], texts
    needed = int(re.search(r"at least (\d+) steps", texts[-1])[1])
    assert make().learn(needed).updates > 0
    assert make().learn(needed - model.n_envs).updates == 0
    model = make()
    exec(re.search(r"or set (.*) before it", texts[-1])[1].replace(" and ", "\n"), {"model": model})
    assert not said(model, steps) and model.updates > 0


@pytest.mark.parametrize("case", ["learning_starts", "train_ratio", "a time limit", "drqv2"])
def test_what_is_known_before_is_said_before(case):
    make, steps = CASES[case]
    texts = said(make(), steps)
    assert "will make no update" in texts[0] and "made no update" in texts[1] and len(texts) == 2


@pytest.mark.parametrize("steps", [40, 57])
def test_a_warm_up_that_outlasts_the_call_is_named_twice(steps):
    settings = SCRATCH | {"warmup_steps": 57}
    texts = said(agent(ClockEnv(), **settings), steps)
    assert [text for text in texts if "random actions: warmup_steps=57" in text] == texts != []
    assert len(texts) == 2
    more = int(re.search(r"more than (\d+) steps", texts[0])[1])
    assert not said(agent(ClockEnv(), **settings), more + 1)


def test_nothing_is_said_of_a_call_that_learns_or_is_told_not_to():
    assert not said(agent(ClockEnv(), **SCRATCH), 40)
    assert not said(agent(ClockEnv(), **SCRATCH | {"train_ratio": 0}), 40)


@pytest.mark.parametrize("make", [lambda: agent(ClockEnv(), **SCRATCH), lambda: drqv2()])
def test_learn_0_makes_no_step_and_says_nothing(make):
    model = make()
    assert not said(model, 0) and model.learn(0) is model
    assert model.num_timesteps == model.updates == model.episodes == 0
    model.learn(40)
    assert not said(model, 0, reset_num_timesteps=False) and model.num_timesteps == 40


def test_learn_0_retrieves_and_trains_the_prior_actor():
    model = pretrained([recorded(seed=seed) for seed in range(4)], env=DotEnv())
    assert not said(model, 0) and model.num_timesteps == 0
    assert len(model.retrieved_ids) == 3 and model.prior is not None


def test_short_calls_that_continue_a_run_are_not_warned_of():
    model = agent(ClockEnv(), **SCRATCH).learn(40)
    made = model.updates
    assert not said(model, 7, reset_num_timesteps=False) and model.updates == made
    model.learn(7, reset_num_timesteps=False)
    assert model.updates == made + 1  # earned by all of the 54 steps, 16 each


def test_a_call_that_a_callback_stops_says_how_to_go_on():
    model = agent(ClockEnv(), **SCRATCH | {"learning_starts": 0})
    texts = said(model, 40, callback=lambda *_: model.num_timesteps < 20)
    assert "made no update: it was stopped before the first one" in texts[0]
    assert model.learn(20, reset_num_timesteps=False).updates > 0
