"""R3M: pre-training aligns features in time; downstream they are frozen and computed once."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from debug_agent import ClockEnv, recorded, same, weights
from plain import Adam, parameters

from wpt_agents.agents import r3m
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
    rng, unseen = np.random.default_rng(1), [drift(16, seed).image for seed in range(100, 110)]
    clips = draw_clips(np.full(10, 16), lambda i, times: unseen[i][times], 300, rng)
    order = (clips[:, 1] != clips[:, 2]).flatten(1).any(1)

    def share(model):
        with torch.no_grad():
            z = model.policy.encoder.features(clips.flatten(0, 1)).unflatten(0, (300, 3))
        return aligned(z[order]).item()

    settings = SETTINGS | {"learning_rate": 1e-3}
    before, after = (R3M.pretrain(data, steps=steps, **settings) for steps in (0, 500))
    assert share(before) < 0.7 and share(after) > 0.8


def plain_features(w, image):
    """The features of single images (N, 64, 64, 3), written out."""
    x = image.permute(0, 3, 1, 2) / 255 - 0.5
    for i, stride in enumerate((2, 1, 1, 1)):
        x = F.conv2d(x, w[f"body.0.layers.{i}.weight"], w[f"body.0.layers.{i}.bias"], stride=stride)
        x = x * (x > 0)
    return x.reshape(len(x), -1) @ w["body.1.weight"].T + w["body.1.bias"]


def plain_loss(w, clips, others):
    """R3M's loss without language, written out."""
    z = [plain_features(w, clips[:, k]) for k in range(3)]

    def likeness(one, other):
        return torch.exp(-((one - other) ** 2).sum(1).sqrt())

    loss, far = 0.0, likeness(z[0], z[2])
    for near, anchor in ((likeness(z[1], z[2]), z[2]), (likeness(z[0], z[1]), z[0])):
        elsewhere = sum(likeness(anchor, anchor[row]) for row in others)
        loss = loss - torch.log(near / (near + far + elsewhere)).mean() / 2
    every = torch.cat(z)
    return loss + 1e-5 * (every.abs().sum(1).mean() + (every**2).sum(1).sqrt().mean())


def test_three_updates_of_pre_training_equal_a_plain_second_implementation():
    model = R3M("CnnPolicy", ClockEnv(), **SETTINGS)
    w = parameters(model.policy.encoder)
    adam, others = Adam(1e-4, w), torch.tensor([[1, 2, 3, 0], [2, 3, 0, 1]])
    actor = weights(model, "actor", "critic")
    for seed in range(3):
        rng = np.random.default_rng(seed)
        clips = torch.from_numpy(rng.uniform(0, 255, (4, 3, 64, 64, 3)).astype(np.float32))
        model.learner.pretrain(clips, others)
        adam.descend(plain_loss(w, clips, others))
    for name, weight in model.policy.encoder.named_parameters():
        off = (weight - w[name]).abs() > 1e-5  # a tenth of a step
        # The loss looks at differences of features, so the last bias has hardly a gradient, whose
        # rounding Adam enlarges to a whole step.
        assert off.float().mean() <= (0.02 if name == "body.1.bias" else 0.0), name
    assert same(actor, weights(model, "actor", "critic"))


def test_pre_training_continues_exactly_from_its_model_file(dataset, tmp_path):
    whole = R3M.pretrain(dataset, steps=4, **SETTINGS)
    R3M.pretrain(dataset, steps=2, run_dir=tmp_path, **SETTINGS)
    resumed = R3M.pretrain(dataset, steps=4, run_dir=tmp_path, **SETTINGS)
    assert resumed.progress.pretrain_steps == 4 and same(weights(whole), weights(resumed))


def test_data_that_do_not_fit_into_memory_are_read_in_every_update_with_the_same_result(
    dataset, monkeypatch
):
    whole = R3M.pretrain(dataset, steps=2, **SETTINGS)
    size = int((dataset.lengths + 1).sum()) * 64 * 64 * 3
    monkeypatch.setattr(r3m, "IN_MEMORY", size - 1)
    monkeypatch.setattr(TrajectoryDataset, "__getitem__", lambda *_: pytest.fail("reads them all"))
    part = R3M.pretrain(dataset, steps=2, **SETTINGS)
    assert same(weights(whole), weights(part))
    monkeypatch.setattr(r3m, "IN_MEMORY", size)
    with pytest.raises(pytest.fail.Exception):
        R3M.pretrain(dataset, steps=1, **SETTINGS)


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


def test_the_authors_weights_are_taken_and_must_fit_the_backbone(dataset, tmp_path):
    from wpt_agents.model.resnet import ResNet

    torch.manual_seed(3)
    named = {f"module.convnet.{k}": w for k, w in ResNet(18).state_dict().items()}
    file = tmp_path / "r3m_18.pt"
    torch.save({"r3m": named}, file)
    settings = SETTINGS | {"backbone": "resnet18", "weights": str(file)}
    model = R3M.pretrain(dataset, ClockEnv(), steps=3, run_dir=tmp_path / "run", **settings)
    file.unlink()
    loaded = R3M.load(tmp_path / "run" / "model.zip", device="cpu")
    for one in (model, loaded):
        assert one.progress.pretrain_steps == 0 and one.policy.encoder.embed_dim == 3 * 512
        body = one.policy.encoder.body.state_dict()
        assert all(torch.equal(w, named[f"module.convnet.{k}"]) for k, w in body.items())
    del named["module.convnet.layer4.1.bn2.weight"]
    torch.save({"r3m": named}, file)
    with pytest.raises(ValueError, match=r"r3m_18\.pt does not fit backbone='resnet18'"):
        model.load_weights(file)
    with pytest.raises(ValueError, match="does not fit backbone='conv'"):
        R3M("CnnPolicy", ClockEnv(), **SETTINGS, weights=str(file))


def test_differences_of_frames_are_refused():
    with pytest.raises(ValueError, match="R3M encodes single images: leave it at 0"):
        R3M(frame_differences=4)
