"""JSRL-BC: a clone drives the first steps of each episode, for a random number of steps."""

import numpy as np
import pytest
from debug_agent import ClockEnv, recorded, same, weights
from toy_env import DotEnv

from wpt_agents.agents import jsrl
from wpt_agents.agents.jsrl import HORIZONS, JSRL
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.training.cloning import clone

SETTINGS = {
    "channels": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 4,
    "learning_starts": 10,
    "std": 1.0,
    "bc_size": "debug",
    "bc_steps": 3,
    "bc_batch_size": 4,
    "embodiment": "dot",
    "seed": 0,
    "device": "cpu",
}


@pytest.fixture
def dataset(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as made:
        for seed in range(3):
            made.append(recorded(12, seed, embodiment="dot"))
    return made


def agent(dataset, env=None, **changes):
    return JSRL("CnnPolicy", env or ClockEnv(60), dataset=dataset, **SETTINGS | changes)


def test_the_horizons_are_eleven_and_equally_likely(dataset):
    model = agent(dataset)
    model.progress.cloned = True
    drawn = [model.guidance_window(np.random.default_rng(i)) for i in range(5500)]
    assert {start for start, _ in drawn} == {0}
    counts = np.bincount([stop for _, stop in drawn], minlength=101)
    assert set(np.flatnonzero(counts)) == set(HORIZONS) == set(range(0, 101, 10))
    assert (np.abs(counts[HORIZONS] - 500) < 110).all()


@pytest.mark.parametrize("horizon", [0, 10, 100])
def test_the_clone_drives_exactly_the_first_steps_and_they_are_learned_from(
    dataset, monkeypatch, horizon
):
    model, guided = agent(dataset, learning_starts=1000), []
    guide = JSRL.guide

    def recorded_guide(self, frames):
        action = guide(self, frames)
        guided.append((int(frames[0, -1, 0, 0, 0]), action[0]))
        return action

    monkeypatch.setattr(JSRL, "guide", recorded_guide)
    monkeypatch.setattr(model, "guidance_window", lambda rng: (0, horizon))
    model.learn(60)
    steps = [step for step, _ in guided]
    assert steps == list(range(min(horizon, 60)))
    (episode,) = model.replay_buffer.trajectories
    for step, action in guided:
        np.testing.assert_array_equal(episode.action[step], action)


def test_the_clone_learns_from_the_robots_trajectories_and_is_offered_as_prior(
    dataset, monkeypatch
):
    model, cloned = agent(dataset), []

    def recorded_clone(actor, trajectories, *args):
        cloned.extend(trajectories)
        return clone(actor, trajectories, *args)

    monkeypatch.setattr(jsrl, "clone", recorded_clone)
    assert model.prior is None
    before = weights(model, "prior_actor")
    model.learn(60)
    assert model.progress.retrieved_ids == [0, 1, 2]
    assert not same(before, weights(model, "prior_actor"))
    action, _ = model.prior.predict(DotEnv().reset(seed=0)[0])
    assert action.shape == (2,)
    assert len(cloned) == 3 and all(t.reward is None for t in cloned)
    assert model.retrieved is None  # nothing else is learned from them
    for name in ("bc_steps", "num_retrieve"):
        with pytest.raises(ValueError, match=r"the clone is trained; call reset_task\(\) first"):
            setattr(model, name, 2)


def test_a_loaded_model_goes_on_exactly_without_cloning_again(dataset, tmp_path, monkeypatch):
    whole = agent(dataset).learn(180)
    half = agent(dataset).learn(60)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "replay.zip")
    loaded = JSRL.load(tmp_path / "model", env=ClockEnv(60), dataset=dataset, device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    monkeypatch.setattr("wpt_agents.agents.jsrl.clone", lambda *_: pytest.fail("clones again"))
    loaded.learn(120, reset_num_timesteps=False)
    assert same(weights(whole), weights(loaded))


def test_trajectories_of_another_dataset_are_cloned_again(dataset):
    model = agent(dataset).learn(60)
    clone = weights(model, "prior_actor")
    model.set_dataset([recorded(12, 7, embodiment="dot")])
    assert model.prior is not None
    model.bc_steps = 2
    model.learn(60, reset_num_timesteps=False)
    assert model.progress.retrieved_ids == [0] and model.progress.cloned
    assert not same(clone, weights(model, "prior_actor"))


@pytest.mark.filterwarnings("ignore:.*without offline data")
def test_a_warm_up_is_said_to_be_the_clones_if_there_is_one(dataset):
    with pytest.warns(UserWarning, match=r"nothing but the clone's actions: warmup_steps=100\."):
        agent(dataset, warmup_steps=100).learn(60)
    with pytest.warns(UserWarning, match="nothing but random actions"):
        agent(None, warmup_steps=100).learn(60)


def test_without_a_dataset_it_warns_and_learns_as_drqv2():
    with pytest.warns(UserWarning, match="without offline data"):
        model = agent(None).learn(60)
    assert model.prior is None and model.updates > 0
