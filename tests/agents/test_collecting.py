"""What is stored of several environments is what they did, whatever happens at the same step."""

import numpy as np
import pytest
from debug_agent import ClockEnv, agent
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv


class DiaryEnv(ClockEnv):
    """Episodes of random lengths that terminate, are truncated, or both; it notes every step.

    An image shows the environment, the episode and the time in its red, green and blue.
    """

    def __init__(self, number, seed):
        super().__init__(low=-2.0, high=3.0)
        self.number, self.episode, self.diary = number, -1, {}
        self.rng = np.random.default_rng([seed, number])

    def render(self):
        here = [self.number, self.episode, self.time]
        return np.broadcast_to(np.array(here, np.uint8), (64, 64, 3)).copy()

    def reset(self, **kwargs):
        self.episode += 1
        self.length, self.end = self.rng.integers(1, 9), self.rng.integers(1, 4)
        return super().reset(**kwargs)

    def step(self, action):
        self.time += 1
        end = self.end if self.time == self.length else 0
        reward = self.rng.normal()
        self.diary[self.episode, self.time] = action, reward, bool(end & 1), bool(end)
        return self.render(), reward, bool(end & 1), bool(end & 2), {}


class Meddler(BaseCallback):
    """Resets the environments at some steps, as an evaluation on them does, and stops at others."""

    def __init__(self, rng):
        super().__init__()
        self.rng = rng

    def _on_step(self):
        if self.rng.random() < 0.05:
            self.training_env.reset()
        return self.rng.random() > 0.05


def check(trajectory, envs, model):
    """Compare a trajectory with the diary; return its environment, episode and first time."""
    (number, episode, start), *_ = seen = trajectory.image[:, 0, 0].tolist()
    assert seen == [[number, episode, start + t] for t in range(len(trajectory) + 1)]
    notes = [envs[number].diary[episode, time] for _, _, time in seen[1:]]
    actions, rewards, terminated, over = map(np.array, zip(*notes, strict=True))
    np.testing.assert_array_equal(model.policy.to_env(trajectory.action), actions)
    np.testing.assert_array_equal(trajectory.reward, rewards.astype(np.float32))
    assert not over[:-1].any() and trajectory.terminated == terminated[-1]
    assert over[-1] or len(trajectory) == model.max_trajectory_length
    return number, episode, start


@pytest.mark.parametrize("seed", range(4))
def test_what_is_stored_is_what_the_environments_did(seed):
    rng = np.random.default_rng(seed)
    envs = [DiaryEnv(number, seed) for number in range(rng.integers(1, 5))]
    functions = [lambda env=env: env for env in envs]
    mode = [None, *AutoresetMode][seed % 4]
    venv = SyncVectorEnv(functions, autoreset_mode=mode) if mode else DummyVecEnv(functions)
    settings = {"offline_ratio": 0.0, "guidance": 0.0, "train_ratio": 0}
    model = agent(venv, max_trajectory_length=int(rng.integers(2, 10)), **settings)
    for reset in (True, False, False, True):
        callback = Meddler(rng) if rng.random() < 0.5 else None
        model.learn(60, callback=callback, reset_num_timesteps=reset)
    stored = [check(trajectory, envs, model) for trajectory in model.replay_buffer.trajectories]
    assert len(set(stored)) == len(stored) == model.episodes + model.progress.cut > 5
