"""Other people's environments by the two lines of docs/environments.md, from recording to loading.

python tests/helpers/strangers.py [name ...] prints a line for each; a package that is not installed
is passed over with the line that installs it.
"""

import importlib
import sys
import tempfile
import warnings
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym
import numpy as np

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory

STEPS = 12  # of an episode, which is cut short here
SMALL = {
    "size": "debug",
    "batch_size": 2,
    "batch_length": 8,
    "max_action_dim": 28,
    "imagine_horizon": 3,
    "bc_steps": 2,
    "bc_batch_size": 4,
    "num_retrieve": 2,
    "learning_starts": 0,
    "warmup_steps": 4,
    "train_ratio": 4,
    "seed": 0,
    "device": "cpu",
}


@dataclass(frozen=True)
class Stranger:
    """One environment: what to install and import, and the two lines that make and wrap it."""

    package: str  # as pip knows it
    module: str  # registers the ids when it is imported
    make: str
    wrap: str
    install: str = ""

    @property
    def name(self) -> str:
        """The package, or the extra that brings the environment."""
        return self.install or self.package


MUJOCO = "env = gym.make({!r}, render_mode='rgb_array')"
STRANGERS = [
    Stranger(
        "gym-pusht",
        "gym_pusht",
        "env = gym.make('gym_pusht/PushT-v0', obs_type='pixels_agent_pos')",
        "env = wpt_envs.pixels(env, image_key='pixels')",
    ),
    Stranger(
        "gym-aloha",
        "gym_aloha",
        "env = gym.make('gym_aloha/AlohaTransferCube-v0', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env, rendering='fast', camera='top')",
    ),
    Stranger(
        "box2d",
        "gymnasium",
        "env = gym.make('CarRacing-v3', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env, action_repeat=2)",
        "gymnasium[box2d]",
    ),
    Stranger(
        "highway-env",
        "highway_env",
        "env = gym.make('racetrack-v0', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env)",
    ),
    Stranger(
        "panda-gym",
        "panda_gym",
        "env = gym.make('PandaReach-v3', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env)",
    ),
    Stranger(
        "shimmy",
        "shimmy",
        "env = gym.make('dm_control/cheetah-run-v0', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env, rendering='fast', camera=0, action_repeat=2)",
        "shimmy[dm-control]",
    ),
    Stranger(
        "gymnasium-robotics",
        "gymnasium_robotics",
        "env = gym.make('FetchPush-v4', render_mode='rgb_array')",
        "env = wpt_envs.pixels(env, rendering='fast')",
    ),
    *(
        Stranger(
            "mujoco",
            "gymnasium",
            MUJOCO.format(name),
            "env = wpt_envs.pixels(env, rendering='fast')",
            "gymnasium[mujoco]",
        )
        for name in ("Ant-v5", "HalfCheetah-v5", "Hopper-v5", "Humanoid-v5")
    ),
]


def made(stranger: Stranger) -> gym.Env:
    """The environment, cut to short episodes."""
    import wpt_envs

    module = importlib.import_module(stranger.module)
    gym.register_envs(module)
    names = {"gym": gym, "wpt_envs": wpt_envs}
    exec(stranger.make + "\n" + stranger.wrap, names)
    return gym.wrappers.TimeLimit(names["env"], STEPS)


def recorded(env: gym.Env, seed: int) -> Trajectory:
    """An episode of random actions, stored in [-1, 1]."""
    low, high = env.action_space.low, env.action_space.high
    rng, images, actions = np.random.default_rng(seed), [env.reset(seed=seed)[0]], []
    for _ in range(STEPS):
        drawn = rng.uniform(-1, 1, low.shape).astype(np.float32)
        action = (low + (drawn + 1) / 2 * (high - low)).clip(low, high)
        image, _, terminated, truncated, _ = env.step(action.astype(env.action_space.dtype))
        images.append(image)
        actions.append(drawn)
        if terminated or truncated:
            break
    return Trajectory(np.stack(images), np.stack(actions))


def lives_through(stranger: Stranger, folder: Path) -> dict[str, float]:
    """Record two episodes, pre-train on them, learn, save, load and act again."""
    env = made(stranger)
    episodes = [recorded(env, seed) for seed in (0, 1)]
    with TrajectoryDataset.create(folder / "data") as dataset:
        for episode in episodes:
            dataset.append(episode)
    model = WPT.pretrain(folder / "data", steps=2, **SMALL)
    model.set_env(env)
    model.learn(3 * STEPS)
    model.save(folder / "model")
    loaded = WPT.load(folder / "model", env=env, device="cpu")
    image = episodes[1].image[0]
    one, _ = model.predict(image, deterministic=True)
    same, _ = loaded.predict(image, deterministic=True)
    env.close()
    assert np.array_equal(one, same) and env.action_space.contains(one), (one, same)
    moved = np.abs(np.diff(episodes[0].image.astype(int), axis=0)).max()
    return {
        "actions": len(one),
        "updates": model.updates,
        "episodes": model.episodes,
        "contrast": float(episodes[0].image.std()),
        "moved": int(moved),
    }


def main() -> None:
    """Try the strangers that are named, or all."""
    warnings.simplefilter("ignore")
    for stranger in STRANGERS:
        if sys.argv[1:] and not any(name in stranger.make for name in sys.argv[1:]):
            continue
        try:
            installed = version(stranger.package)
            with tempfile.TemporaryDirectory() as folder:
                print(stranger.make, installed, lives_through(stranger, Path(folder)), flush=True)
        except ModuleNotFoundError as error:
            print(f"{stranger.make}: pip install '{stranger.name}' ({error})", flush=True)


if __name__ == "__main__":
    main()
