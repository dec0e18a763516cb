"""The wrappers, pixels() around any environment, and the checkers on every task."""

import hashlib
import os
import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
import wpt_envs
from dm_control.rl.control import PhysicsError
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from sampling import one_in_eight
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv
from wpt_envs.wrappers import CheckAction, PadAction, RepeatAction, SeePixels

pytestmark = pytest.mark.slow  # it runs simulators or whole runs

SUITES = ["dmc-walker-run", "metaworld-button-press", "robotics-fetch-push"]
FAMILIES = [
    *SUITES,
    "dmc-cartpole-balance",
    "dmc-acrobot-swingup",
    "dmc-cheetah-run",
    "dmc-quadruped-run",
    "robotics-shadow-hand-block",
    "robotics-adroit-door",
]


class Count(gym.Env):
    """Counts its steps; ends after five; its picture is as bright as the count."""

    render_mode = "rgb_array"
    observation_space = spaces.Box(0, 9, (1,), np.float32)

    def __init__(self, space=None):
        self.metadata = {"render_modes": ["rgb_array"], "render_fps": 30}
        self.action_space = space or spaces.Box(-1, 1, (2,), np.float32)
        self.count, self.actions, self.looks = 0, [], 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.count += 1
        self.actions.append(action)
        return np.full(1, self.count, np.float32), 1.5, self.count >= 5, False, {}

    def render(self):
        self.looks += 1
        return np.full((40, 40, 3), 10 * self.count, np.uint8)


def episode_hashes(name, seeds=(3, 4, 3)):
    """For each seed a digest of everything that three steps bring, all from one environment."""
    env = gym.make(f"wpt/{name}-v0", rendering="fast", state_in_info=True)
    hashes = []
    for seed in seeds:
        results = [env.reset(seed=seed)]
        for step in range(3):
            action = np.sin(step + np.arange(env.action_space.shape[0])).astype(np.float32)
            results.append(env.step(action))
        hashes.append(hashlib.sha256(pickle.dumps(results)).hexdigest())
    env.close()
    return hashes


def test_repeating_sums_rewards_and_stops_at_the_end():
    env = RepeatAction(Count(), times=2)
    env.reset()
    steps = [env.step(np.zeros(2)) for _ in range(3)]
    assert [step[1] for step in steps] == [3.0, 3.0, 1.5]
    assert [step[2] for step in steps] == [False, False, True]
    assert env.metadata["render_fps"] == 15


class Scaling(Count):
    """Scales its action in place, as many environments do."""

    def step(self, action):
        action *= 0.5
        return super().step(action.copy())


def test_every_repeat_gets_the_agents_action():
    env = RepeatAction(Scaling(), times=2)
    env.reset()
    action = np.ones(2)
    env.step(action)
    assert [a.tolist() for a in env.unwrapped.actions] == [[0.5, 0.5]] * 2
    assert action.tolist() == [1, 1]


def test_a_whole_number_of_repeats_may_be_a_float():
    env = RepeatAction(Count(), times=2.0)
    env.reset()
    assert env.step(np.zeros(2))[1] == 3.0


@pytest.mark.parametrize("times", [0, -2, 1.5])
def test_repeating_less_than_once_or_in_part_is_refused(times):
    with pytest.raises(ValueError, match="whole number, 1 or more"):
        RepeatAction(Count(), times=times)


def test_padding_hands_the_leading_actions_on():
    env = PadAction(Count(), size=4)
    env.reset()
    env.step(np.array([0.1, 0.2, 0.3, 0.4]))
    assert env.action_space.shape == (4,)
    assert np.array_equal(env.unwrapped.actions[0], [0.1, 0.2])


def test_padding_below_the_true_width_is_refused_with_both_widths():
    with pytest.raises(ValueError, match=r"=3 is narrower than the task's 6"):
        gym.make("wpt/dmc-walker-run-v0", pad_action_to=3)


@pytest.mark.parametrize(
    ("action", "complaint"),
    [(np.zeros(3), r"shape \(3,\)"), ([0, np.nan], "NaN"), ([0, 1.5], r"outside \[-1.0, 1.0\]")],
)
def test_a_bad_action_is_refused_and_the_environment_goes_on(action, complaint):
    env = CheckAction(Count())
    env.reset()
    with pytest.raises(ValueError, match=complaint):
        env.step(action)
    assert env.unwrapped.actions == []
    env.reset()
    env.step(np.zeros(2))


@pytest.mark.parametrize("pad_action_to", [None, 4])
@pytest.mark.parametrize(
    ("low", "high", "dtype"), [(-0.1, 0.1, np.float64), (-5, 5, np.int32), (0, 255, np.uint8)]
)
def test_an_action_reaches_the_environment_in_the_dtype_of_its_own_space(
    low, high, dtype, pad_action_to
):
    space = spaces.Box(low, high, (2,), dtype)
    env = wpt_envs.pixels(Count(space), pad_action_to=pad_action_to)
    env.reset()
    for action in (env.action_space.low, env.action_space.high, env.action_space.sample()):
        env.step(action)
        assert space.contains(env.unwrapped.actions[-1])
        assert np.array_equal(env.unwrapped.actions[-1], action[:2])


def test_fractions_are_rounded_where_actions_are_whole_numbers():
    env = CheckAction(Count(spaces.Box(-5, 5, (2,), np.int32)))
    env.reset()
    env.step(np.array([2.7, -2.7], np.float32))
    assert env.unwrapped.actions[0].tolist() == [3, -3]


class Overwriting(Count):
    """Counts in the same array."""

    state = np.zeros(1, np.float32)

    def step(self, action):
        self.state[:], *outcome = super().step(action)
        return self.state, *outcome


def test_the_state_in_info_stays_as_it_was():
    env = wpt_envs.pixels(Overwriting(), state_in_info=True)
    env.reset()
    infos = [env.step(np.zeros(2))[-1] for _ in range(3)]
    assert [float(info["state"][0]) for info in infos] == [1, 2, 3]


def test_the_picture_is_taken_once_an_agent_step():
    env = wpt_envs.pixels(Count(), action_repeat=2)
    env.reset()
    looks = env.unwrapped.looks
    env.step(np.zeros(2))
    assert env.unwrapped.looks == looks + 1


def test_the_observation_is_the_picture_after_the_last_repeat():
    env = wpt_envs.pixels(Count(), action_repeat=2, image_size=8, state_in_info=True)
    env.reset()
    obs, *_, info = env.step(np.zeros(2))
    assert np.array_equal(obs, np.full((8, 8, 3), 20))
    assert info["state"] == 2


def test_changing_an_observation_changes_nothing_else():
    env = wpt_envs.pixels(Count())
    env.reset()[0][:] = 99
    assert env.render().max() == 0


def test_discrete_actions_are_seen_and_repeated_but_not_padded():
    env = wpt_envs.pixels(Count(spaces.Discrete(2)), action_repeat=2)
    env.reset()
    assert env.step(1)[1] == 3.0
    with pytest.raises(ValueError, match="flat Box"):
        wpt_envs.pixels(Count(spaces.Discrete(2)), pad_action_to=4)


def test_an_environment_without_pictures_is_refused_with_the_remedy():
    env = Count()
    env.render_mode = None
    with pytest.raises(ValueError, match="render_mode='rgb_array'"):
        wpt_envs.pixels(env)
    with pytest.raises(ValueError, match="none was found in"):
        wpt_envs.pixels(Count(), rendering="near")


def test_any_mujoco_environment_is_drawn_by_our_renderer():
    env = wpt_envs.pixels(gym.make("InvertedPendulum-v5"), rendering="fast", pad_action_to=3)
    first, _ = env.reset(seed=0)
    obs, *_ = env.step(np.array([1, 0, 0], np.float32))
    assert obs.shape == (64, 64, 3) and np.ptp(obs) > 50
    assert not np.array_equal(first, obs)
    env.close()


def test_an_environment_is_made_again_from_its_spec():
    base = gym.make("InvertedPendulum-v5", render_mode="rgb_array")
    env = wpt_envs.pixels(base, rendering="fast", camera={"distance": 3.0}, pad_action_to=3)
    again = gym.make(env.spec)
    assert np.array_equal(env.reset(seed=3)[0], again.reset(seed=3)[0])
    assert again.action_space == env.action_space
    assert str(again) == str(env)
    for options in ({}, {"crop": True}):
        cart = wpt_envs.pixels(gym.make("CartPole-v1", render_mode="rgb_array"), **options)
        assert str(gym.make(cart.spec)) == str(cart)


@pytest.mark.parametrize("name", SUITES)
def test_a_pickled_environment_is_made_again_and_draws_its_own_simulation(name):
    env = gym.make(f"wpt/{name}-v0", rendering="fast", action_repeat=3)
    again = pickle.loads(pickle.dumps(env))
    env.reset(seed=0)  # from now on a GL context is open
    action = np.full(env.action_space.shape, 0.5, np.float32)
    for copied in (again, pickle.loads(pickle.dumps(env))):
        assert np.array_equal(env.reset(seed=3)[0], copied.reset(seed=3)[0])
        assert np.array_equal(env.step(action)[0], copied.step(action)[0])
        copied.close()
    env.close()


def test_rendering_answers_the_last_observation():
    env = SeePixels(wpt_envs.pixels(Count()).env, image_size=64)
    obs, _ = env.reset()
    assert np.array_equal(env.render(), obs)


def test_the_same_seed_is_the_same_episode_here_and_in_a_fresh_process_and_others_differ():
    code = f"from test_envs_wrappers import *; print([*map(episode_hashes, {FAMILIES!r})])"
    answer = subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    hashes = [episode_hashes(name) for name in FAMILIES]
    assert str(hashes) == answer.stdout.splitlines()[-1]
    for first, other, again in hashes:
        assert first == again and first != other


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
@pytest.mark.parametrize(
    "name", ["wpt/dmc-cheetah-run-v0", "wpt/metaworld-push-v0", "wpt/robotics-fetch-push-v0"]
)
def test_a_forked_worker_has_the_same_episode_though_this_process_draws_too(name):
    env = gym.make(name, rendering="fast")
    first, _ = env.reset(seed=1)
    vector = gym.make_vec(name, num_envs=2, vectorization_mode="async", rendering="fast")
    firsts, _ = vector.reset(seed=0)  # the second worker is seeded by 1
    action = np.full(env.action_space.shape, 0.5, np.float32)
    step, steps = env.step(action), vector.step(np.stack([action, action]))
    vector.close()
    assert np.array_equal(firsts[1], first) and not np.array_equal(firsts[0], first)
    assert np.array_equal(steps[0][1], step[0]) and steps[1][1] == step[1]


def test_a_spawned_worker_knows_the_ids_too():
    name, spawned = "wpt/dmc-cartpole-balance-v0", {"context": "spawn"}
    vector = gym.make_vec(name, 1, "async", vector_kwargs=spawned, rendering="fast")
    first, _ = vector.reset(seed=0)
    vector.close()
    assert np.array_equal(first[0], gym.make(name, rendering="fast").reset(seed=0)[0])


def test_workers_of_stable_baselines3_know_the_ids_by_the_packages_name():
    name = "wpt/dmc-cartpole-balance-v0"
    vector = make_vec_env(
        f"wpt_envs:{name}",
        seed=0,
        vec_env_cls=SubprocVecEnv,
        env_kwargs={"rendering": "fast"},
        vec_env_kwargs={"start_method": "spawn"},
    )
    first = vector.reset()
    vector.close()
    assert np.array_equal(first[0], gym.make(name, rendering="fast").reset(seed=0)[0])


def test_make_vec_takes_the_keywords_too():
    looks = {"image_size": 32, "rendering": "fast", "camera": "back", "render_size": 48}
    acts = {"action_repeat": 4, "pad_action_to": "suite", "state_in_info": True, "seed": 3}
    vector = gym.make_vec("wpt/dmc-walker-run-v0", num_envs=2, **looks, **acts)
    assert vector.single_action_space.shape == (12,)
    first, _ = vector.reset()
    obs, _, _, _, info = vector.step(np.zeros((2, 12), np.float32))
    assert obs.shape == (2, 32, 32, 3) and info["state"].shape == (2, 24)
    assert vector.render()[0].shape == (48, 48, 3)
    times = [env.unwrapped.dm_env.physics.time() for env in vector.envs]
    assert times == pytest.approx([0.1, 0.1])  # four control steps
    assert np.array_equal(vector.reset(seed=[3, 4])[0][0], first[0])
    vector.close()


@pytest.mark.parametrize("name", SUITES)
def test_an_environment_that_raised_can_be_reset(name):
    env = gym.make(f"wpt/{name}-v0", rendering="fast")
    first, _ = env.reset(seed=1)
    for bad in (np.nan, 7):
        with pytest.raises(ValueError, match=r"NaN|outside"):
            env.step(np.full(env.action_space.shape, bad, np.float32))
    assert np.array_equal(env.reset(seed=1)[0], first)


def test_a_simulation_that_broke_down_can_be_reset():
    env = gym.make("wpt/dmc-walker-run-v0", rendering="fast")
    first, _ = env.reset(seed=1)
    env.unwrapped.dm_env.physics.data.qvel[:] = np.nan
    with pytest.raises(PhysicsError):
        env.step(np.zeros(6, np.float32))
    assert np.array_equal(env.reset(seed=1)[0], first)


@pytest.mark.parametrize(
    ("keywords", "complaint"),
    [
        ({"image_size": 0}, "image_size=0.*1 or more"),
        ({"render_size": -1}, "render_size=-1.*1 or more"),
        ({"pad_action_to": 4.5}, "a number, 'suite' or None"),
        ({"render_mode": "human"}, "'rgb_array', None"),
    ],
)
def test_a_bad_keyword_is_answered_with_what_would_do(keywords, complaint):
    with pytest.raises(ValueError, match=complaint):
        gym.make("wpt/dmc-walker-run-v0", **keywords)


WRAPPED = "ignore:.*is different from the unwrapped version"  # the pixels are wrappers, by design


@pytest.mark.filterwarnings(WRAPPED)
@pytest.mark.parametrize("name", one_in_eight(wpt_envs.TASKS))
def test_the_checkers_of_gymnasium_and_sb3_pass(name):
    env = gym.make(name, rendering="fast", image_size=40, pad_action_to="suite", action_repeat=2)
    check_env(env, skip_render_check=True)
    sb3_check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.filterwarnings(WRAPPED)
def test_the_checkers_pass_for_rendering_too():
    env = gym.make("wpt/dmc-walker-run-v0", rendering="fast")
    check_env(env)
    sb3_check_env(env)
