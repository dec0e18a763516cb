"""R3M: pre-training aligns features in time; downstream they are frozen and computed once."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, recorded, same, weights

from wpt_agents.agents.r3m import R3M
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.model.time_contrastive import aligned, draw_clips

SETTINGS = {
    "channels": 4,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 8,
    "clips": 8,
    "learning_starts": 10,
    "warmup_steps": 20,
    "seed": 0,
    "device": "cpu",
}


@pytest.fixture
def dataset(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as made:
        for seed in range(6):
            made.append(recorded(12, seed))
    return made


def drift(length, seed):
    """A bright square moves from left to right before a background that flickers."""
    rng = np.random.default_rng(seed)
    image = np.empty((length + 1, 64, 64, 3), np.uint8)
    image[:] = rng.integers(0, 200, (length + 1, 1, 1, 1))
    row = rng.integers(0, 48)
    for t in range(length + 1):
        column = t * 48 // length
        image[t, row : row + 16, column : column + 16] = 250
    return replace(recorded(length, seed), image=image)


@pytest.mark.slow
def test_pre_training_aligns_held_out_clips(tmp_path):
    with TrajectoryDataset.create(tmp_path / "drift") as data:
        for seed in range(8):
            data.append(drift(16, seed))
    rng = np.random.default_rng(1)
    clips = draw_clips([drift(16, seed) for seed in range(100, 110)], 300, rng)
    order = (clips[:, 1] != clips[:, 2]).flatten(1).any(1)

    def share(model):
        with torch.no_grad():
            z = model.policy.encoder.features(clips.flatten(0, 1)).unflatten(0, (300, 3))
        return aligned(z[order]).item()

    settings = SETTINGS | {"learning_rate": 1e-3}
    before, after = (R3M.pretrain(data, steps=steps, **settings) for steps in (0, 150))
    assert share(before) < 0.7 and share(after) > 0.8


def test_pre_training_continues_exactly_from_its_model_file(dataset, tmp_path):
    whole = R3M.pretrain(dataset, steps=4, **SETTINGS)
    R3M.pretrain(dataset, steps=2, run_dir=tmp_path, **SETTINGS)
    resumed = R3M.pretrain(dataset, steps=4, run_dir=tmp_path, **SETTINGS)
    assert resumed.progress.pretrain_steps == 4 and same(weights(whole), weights(resumed))


def test_the_encoder_is_frozen_downstream_and_kept_by_new_tasks(dataset):
    model = R3M.pretrain(dataset, steps=2, **SETTINGS)
    before = weights(model)
    model.set_env(ClockEnv(actions=3))
    model.learn(42)
    assert model.updates > 0 and model.policy.actor.layers[-1].out_features == 3
    model.reset_task()
    model.learn(28)
    after = weights(model)
    frozen = {k for k in before if k.startswith("encoder")}
    assert frozen and all((before[k] == after[k]).all() for k in frozen)


def test_each_image_is_encoded_once_and_features_stand_for_images(dataset, monkeypatch):
    model = R3M.pretrain(dataset, steps=1, **SETTINGS)
    model.set_env(ClockEnv())
    encoded, encode = [], R3M._encode
    monkeypatch.setattr(R3M, "_encode", lambda m, x: encoded.append(len(x)) or encode(m, x))
    model.learn(42)
    assert encoded == [8] * 6
    batch = model.draw(model.replay_buffer, 4, 3)
    assert batch.image.shape == (4, 3, 512) and batch.image.dtype == torch.float16
    image = model.replay_buffer.trajectories[0].image[:3]
    with torch.no_grad():
        embed = model.policy.encoder(torch.from_numpy(image)[None])
        same_embed = model.policy.encoder(torch.from_numpy(model._encode(image))[None])
    torch.testing.assert_close(embed, same_embed, rtol=1e-2, atol=1e-2)


def test_features_are_computed_again_when_other_weights_are_loaded_in_place():
    model, other = (R3M("CnnPolicy", ClockEnv(), **SETTINGS | {"seed": seed}) for seed in (0, 1))
    model.learn(7)
    old = model.seen(model.replay_buffer)[0]
    model.set_parameters(other.get_parameters())
    new = model.seen(model.replay_buffer)[0]
    np.testing.assert_array_equal(new, other.seen(model.replay_buffer)[0])
    assert (old != new).any()


def test_a_loaded_model_goes_on_exactly(dataset, tmp_path):
    start = R3M.pretrain(dataset, steps=1, **SETTINGS)
    start.save(tmp_path / "start")
    whole = R3M.load(tmp_path / "start", env=ClockEnv(), device="cpu").learn(42)
    half = R3M.load(tmp_path / "start", env=ClockEnv(), device="cpu").learn(21)
    half.save(tmp_path / "half")
    half.save_replay_buffer(tmp_path / "replay.zip")
    loaded = R3M.load(tmp_path / "half", env=ClockEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    loaded.learn(21, reset_num_timesteps=False)
    assert same(weights(whole), weights(loaded))


def test_the_authors_weights_are_taken_and_must_fit_the_backbone(tmp_path):
    from wpt_agents.model.resnet import ResNet

    torch.manual_seed(3)
    named = {f"module.convnet.{k}": w for k, w in ResNet(18).state_dict().items()}
    torch.save({"r3m": named}, tmp_path / "r3m_18.pt")
    model = R3M("CnnPolicy", ClockEnv(), backbone="resnet18", **SETTINGS)
    model.load_weights(tmp_path / "r3m_18.pt")
    assert torch.equal(model.policy.encoder.body.conv1.weight, named["module.convnet.conv1.weight"])
    assert model.policy.encoder.embed_dim == 3 * 512
    with pytest.raises(ValueError, match="does not fit backbone='conv'"):
        R3M("CnnPolicy", ClockEnv(), **SETTINGS).load_weights(tmp_path / "r3m_18.pt")


def test_differences_of_frames_are_refused():
    with pytest.raises(ValueError, match="R3M encodes single images: leave it at 0"):
        R3M(frame_differences=4)
