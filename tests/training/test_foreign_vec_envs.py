"""VecEnvs unlike those of Stable-Baselines3, reused image buffers, devices that do not work."""

from copy import deepcopy

import numpy as np
import pytest
from clock_episodes import all_on_time, learnt, stored
from debug_agent import ClockEnv, agent, noise
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecMonitor

from wpt_agents.agents.wpt import WPT
from wpt_agents.training.resets import resets

FORK = pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")


class Reusing(ClockEnv):
    """The clock, always drawn into the same array."""

    array = None

    def render(self):
        self.array = super().render() if self.array is None else self.array
        self.array[:] = self.time
        return self.array


# ------------------------------------------------------------------------------ foreign VecEnvs


class Renamed(VecEnvWrapper):
    """Reports the last observation by another name, or not at all."""

    def __init__(self, venv, name):
        super().__init__(venv)
        self.name = name

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        obs, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            last = info.pop("terminal_observation", None)
            if last is not None and self.name:
                info[self.name] = last
        return obs, rewards, dones, infos


@pytest.mark.parametrize("name", ["final_obs", "final_observation"])
def test_the_last_image_may_have_gymnasiums_names(name):
    assert all_on_time(learnt(Renamed(DummyVecEnv([ClockEnv]), name)), 6)


def test_a_vecenv_without_the_last_image_is_refused_by_name_and_nothing_is_stored():
    model = agent(Renamed(DummyVecEnv([ClockEnv]), None))
    with pytest.raises(ValueError, match=r"0 of the Renamed .*\['terminal_observation'\]"):
        model.learn(20)
    assert not stored(model)
    model.set_env(Renamed(DummyVecEnv([ClockEnv]), "terminal_observation"))  # as it says
    assert all_on_time(model.learn(42), 6)


@pytest.mark.parametrize(
    "wrap",
    [
        lambda: Reusing(),
        lambda: [Reusing(), Reusing()],
        lambda: DummyVecEnv([Reusing, Reusing]),
        lambda: Renamed(make_vec_env(Reusing, n_envs=2), "terminal_observation"),
        lambda: SyncVectorEnv([Reusing, Reusing], autoreset_mode="SameStep"),
        lambda: SyncVectorEnv([Reusing, Reusing], autoreset_mode="NextStep", copy=False),
    ],
)
def test_an_environment_that_draws_into_one_array_keeps_its_last_images(wrap):
    assert all_on_time(learnt(wrap()), 6)


class OneArray(VecEnvWrapper):
    """Returns the observations of every reset and step in the same array."""

    array = None

    def _written(self, obs):
        self.array = obs.copy() if self.array is None else self.array
        self.array[:] = obs
        return self.array

    def reset(self):
        return self._written(self.venv.reset())

    def step_wait(self):
        obs, *outcome = self.venv.step_wait()
        return self._written(obs), *outcome


def test_first_images_of_a_vecenv_with_one_array_are_kept():
    class Later(ClockEnv):
        resets = 0

        def render(self):
            return super().render() + np.uint8(10 * self.resets)

        def reset(self, **kwargs):
            self.resets += 1
            return super().reset(**kwargs)

    model = agent(OneArray(DummyVecEnv([Later])))
    model.begin_episodes()
    assert model.first_images(3)[:, 0, 0, 0].tolist() == [10, 20, 30]
    assert all_on_time(learnt(OneArray(DummyVecEnv([ClockEnv]))), 6)


class Quiet(DummyVecEnv):
    """Leaves the private attributes alone that VecEnvs of Stable-Baselines3 renew in a reset."""

    def _reset_options(self):
        pass


@pytest.mark.parametrize("wrap", [lambda env: env, VecMonitor])
def test_after_an_evaluation_on_a_foreign_vecenv_new_episodes_begin(wrap):
    env = wrap(Quiet([ClockEnv]))
    model = agent(env).learn(3)  # in the middle of an episode
    model.learn(1, reset_num_timesteps=False)
    assert model.rollout.longest_open() == 4  # which went on
    evaluate_policy(model, env, 1, warn=False)
    model.learn(14, reset_num_timesteps=False)
    assert all_on_time(model, 2)


def test_attributes_of_the_environments_in_a_dummyvecenv_stay_where_they_were():
    env = DummyVecEnv([ClockEnv])
    agent(env)
    env.envs[0].length = 5
    assert env.envs[0].length == env.envs[0].unwrapped.length == env.get_attr("length")[0] == 5
    assert deepcopy(env.envs[0]).length == 5
    with pytest.raises(AttributeError, match="nothing"):
        _ = env.envs[0].nothing


def test_a_copy_of_a_vecenv_is_counted_by_itself():
    env = DummyVecEnv([ClockEnv])
    assert resets(env) == 0
    copy = deepcopy(env)
    copy.reset()
    assert (resets(env), resets(copy), copy.envs[0] is env.envs[0]) == (0, 1, False)


@FORK
def test_in_another_process_such_an_environment_is_warned_of():
    vec_env = SubprocVecEnv([Reusing], start_method="fork")
    with pytest.warns(UserWarning, match=r"same image at the end .* return observation.copy\(\)"):
        learnt(vec_env, 7)
    vec_env.close()
    vec_env = SubprocVecEnv([ClockEnv], start_method="fork")
    assert all_on_time(learnt(vec_env, 14), 2)
    vec_env.close()


# --------------------------------------------------------------------------------------- device


@pytest.mark.skipif("__import__('torch').cuda.is_available()", reason="this machine has CUDA")
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "gpu", "xpu"])
def test_a_device_that_does_not_work_is_refused_and_not_replaced(device, tmp_path):
    agent().save(tmp_path / "model")
    for make in (lambda: agent(device=device), lambda: WPT.load(tmp_path / "model", device=device)):
        with pytest.raises(ValueError, match=rf"device='{device}' does not work here .*'auto'"):
            make()
    model = WPT.load(tmp_path / "model", device="auto")
    assert model.device.type == "cpu" and model.predict(noise())[0].shape == (4,)
