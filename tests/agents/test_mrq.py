"""MRQ as an SB3 algorithm: learning, model files, continuing exactly."""

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, on_time, same, weights
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.agents.mrq import MRQ

SETTINGS = {
    "channels": 2,
    "latent_dim": 8,
    "hidden_dim": 8,
    "batch_size": 4,
    "horizon": 3,
    "sync_every": 4,
    "learning_starts": 10,
    "warmup_steps": 14,
    "seed": 0,
    "device": "cpu",
}


class Stop(BaseException):
    """What Ctrl-C is."""


def agent(env=None, **changes):
    return MRQ("CnnPolicy", env, **SETTINGS | changes)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_it_learns_from_one_and_from_four_environments(n_envs):
    model = agent(DummyVecEnv([ClockEnv] * n_envs), update_every=4)
    before = weights(model)
    model.learn(84)
    assert model.num_timesteps == 84 and model.episodes == 12
    assert all(on_time(t) for t in model.replay_buffer.trajectories)
    changed = {k.split(".")[0] for k, w in weights(model).items() if (w != before[k]).any()}
    assert {"encoder", "actor", "value"} <= changed
    assert abs(model.updates - 74 / 4) <= n_envs


def test_targets_are_copied_and_rewards_measured_every_few_updates():
    model = agent(ClockEnv(), train_freq="episode", learning_starts=0, update_every=7)
    model.learn(7)
    assert (model.updates, model.progress.scale, model.progress.target_scale) == (1, 4.0, 1.0)
    model.learn(21, reset_num_timesteps=False)
    assert model.updates == 4 and model.progress.target_scale == 1.0
    assert not same(weights(model, "actor"), renamed(model, "target_actor", "actor"))
    model.learn(7, reset_num_timesteps=False)
    assert model.updates == 5 and model.progress.target_scale == 4.0


def test_an_interrupted_update_of_the_encoder_leaves_the_scales_alone(monkeypatch):
    model = agent(ClockEnv(), train_freq="episode", learning_starts=0, update_every=7)
    with monkeypatch.context() as patch:
        patch.setattr(model.learner, "update_encoder", lambda *_: (_ for _ in ()).throw(Stop))
        with pytest.raises(Stop):
            model.learn(7)
    model.learn(7, reset_num_timesteps=False)
    assert (model.progress.scale, model.progress.target_scale) == (4.0, 1.0)


def test_the_encoder_learns_first_in_every_task():
    model = agent(ClockEnv(), train_freq="episode", learning_starts=0, update_every=7)
    model.learn(14)
    model.reset_task()
    model.learn(7)
    assert model.updates == 3 and model.progress.scale == 4.0


def test_value_functions_learn_from_the_last_steps_of_episodes_that_terminate(monkeypatch):
    model = agent(ClockEnv(terminates=True), train_freq="episode", batch_size=64, update_every=7)
    seen, update = [], model.learner.update

    def recorded(batch, *args):
        seen.append(batch.image[:, -1, 0, 0, 0])
        return update(batch, *args)

    monkeypatch.setattr(model.learner, "update", recorded)
    model.learn(21)
    assert set(torch.cat(seen).tolist()) == {0, 1, 2, 3, 4, 5, 6}  # of seven steps


def renamed(model, old, new):
    return {k.replace(old, new): w for k, w in weights(model, old).items()}


def test_rewards_that_are_all_zero_are_no_division_by_zero():
    class Nothing(ClockEnv):
        def step(self, action):
            obs, _, *rest = super().step(action)
            return obs, 0.0, *rest

    model = agent(Nothing(), update_every=8).learn(28)
    assert all(w.isfinite().all() for w in weights(model).values())


def test_a_loaded_model_acts_alike_and_goes_on_exactly(tmp_path):
    whole = agent(ClockEnv()).learn(42)
    half = agent(ClockEnv()).learn(21)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "replay.zip")
    assert b"pickle" not in (tmp_path / "model.zip").read_bytes()
    loaded = MRQ.load(tmp_path / "model", env=ClockEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    image = ClockEnv().reset()[0]
    for deterministic in (True, False):
        torch.manual_seed(0)
        one, _ = half.predict(image, deterministic=deterministic)
        torch.manual_seed(0)
        other, _ = loaded.predict(image, deterministic=deterministic)
        assert (one == other).all()
    loaded.learn(21, reset_num_timesteps=False)
    assert loaded.progress == whole.progress and same(weights(whole), weights(loaded))


def test_it_is_evaluated_and_another_task_begins_with_new_networks():
    model = agent(ClockEnv(), update_every=4).learn(21)
    assert evaluate_policy(model, model.get_env(), 1)[0] == 28
    before = weights(model)
    model.reset_task()
    assert model.progress.scale == 1.0 and not same(before, weights(model))
    model.set_env(ClockEnv(actions=5))
    assert model.learn(14).replay_buffer.trajectories[0].action.shape[1] == 5


def test_each_rate_reaches_its_own_optimisers():
    model = agent(ClockEnv())
    model.learning_rate = 0.5
    model.encoder_learning_rate = 0.25
    model.weight_decay = 0.125
    rates = {
        name: (group["lr"], group["weight_decay"])
        for name in ("encoder", "value", "actor")
        for group in getattr(model.learner, f"{name}_optimizer").param_groups
    }
    assert rates == {"encoder": (0.25, 0.125), "value": (0.5, 0.125), "actor": (0.5, 0.125)}
    model.std = 0.0
    image = ClockEnv().reset()[0]
    noisy, _ = model.predict(image, deterministic=False)
    assert (noisy == model.predict(image, deterministic=True)[0]).all() and np.isfinite(noisy).all()
