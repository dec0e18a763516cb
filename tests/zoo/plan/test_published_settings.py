"""With the preset `paper` the baselines have the settings of their published code."""

import pytest
from stable_baselines3 import SAC

from wpt_agents.zoo.plan.methods import defaults
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan

COMMON = {"gamma": 0.99, "batch_size": 256, "pad": 4}
# cfgs/config.yaml and cfgs/task of facebookresearch/drqv2, tasks of medium difficulty
DRQV2 = COMMON | {
    "learning_rate": 1e-4,
    "channels": 32,
    "feature_dim": 50,
    "hidden_dim": 1024,
    "n_steps": 3,
    "tau": 0.01,
    "std": "linear(1,0.1,500000)",
    "std_clip": 0.3,
    "update_every": 2,
    "learning_starts": 2000,
    "warmup_steps": 2000,
    "pre_activation": 0.0,
    "frame_differences": 0.0,
}
# configs/rlpd_pixels_config.py of ikostrikov/rlpd
RLPD = COMMON | {
    "learning_rate": 3e-4,
    "channels": 32,
    "feature_dim": 50,
    "hidden_dim": 256,
    "critics": 10,
    "tau": 0.005,
    "offline_ratio": 0.5,
    "update_every": 1,
    "learning_starts": 1000,
    "warmup_steps": 1000,
}
# Hyperparameters of facebookresearch/MRQ
MRQ = COMMON | {
    "learning_rate": 3e-4,
    "encoder_learning_rate": 1e-4,
    "weight_decay": 1e-4,
    "channels": 32,
    "latent_dim": 512,
    "hidden_dim": 512,
    "n_steps": 3,
    "horizon": 5,
    "sync_every": 250,
    "reward_weight": 0.1,
    "end_weight": 0.1,
    "pre_activation": 1e-5,
    "grad_clip": 20.0,
    "std": 0.2,
    "std_clip": 0.3,
    "update_every": 1,
    "learning_starts": 10_000,
    "warmup_steps": 10_000,
}
# dmc_vision in configs.yaml of danijar/dreamerv3, as far as WPT has a keyword for it
DREAMER_V3 = {
    "batch_size": 16,
    "batch_length": 64,
    "train_ratio": 256,
    "gamma": 0.997,
    "lam": 0.95,
    "imagine_horizon": 15,
    "ent_coef": 3e-4,
    "free_nats": 1.0,
    "free_nats_mode": "element",
    "dyn_scale": 1.0,
    "rep_scale": 0.1,
    "return_norm": True,
    "zero_init_heads": True,
    "actor_outscale": 0.01,
    "actor_grad": "reinforce",
    "continue_head": True,
    "repval_scale": 0.3,
    "slow_critic_scale": 1.0,
    "target_fraction": 0.02,
    # It learns from its own episodes alone.
    "offline_ratio": 0.0,
    "guidance": 0.0,
    "kickstart": 0.0,
}
# Stable-Baselines3's own algorithm as it ships; a buffer of its default size has 74 GB.
AS_IT_SHIPS = {name: value for name, value in defaults(SAC).items() if name != "buffer_size"}
PUBLISHED = {
    "drq-v2": DRQV2,
    "r3m": DRQV2 | {"clips": 16},
    # By appendix G of the WPT paper's later version the clone drives no warm-up.
    "jsrl-bc": DRQV2 | {"warmup_steps": 0},
    # Continual World retrains for a tenth of a task's updates.
    "packnet": DRQV2 | {"retrain": 0.1},
    "rlpd": RLPD | {"label": "true"},
    "uds": RLPD | {"label": "zero"},
    # Five heads and β = 1 are our choice; the paper states neither.
    "explore": RLPD | {"label": "optimistic", "reward_members": 5, "beta": 1.0},
    "mrq": MRQ,
    "dreamer-v3": DREAMER_V3,
    "sac": AS_IT_SHIPS,
}


@pytest.mark.parametrize(("suite", "task"), [("dmc", "walker-run"), ("metaworld", "drawer-open")])
@pytest.mark.parametrize("method", PUBLISHED)
def test_the_paper_preset_has_the_published_settings(method, suite, task, tmp_path):
    [run] = make_plan(suite, [task], Request("paper", methods=[method], out=tmp_path))
    settings = run.full_keywords
    assert {name: settings[name] for name in PUBLISHED[method]} == PUBLISHED[method]
