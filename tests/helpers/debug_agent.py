"""A debug-sized agent, recorded episodes and a clock to step, for the tests of the algorithm."""

from collections import defaultdict

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.trajectory import Trajectory

SETTINGS = {
    "size": "debug",
    "max_action_dim": 4,
    "batch_size": 2,
    "batch_length": 4,
    "train_ratio": 0.5,  # an update, of 2 x 4 replayed steps, every 16 collected ones
    "learning_starts": 10,
    "warmup_steps": 25,
    "num_retrieve": 3,
    "bc_steps": 2,
    "bc_batch_size": 4,
    "imagine_horizon": 3,
    "seed": 0,
    "device": "cpu",
}


class ClockEnv(gym.Env):
    """Every byte of the image is the time, modulo 256, and the reward is the time."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)

    def __init__(self, length=7, terminates=False, low=-1.0, high=1.0, actions=2):
        self.length, self.terminates, self.render_mode = length, terminates, "rgb_array"
        self.action_space = spaces.Box(low, high, (actions,), np.float32)
        self.time = 0

    def render(self):
        return np.full((64, 64, 3), self.time % 256, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.render(), {}

    def step(self, action):
        assert self.action_space.contains(action), action
        self.time += 1
        over = self.time >= self.length
        ends = {"is_success": True} if over else {}
        return (
            self.render(),
            self.time,
            over and self.terminates,
            over and not self.terminates,
            ends,
        )


def on_time(trajectory, length=7):
    """Whether images and rewards of a ClockEnv's episode stand where they belong."""
    times = np.arange(length + 1)
    shown = (trajectory.image == times[:, None, None, None]).all()
    return bool(shown and (trajectory.reward == times[1:]).all())


def agent(env=None, **changes):
    return WPT("WPTPolicy", env, **SETTINGS | changes)


def pretrained(dataset, steps=2, **changes):
    return WPT.pretrain(dataset, steps=steps, **SETTINGS | changes)


def recorded(length=8, seed=0, actions=2, **labels):
    """A dot's episode of random actions, without rewards."""
    env, rng = DotEnv(actions=actions), np.random.default_rng(seed)
    image = [env.reset(seed=seed)[0]]
    action = rng.uniform(-1, 1, (length, actions)).astype(np.float32)
    image += [env.step(a)[0] for a in action]
    return Trajectory(np.stack(image), action, **labels)


def noise(*shape, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (*shape, 64, 64, 3)).astype(np.uint8)


def weights(model, *names):
    """Copies of the policy's tensors, of the submodules named, or of all."""
    state = model.policy.state_dict()
    return {k: v.clone() for k, v in state.items() if not names or k.startswith(names)}


def same(one, other):
    return one.keys() == other.keys() and all((one[k] == other[k]).all() for k in one)


def assert_goes_on_exactly(model, data, folder):
    """Save and load an agent and its replay; both must then learn and act exactly alike."""
    model.save(folder / "model")
    model.save_replay_buffer(folder / "replay")
    loaded = WPT.load(folder / "model", env=DotEnv(), dataset=data)
    loaded.load_replay_buffer(folder / "replay")
    for one in (model, loaded):
        one.env.seed(7)
        one._last_obs = None
        one.learn(2 * LENGTH, reset_num_timesteps=False)
        one.update(defaultdict(list))
    assert same(weights(model), weights(loaded))
    episodes = (one.replay_buffer.trajectories for one in (model, loaded))
    for ours, theirs in zip(*episodes, strict=True):
        np.testing.assert_array_equal(ours.action, theirs.action)
    return loaded
