"""RLPD as an SB3 algorithm, with its labels: true rewards, zero (UDS), optimistic (ExPLORe)."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, on_time, recorded, same, weights
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.agents.rlpd import RLPD
from wpt_agents.data.dataset import TrajectoryDataset

SETTINGS = {
    "channels": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
    "critics": 3,
    "reward_members": 3,
    "batch_size": 8,
    "learning_starts": 10,
    "warmup_steps": 20,
    "embodiment": "dot",
    "seed": 0,
    "device": "cpu",
}


def agent(env=None, dataset=None, **changes):
    return RLPD("CnnPolicy", env, dataset=dataset, **SETTINGS | changes)


@pytest.fixture
def dataset(tmp_path):
    def make(name="data", reward=7.0, n=4):
        with TrajectoryDataset.create(tmp_path / name) as made:
            for seed in range(n):
                one = recorded(seed=seed, embodiment="dot", task="push" if seed % 2 else "pull")
                rewards = None if reward is None else np.full(len(one), reward)
                made.append(replace(one, reward=rewards))
        return made

    return make


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("label", ["true", "zero", "optimistic"])
def test_it_learns_with_each_label_from_one_and_from_four_environments(n_envs, label, dataset):
    model = agent(DummyVecEnv([ClockEnv] * n_envs), dataset(), label=label)
    before = weights(model)
    model.learn(56)
    assert model.episodes == 8 and all(on_time(t) for t in model.replay_buffer.trajectories)
    changed = {k.split(".")[0] for k, w in weights(model).items() if (w != before[k]).any()}
    networks = {"encoder", "actor", "critic", "target_encoder", "target_critic", "log_alpha"}
    assert changed == networks | ({"reward_ensemble"} if label == "optimistic" else set())
    assert np.isfinite(evaluate_policy(model, ClockEnv(), 1, warn=False)[0])


@pytest.mark.parametrize(
    ("label", "reads"), [("true", True), ("zero", False), ("optimistic", False)]
)
def test_offline_rewards_are_read_by_the_true_label_alone(label, reads, dataset):
    learned = []
    for name, reward in (("one", 1.0), ("other", -1e4)):
        model = agent(ClockEnv(), dataset(name, reward), label=label)
        learned.append(weights(model.learn(28)))
    assert same(*learned) != reads


@pytest.mark.parametrize(("label", "known"), [("true", True), ("zero", False)])
def test_terminations_of_offline_data_are_known_with_their_rewards_alone(label, known, tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as data:
        one = recorded(embodiment="dot", terminated=True)
        data.append(replace(one, reward=np.ones(len(one))))
    model = agent(ClockEnv(), data, label=label).learn(7)
    batch = model.draw(model.retrieved, 100, 1)
    assert set(batch.discount.tolist()) == ({0.0} if known else set()) | {np.float32(0.99)}


def test_half_of_each_batch_is_offline_and_online_rewards_are_kept(dataset, monkeypatch):
    model = agent(ClockEnv(), dataset(), label="zero")
    seen, update = [], model.learner.update

    def recorded_update(batch, online, generator):
        seen.append((batch.reward.tolist(), online))
        return update(batch, online, generator)

    monkeypatch.setattr(model.learner, "update", recorded_update)
    model.learn(28)
    for reward, online in seen:
        assert online == 4 and len(reward) == 8
        assert all(r > 0 for r in reward[:4]) and reward[4:] == [0.0] * 4


@pytest.mark.parametrize("label", ["true", "optimistic"])
def test_a_batch_may_be_offline_altogether(label, dataset):
    model = agent(ClockEnv(), dataset(), label=label, offline_ratio=1)
    before = weights(model, "critic")
    assert model.learn(28).updates > 0 and not same(before, weights(model, "critic"))


def test_a_dataset_without_rewards_is_refused_by_the_true_label(dataset):
    with pytest.raises(ValueError, match=r"without rewards.*label='zero'"):
        agent(ClockEnv(), dataset(reward=None)).learn(14)


def test_without_a_dataset_it_warns_and_learns_from_the_environment_alone():
    model = agent(ClockEnv())
    with pytest.warns(UserWarning, match=r"without offline data"):
        model.learn(28)
    assert model.updates > 0 and model.retrieved is None


def test_it_uses_trajectories_of_the_task_or_else_of_the_robot(dataset):
    data = dataset()
    assert agent(ClockEnv(), data, task="push").learn(7).retrieved_ids == [1, 3]
    assert agent(ClockEnv(), data, task="lift").learn(7).retrieved_ids == [0, 1, 2, 3]
    assert len(agent(ClockEnv(), data, task="lift", num_retrieve=2).learn(7).retrieved_ids) == 2
    with pytest.raises(ValueError, match="Its tasks: pull, push; its robots: dot"):
        agent(ClockEnv(), data, task="lift", embodiment="arm").learn(7)


def test_data_that_are_set_later_take_the_place_of_those_that_were_chosen(dataset):
    model = agent(ClockEnv(), dataset(reward=1.0)).learn(7)
    model.set_dataset(dataset("other", reward=2.0, n=5))
    model.learn(7)
    assert len(model.retrieved.trajectories) == 5
    assert {t.reward[0] for t in model.retrieved.trajectories} == {2.0}


def test_data_whose_reading_was_interrupted_are_read_again_and_whole(dataset, monkeypatch):
    model = agent(ClockEnv(), dataset())

    def interrupted(trajectories, box):
        yield next(iter(trajectories))
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("wpt_agents.agents.frame_agent.in_units_of", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(7)
    assert len(model.learn(7).retrieved.trajectories) == 4
    model.set_dataset(dataset("other", n=2))
    with monkeypatch.context() as patch:
        patch.setattr("wpt_agents.agents.frame_agent.in_units_of", interrupted)
        with pytest.raises(KeyboardInterrupt):
            model.learn(7)
    assert len(model.learn(7).retrieved.trajectories) == 2


def test_the_number_of_trajectories_is_fixed_once_they_are_chosen(dataset, tmp_path):
    data = dataset()
    model = agent(ClockEnv(), data).learn(7)
    model.save(tmp_path / "model")
    loaded = RLPD.load(tmp_path / "model", dataset=data, device="cpu")
    for one in (model, loaded):
        with pytest.raises(ValueError, match=r"data are chosen; call reset_task\(\) first"):
            one.num_retrieve = 2
    loaded.set_dataset(dataset("other", reward=1.0))
    loaded.num_retrieve = 2
    loaded.set_env(ClockEnv())
    assert len(loaded.learn(7).retrieved_ids) == 2


def test_images_of_another_size_are_refused_before_anything_is_collected(tmp_path):
    one = recorded(embodiment="dot")
    with TrajectoryDataset.create(tmp_path / "wide", image_size=128) as wide:
        wide.append(replace(one, image=one.image.repeat(2, 1).repeat(2, 2)))
    with pytest.raises(ValueError, match=r"images of 128 pixels, agents take 64.*image_size=64"):
        agent(ClockEnv(), wide)


def test_offline_actions_are_brought_into_the_units_of_the_environment(tmp_path):
    one = recorded(length=30, embodiment="dot")
    with TrajectoryDataset.create(tmp_path / "unit") as unit:
        unit.append(replace(one, action=np.abs(one.action)))
    model = agent(ClockEnv(low=0.0), unit, label="zero")
    with pytest.warns(UserWarning, match="environment's own units"):
        model.learn(7)
    [read] = model.retrieved.trajectories
    np.testing.assert_allclose(read.action, 2 * np.abs(one.action) - 1, atol=1e-6)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_a_loaded_model_goes_on_exactly(n_envs, dataset, tmp_path):
    def environments():
        return DummyVecEnv([ClockEnv] * n_envs)

    data, settings = dataset(), {"label": "optimistic"}
    whole = agent(environments(), data, **settings).learn(42 * n_envs)
    half = agent(environments(), data, **settings).learn(21 * n_envs)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "replay.zip")
    loaded = RLPD.load(tmp_path / "model", env=environments(), dataset=data, device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    loaded.learn(21 * n_envs, reset_num_timesteps=False)
    assert whole.updates == loaded.updates > half.updates > 0
    assert same(weights(whole), weights(loaded))


def test_deterministic_actions_are_the_mode():
    model = agent(ClockEnv())
    image = model.env.reset()
    one, _ = model.predict(image, deterministic=True)
    with torch.no_grad():
        frames = torch.from_numpy(np.repeat(image[:, None], 3, 1))
        mean, _ = model.policy.actor(model.policy.encoder(frames))
    np.testing.assert_allclose(one, mean.tanh().numpy(), rtol=1e-5)
    assert (model.predict(image)[0] != one).any()
