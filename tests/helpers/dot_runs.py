"""Runs of the zoo on a toy task, with the smallest networks and in seconds."""

import gymnasium as gym
import pytest
import toy_env
from wpt_envs.tasks import TASKS, Task

from wpt_agents.zoo.plan.presets import Preset
from wpt_agents.zoo.plan.runs import Run
from wpt_agents.zoo.terminal import console

DOT = Task("dmc", "dot", "dot", 2, toy_env.LENGTH, "return", False)
MODEL_FREE = {
    "channels": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 4,
    "update_every": 5,
    "learning_starts": 25,
    "warmup_steps": 25,
}
SECTIONS = {
    "env": {"action_repeat": 1, "rendering": "fast"},
    "collect": {"tasks": ["dot"], "episodes": 4},
    "pretrain": {"steps": 2},
    "learn": {"frames": 75},
    "evaluate": {"episodes": 3},
    "wpt": {
        "size": "debug",
        "max_action_dim": 2,
        "batch_size": 2,
        "batch_length": 8,
        "train_ratio": 2,
        "learning_starts": 25,
        "warmup_steps": 25,
        "num_retrieve": 3,
        "bc_steps": 2,
        "bc_batch_size": 4,
    },
    "drqv2": MODEL_FREE | {"std": "linear(1,0.1,50)"},
    "jsrl": {"bc_size": "debug", "bc_steps": 2, "bc_batch_size": 4, "warmup_steps": 0},
    "r3m": {"clips": 4},
    "rlpd": MODEL_FREE | {"critics": 2, "reward_members": 2, "num_retrieve": 3},
    "mrq": {
        "channels": 2,
        "latent_dim": 8,
        "hidden_dim": 8,
        "batch_size": 4,
        "horizon": 2,
        "sync_every": 2,
        "update_every": 10,
        "learning_starts": 25,
        "warmup_steps": 25,
    },
    "sac": {"buffer_size": 100, "learning_starts": 25, "batch_size": 4, "train_freq": 10},
}


def make_dot(action_repeat=1, rendering="fast", render_size=None, render_mode="rgb_array"):
    return toy_env.DotEnv(render_mode)


@pytest.fixture(autouse=True)
def dot(monkeypatch):
    monkeypatch.setitem(TASKS, DOT.id, DOT)
    gym.register(DOT.id, entry_point=make_dot)
    monkeypatch.setattr(console, "_width", 160)
    yield
    del gym.registry[DOT.id]


def job(tmp_path, method="wpt", seed=0, data=None, **changes):
    sections = {title: SECTIONS[title] | changes.get(title, {}) for title in SECTIONS}
    return Run(DOT, seed, method, "toy", Preset.of(sections), tmp_path, 1, data=data)
