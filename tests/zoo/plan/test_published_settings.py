"""With the preset `paper` the baselines have the settings of their published code."""

import pytest

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
}


@pytest.mark.parametrize(("suite", "task"), [("dmc", "walker-run"), ("metaworld", "drawer-open")])
@pytest.mark.parametrize("method", PUBLISHED)
def test_the_paper_preset_has_the_published_settings(method, suite, task, tmp_path):
    [run] = make_plan(suite, [task], "paper", "1", [method], [], tmp_path, 1, "cpu")
    settings = run.full_keywords
    assert {name: settings[name] for name in PUBLISHED[method]} == PUBLISHED[method]
