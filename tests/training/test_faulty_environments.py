"""An environment that raises, hangs or shows something else than its space says."""

import os
import signal

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, agent, on_time, weights
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from toy_env import LENGTH, DotEnv

from wpt_agents.training import rollout


class FailAt(ClockEnv):
    """The clock, which at step `at` in all shows something else or raises."""

    def __init__(self, at=10, show=None):
        super().__init__()
        self.at = at
        self.show = show
        self.steps = 0

    def step(self, action):
        image, *rest = super().step(action)
        self.steps += 1
        if self.steps != self.at:
            return image, *rest
        if self.show is None:
            raise ZeroDivisionError("the simulation diverged")
        return self.show(image), *rest


def goes_on(model, episodes):
    """Learns for two further episodes; all that is stored must be whole."""
    assert all(torch.isfinite(weight).all() for weight in weights(model).values())
    model.learn(14 * model.n_envs, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * episodes


@pytest.mark.parametrize("train_freq", ["episode", "step"])
def test_an_environment_that_raises_costs_its_open_episode_and_shows_its_own_traceback(train_freq):
    model = agent(FailAt(), train_freq=train_freq)
    with pytest.raises(ZeroDivisionError, match="the simulation diverged") as error:
        model.learn(100)
    assert error.traceback[-1].name == "step"
    goes_on(model, episodes=3)  # one of 7 steps before the error, two after it


def test_one_of_two_environments_that_raises_costs_the_open_episodes_of_both():
    model = agent(DummyVecEnv([ClockEnv, FailAt]))
    with pytest.raises(ZeroDivisionError):
        model.learn(100)
    goes_on(model, episodes=2 + 4)


@pytest.mark.parametrize(
    ("show", "words"),
    [
        (lambda i: i[..., :1], r"must be \(64, 64, 3\) uint8 .* is \(64, 64, 1\) uint8"),
        (lambda i: i[:32], r"is \(32, 64, 3\) uint8"),
        (lambda i: i / 255, r"is \(64, 64, 3\) float64 from 0.01\d+ to 0.01\d+; nothing"),
        (lambda i: i * np.nan, "float64 from nan to nan"),
        (lambda i: i.astype(int) + 255, "int64 from 25[0-9] to 25[0-9]"),
        (lambda i: i.astype(int) - 255, "int64 from -25[0-9] to -25[0-9]"),
        (lambda i: None, r"is \(\) object"),
    ],
)
def test_an_image_that_is_not_what_the_space_says_is_refused_and_nothing_of_it_is_stored(
    show, words
):
    model = agent(FailAt(show=show))
    with pytest.raises(ValueError, match=words):
        model.learn(100)
    goes_on(model, episodes=3)


def test_bytes_in_other_whole_numbers_are_taken():
    model = agent(FailAt(show=lambda i: i.astype(np.int64))).learn(21)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 3


def test_the_image_in_a_dictionary_is_checked_too():
    class Dictionary(FailAt):
        def __init__(self):
            super().__init__(show=lambda i: i / 255)
            arm = spaces.Box(-1, 1, (2,), np.float32)
            self.observation_space = spaces.Dict(top=self.observation_space, arm=arm)

        def reset(self, **kwargs):
            return {"top": super().reset(**kwargs)[0], "arm": np.zeros(2, np.float32)}, {}

        def step(self, action):
            image, *rest = super().step(action)
            return {"top": image, "arm": np.zeros(2, np.float32)}, *rest

    with pytest.warns(UserWarning, match="sees 'top'"):
        model = agent(Dictionary())
    with pytest.raises(ValueError, match=r"entry 'top' of an observation must be .*float64"):
        model.learn(100)


class StopWorker(BaseCallback):
    """Stops a worker process at a step, so that it hangs."""

    def __init__(self, process, step):
        super().__init__()
        self.process, self.step = process, step

    def _on_step(self):
        if self.num_timesteps == self.step:
            os.kill(self.process.pid, signal.SIGSTOP)
        return True


@pytest.mark.slow
def test_a_worker_that_hangs_is_named_and_ended_and_learning_goes_on_in_new_ones(monkeypatch):
    monkeypatch.setattr(rollout, "PATIENCE", 1.0)
    env = SubprocVecEnv([DotEnv] * 2)
    hanging = env.processes[1]
    model, stopper = agent(env), StopWorker(hanging, step=2 * LENGTH + 10)
    message = rf"Environment 1 .* process {hanging.pid}, did not answer for 1 s.*set_env\(\)"
    with pytest.raises(RuntimeError, match=message):
        model.learn(8 * LENGTH, callback=stopper)
    assert [process.exitcode for process in env.processes] == [-signal.SIGKILL] * 2  # no zombies
    env.close()  # does not wait for them
    assert len(model.replay_buffer.trajectories) == 2
    model.set_env(DummyVecEnv([ClockEnv] * 2))
    assert model.learn(14, reset_num_timesteps=False).episodes == 4
