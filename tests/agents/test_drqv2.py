"""DrQv2 as an SB3 algorithm: learning, callbacks, evaluation, model files, continuing exactly."""

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, on_time, same, weights
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import DotEnv

from wpt_agents.agents.drqv2 import DrQv2

SETTINGS = {
    "channels": 2,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 8,
    "learning_starts": 10,
    "warmup_steps": 20,
    "std": "linear(1,0.1,100)",
    "seed": 0,
    "device": "cpu",
}


def agent(env=None, **changes):
    return DrQv2("CnnPolicy", env, **SETTINGS | changes)


@pytest.mark.parametrize("n_envs", [1, 4])
@pytest.mark.parametrize("train_freq", ["step", "episode"])
def test_it_learns_from_one_and_from_four_environments(n_envs, train_freq):
    model = agent(DummyVecEnv([ClockEnv] * n_envs), train_freq=train_freq)
    before = weights(model)
    model.learn(84)
    assert model.num_timesteps == 84 and model.episodes == 12
    assert all(on_time(t) for t in model.replay_buffer.trajectories)
    changed = {k.split(".")[0] for k, w in weights(model).items() if (w != before[k]).any()}
    assert changed == {"encoder", "actor", "critic", "target_critic"}
    paid_for = (84 - 10 + n_envs - 1) // n_envs * n_envs / 2
    assert abs(model.updates - paid_for) <= n_envs


def test_nothing_is_learned_before_learning_starts_and_an_update_costs_two_steps():
    model = agent(ClockEnv(), learning_starts=30, train_freq="episode")
    model.learn(28)
    assert model.updates == 0
    model.learn(14, reset_num_timesteps=False)
    assert model.updates == 6  # for the steps 31 to 42


def test_the_noise_follows_the_schedule_and_the_warm_up_is_uniform():
    model = agent(ClockEnv(actions=6), std="linear(1,0,100)", warmup_steps=28)
    seen = []
    act = model.policy.act

    def recorded(*args, **kwargs):
        seen.append((model.num_timesteps, model.policy.std))
        return act(*args, **kwargs)

    model.policy.act = recorded
    model.learn(56)
    assert all(std == pytest.approx(1 - step / 100) for step, std in seen)
    actions = np.concatenate([t.action for t in model.replay_buffer.trajectories[:4]])
    assert actions.min() < -0.8 and actions.max() > 0.8 and abs(actions.mean()) < 0.1


def test_predict_is_the_mean_action_or_noisy_and_in_the_environments_bounds():
    model = agent(ClockEnv(low=0.0, high=4.0))
    image = model.env.reset()
    one, _ = model.predict(image, deterministic=True)
    again, state = model.predict(image, deterministic=True)
    noisy, _ = model.predict(image, deterministic=False)
    assert (one == again).all() and (one != noisy).any()
    assert state[0].shape == (1, 3, 64, 64, 3)
    with torch.no_grad():
        frames = torch.from_numpy(np.repeat(image[:, None], 3, 1))
        mean = model.policy.actor(model.policy.encoder(frames)).numpy()
    np.testing.assert_allclose(one, 2 * (mean + 1), rtol=1e-5)


def test_predict_has_the_noise_of_the_present_step_before_anything_is_learned():
    model = agent(ClockEnv(), std=0.0)
    image = ClockEnv().reset()[0]

    def noisy():
        actions = [model.predict(image, deterministic=choice)[0] for choice in (True, False)]
        return (actions[0] != actions[1]).any()

    assert not noisy()
    model.std = 0.5
    assert noisy()


def test_a_state_that_is_none_of_its_own_is_refused():
    model = agent(ClockEnv())
    image = ClockEnv().reset()[0]
    for state in ((), (image,), image):
        with pytest.raises(ValueError, match="pass the state that this model's own predict"):
            model.predict(image, state)


def test_sb3_evaluates_it_and_callbacks_see_and_stop_it():
    class Stop(BaseCallback):
        def _on_step(self):
            return self.num_timesteps < 40

    model = agent(DotEnv())
    model.learn(1000, callback=Stop())
    assert model.num_timesteps == 40
    mean, std = evaluate_policy(model, model.get_env(), 2)
    assert 0 < mean < 25 and np.isfinite(std)


@pytest.mark.parametrize("n_envs", [1, 4])
def test_a_loaded_model_acts_alike_and_goes_on_exactly(n_envs, tmp_path):
    def environments():
        return DummyVecEnv([ClockEnv] * n_envs)

    whole = agent(environments()).learn(42 * n_envs)
    half = agent(environments()).learn(21 * n_envs)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "replay.zip")
    loaded = DrQv2.load(tmp_path / "model", env=environments(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    assert same(weights(half), weights(loaded))
    image = ClockEnv().reset()[0]
    half.before_step()  # a loaded model explores with the next step's noise
    for deterministic in (True, False):
        torch.manual_seed(0)
        one, _ = half.predict(image, deterministic=deterministic)
        torch.manual_seed(0)
        other, _ = loaded.predict(image, deterministic=deterministic)
        assert (one == other).all()
    loaded.learn(21 * n_envs, reset_num_timesteps=False)
    assert loaded.progress == whole.progress and loaded.num_timesteps == 42 * n_envs
    assert same(weights(whole), weights(loaded))


def test_the_model_file_holds_no_pickle_and_other_classes_refuse_it(tmp_path):
    from wpt_agents.agents.wpt import WPT

    agent(ClockEnv()).save(tmp_path / "model.zip")
    assert b"pickle" not in (tmp_path / "model.zip").read_bytes()
    with pytest.raises(ValueError, match=r"is of DrQv2: read it with DrQv2.load"):
        WPT.load(tmp_path / "model.zip")


def test_another_action_width_draws_new_networks_and_forgets_the_task():
    model = agent(ClockEnv(actions=2)).learn(21)
    model.set_env(ClockEnv(actions=5))
    assert not model.replay_buffer.trajectories
    model.learn(42)
    assert model.replay_buffer.trajectories[0].action.shape[1] == 5
    assert model.policy.actor.layers[-1].out_features == 5


def test_a_changed_keyword_takes_effect_and_one_of_the_networks_size_is_refused():
    model = agent(ClockEnv())
    model.learning_rate = 0.5
    assert model.learner.actor_optimizer.param_groups[0]["lr"] == 0.5
    model.tau = 1.0
    model.learn(42)
    assert same(
        {k.removeprefix("critic"): v for k, v in weights(model, "critic").items()},
        {k.removeprefix("target_critic"): v for k, v in weights(model, "target_critic").items()},
    )
    with pytest.raises(ValueError, match="channels"):
        model.channels = 4
    with pytest.raises(ValueError, match="tau must be"):
        model.tau = 2.0


def test_it_can_be_made_without_an_environment():
    model = agent()
    model.set_env(ClockEnv(actions=3))
    model.learn(14)
    assert model.episodes == 2
