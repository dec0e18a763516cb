"""What all model-free agents must do: files of SB3, several environments, several images."""

import warnings
import zipfile

import numpy as np
import pytest
from debug_agent import ClockEnv, noise, on_time, recorded, same, weights
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import DotEnv

from wpt_agents import JSRL, MRQ, R3M, RLPD, DrQv2, PackNet

NARROW = {"channels": 4, "hidden_dim": 8}
AGENTS = [
    (DrQv2, {"feature_dim": 6, "frame_differences": 4.0}),
    (JSRL, {"feature_dim": 6, "bc_size": "debug"}),
    (MRQ, {"latent_dim": 6}),
    (PackNet, {"feature_dim": 6, "tasks": 2}),
    (R3M, {"feature_dim": 6}),
    (RLPD, {"feature_dim": 6, "critics": 3, "label": "optimistic", "reward_members": 2}),
]


@pytest.mark.parametrize(
    ("agent", "widths"), AGENTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_policy_of_other_widths_is_saved_and_loaded(agent, widths, tmp_path):
    env = DotEnv()
    policy = agent("CnnPolicy", env, **NARROW, **widths).policy
    policy.save(tmp_path / "policy.pth")
    loaded = type(policy).load(tmp_path / "policy.pth", device="cpu")
    weights = loaded.state_dict()
    assert weights.keys() == policy.state_dict().keys()
    assert all(weights[name].equal(weight) for name, weight in policy.state_dict().items())
    image = env.reset(seed=0)[0]
    np.testing.assert_array_equal(
        loaded.predict(image, deterministic=True)[0], policy.predict(image, deterministic=True)[0]
    )


@pytest.mark.filterwarnings("ignore:.*without offline data")
@pytest.mark.parametrize("agent", [kind for kind, _ in AGENTS])
def test_four_environments_and_then_one_are_learned_from_and_predict_takes_both(agent):
    few = {"sync_every": 2, "horizon": 2} if agent is MRQ else {}
    few |= {"batch_size": 4, "learning_starts": 10, "warmup_steps": 10, "update_every": 4}
    model = agent("CnnPolicy", DummyVecEnv([ClockEnv] * 4), **NARROW, **few).learn(56)
    made = model.updates
    model.set_env(ClockEnv())
    model.learn(14, reset_num_timesteps=False)
    assert model.episodes == len(model.replay_buffer.trajectories) == 10
    assert all(on_time(episode) for episode in model.replay_buffer.trajectories)
    assert 0 < made < model.updates
    images = noise(4)
    together, state = model.predict(images, deterministic=True)
    assert together.shape == (4, 2) and state[0].shape == (4, 3, 64, 64, 3)
    for image, action in zip(images, together, strict=True):
        alone, _ = model.predict(image, deterministic=True)
        np.testing.assert_allclose(alone, action, atol=1e-5)


@pytest.mark.parametrize(
    ("agent", "uses"),
    [(DrQv2, False), (MRQ, False), (PackNet, False), (JSRL, True), (R3M, True), (RLPD, True)],
)
def test_a_dataset_that_an_agent_has_no_use_for_is_reported(agent, uses):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent("CnnPolicy", DotEnv(), dataset=[recorded()], **NARROW)
    said = [w.filename for w in caught if "dataset= has no effect" in str(w.message)]
    assert said == ([] if uses else [__file__])


@pytest.mark.filterwarnings("ignore:.*without offline data")
@pytest.mark.parametrize(
    ("agent", "widths"), AGENTS, ids=lambda value: getattr(value, "__name__", "")
)
def test_a_callback_stops_it_and_its_files_hold_json_and_tensors_alone(agent, widths, tmp_path):
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 16

    model = agent("CnnPolicy", ClockEnv(), seed=0, **NARROW, **widths)
    model.learn(1000, callback=Stop())
    assert model.num_timesteps == 16
    model.save(tmp_path / "model.zip")
    model.save_replay_buffer(tmp_path / "replay.zip")
    for file in ("model.zip", "replay.zip"):
        names = zipfile.ZipFile(tmp_path / file).namelist()
        assert {name.rpartition(".")[2] for name in names} <= {"json", "safetensors", "npy"}
    loaded = agent.load(tmp_path / "model.zip", env=ClockEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    assert same(weights(model), weights(loaded)) and len(loaded.replay_buffer.trajectories) == 2
