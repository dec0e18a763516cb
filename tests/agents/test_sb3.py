"""What Stable-Baselines3 and its users expect of an algorithm, callback by callback."""

import threading
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, ClockEnv, agent, noise, on_time, same, weights
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.results_plotter import load_results
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
    VecVideoRecorder,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.model.prior_policy import PriorPolicy
from wpt_agents.training.learner import Learner
from wpt_agents.training.rollout import Rollout


def clocks(n=1, **kwargs):
    return DummyVecEnv([lambda: ClockEnv(**kwargs)] * n)


@pytest.fixture
def clock_id():
    gym.register("Clock-v0", entry_point=ClockEnv, max_episode_steps=7)
    yield "Clock-v0"
    del gym.registry["Clock-v0"]


# ------------------------------------------------------------------------ spaces, environments


def test_without_an_environment_the_spaces_are_the_padded_ones():
    model = agent()
    assert model.observation_space == spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert model.action_space == spaces.Box(-1, 1, (4,)) and model.n_envs == 1
    assert model.get_env() is None
    assert model.predict(noise(2))[0].shape == (2, 4)


def test_environments_go_by_their_ids(clock_id, tmp_path):
    model = agent(clock_id)
    model.set_env(clock_id)
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", env=clock_id).learn(7)
    assert loaded.num_timesteps == 7 and loaded.get_env().num_envs == 1


@pytest.mark.parametrize("n", [1, 4])
def test_it_learns_in_a_dummy_vec_env(n):
    model = agent(clocks(n)).learn(28 * n)
    assert len(model.replay_buffer.trajectories) == 4 * n and model.updates > 0
    assert all(on_time(t) for t in model.replay_buffer.trajectories)


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
@pytest.mark.parametrize("n", [1, 4])
def test_it_learns_in_a_subproc_vec_env(n):
    env = SubprocVecEnv([DotEnv] * n, start_method="fork")
    try:
        model = agent(env).learn(2 * LENGTH * n)
        mean, _ = evaluate_policy(model, env, n, warn=False)
    finally:
        env.close()
    assert len(model.replay_buffer.trajectories) == 2 * n and 0 < mean < LENGTH
    in_one_process = agent(DummyVecEnv([DotEnv] * n)).learn(2 * LENGTH * n)
    assert same(weights(model), weights(in_one_process))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_updates_beside_the_steps_of_a_process_learn_what_they_learn_in_one():
    worker = SubprocVecEnv([DotEnv], start_method="fork")
    try:
        beside = agent(worker, train_freq="step").learn(3 * LENGTH)
    finally:
        worker.close()
    alone = agent(DummyVecEnv([DotEnv]), train_freq="step").learn(3 * LENGTH)
    assert same(weights(beside), weights(alone)) and beside.updates == alone.updates > 0
    assert not same(weights(agent(DummyVecEnv([DotEnv])).learn(3 * LENGTH)), weights(alone))


def test_updates_of_every_step_are_as_many_as_those_of_every_episode(monkeypatch):
    made, update = [], WPT.update

    def noted(model, metrics):
        made.append(model.num_timesteps)
        update(model, metrics)

    monkeypatch.setattr(WPT, "update", noted)
    agent(DotEnv(), train_freq="step", train_ratio=4).learn(3 * LENGTH)
    by_step, made[:] = list(made), []
    agent(DotEnv(), train_ratio=4).learn(3 * LENGTH)
    assert len(by_step) == len(made) and set(made) <= {LENGTH, 2 * LENGTH, 3 * LENGTH}
    assert len(set(by_step)) > LENGTH


def test_a_step_whose_updates_fail_is_not_taken_for_the_next(monkeypatch):
    worker = SubprocVecEnv([ClockEnv] * 2)
    try:
        model = agent(worker, train_freq="step")
        with monkeypatch.context() as patch, pytest.raises(FloatingPointError):
            patch.setattr(Learner, "descend", not_finite)
            model.learn(100)
        model.learn(28, reset_num_timesteps=False)
    finally:
        worker.close()
    assert all(on_time(t) for t in model.replay_buffer.trajectories)


def not_finite(*_):
    raise FloatingPointError


def test_a_worker_that_dies_is_told_and_learning_goes_on_in_new_ones():
    env = SubprocVecEnv([DotEnv] * 2)  # forked workers would hold each other's pipes open: no end
    model, killer = agent(env), KillWorker(env.processes[1], step=2 * LENGTH + 10)
    with pytest.raises(RuntimeError, match=r"worker process.*died.*set_env"):
        model.learn(8 * LENGTH, callback=killer)
    assert len(model.replay_buffer.trajectories) == 2
    model.set_env(clocks(2))
    assert model.learn(14, reset_num_timesteps=False).episodes == 4


class KillWorker(BaseCallback):
    def __init__(self, process, step):
        super().__init__()
        self.process, self.step = process, step

    def _on_step(self):
        if self.num_timesteps == self.step:
            self.process.kill()
            self.process.join()
        return True


def test_another_number_of_environments_is_taken_midway():
    model = agent(clocks(2)).learn(20)
    model.set_env(clocks(3))
    model.learn(21, reset_num_timesteps=False)
    model.set_env(ClockEnv())
    model.learn(7, reset_num_timesteps=False)
    assert model.n_envs == 1 and model.num_timesteps == 48
    # 20 steps of 2: one episode each; 21 of 3: one each; 7 of 1: one
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 6


def test_a_reset_can_be_spared_when_the_environment_is_set_again():
    model = agent(ClockEnv()).learn(7)
    model.set_env(model.get_env(), force_reset=False)
    model.learn(7, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 2


def test_another_number_of_environments_is_reset_in_any_case():
    model = agent(clocks(1)).learn(10)
    model.set_env(clocks(3), force_reset=False)
    model.learn(21, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 4


def test_attributes_that_are_set_on_a_vec_env_reach_its_environments():
    env = clocks(2)
    model = agent(env)
    env.set_attr("length", 3, indices=1)
    assert env.get_attr("length") == [7, 3]
    model.learn(14)
    assert sorted(len(t) for t in model.replay_buffer.trajectories) == [3, 3, 7]


def test_attributes_that_are_set_reach_the_environment_below_all_wrappers():
    env = ClockEnv()
    env._private = 1
    vec_env = agent(env).get_env()
    for name in ("length", "_private"):
        vec_env.set_attr(name, 3)
        assert getattr(env, name) == vec_env.get_attr(name)[0] == 3


@pytest.mark.parametrize(
    "make", [ClockEnv, lambda: gym.make_vec("Clock-v0", 2), lambda: VecMonitor(clocks(2))]
)
def test_after_an_evaluation_on_its_own_environment_new_episodes_begin(make, clock_id):
    model = agent(make()).learn(8)  # in the middle of episodes
    evaluate_policy(model, model.get_env(), 1, warn=False)
    model.learn(28, reset_num_timesteps=False)
    episodes = model.replay_buffer.trajectories
    assert len(episodes) >= 3 and all(on_time(t) for t in episodes)


@pytest.mark.filterwarnings("ignore:Evaluation environment")
def test_an_evaluation_by_a_callback_on_the_same_environment_mixes_no_episodes():
    model = agent(ClockEnv())
    callback = EvalCallback(model.get_env(), n_eval_episodes=1, eval_freq=10, verbose=0)
    model.learn(28, callback=callback)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 3


def test_options_for_the_next_reset_end_no_episode():
    model = agent(ClockEnv()).learn(8)
    model.get_env().set_options({"level": 2})
    model.learn(6, reset_num_timesteps=False)
    assert [len(t) for t in model.replay_buffer.trajectories] == [7, 7]


@pytest.mark.parametrize("bounds", [(-0.3, 0.7), (0.0, 10.0), (-1.0, 1.0)])
def test_actions_are_scaled_to_the_bounds_of_the_environment(bounds):
    env = ClockEnv(low=bounds[0], high=bounds[1])  # it asserts that its space holds each action
    model = agent(env).learn(14)
    evaluate_policy(model, env, 2, warn=False, deterministic=False)
    stored = np.concatenate([t.action for t in model.replay_buffer.trajectories])
    assert stored.min() < -0.5 and stored.max() > 0.5  # [-1, 1] whatever the bounds
    action = model.policy.to_env(np.array([[-1, 1, 0, 0], [0, 0, 0, 0]], np.float32))
    np.testing.assert_allclose(action, [bounds, [np.mean(bounds)] * 2], atol=1e-6)


class Moved(gym.ObservationWrapper):
    """Channels first."""

    def __init__(self, env):
        super().__init__(env)
        self.observation_space = spaces.Box(0, 255, (3, 64, 64), np.uint8)

    def observation(self, observation):
        return observation.transpose(2, 0, 1)


@pytest.mark.parametrize("env", [Moved(ClockEnv()), VecTransposeImage(clocks())])
def test_images_may_come_channels_first(env):
    with warnings.catch_warnings(action="error"):
        settings = {"offline_ratio": 0, "guidance": 0, "train_ratio": 2, "warmup_steps": 0}
        model = agent(env, **settings).learn(14)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 2
    evaluate_policy(model, env, 1, warn=False)
    ways = [
        model.predict(x, deterministic=True)[0]
        for image in [noise()]
        for x in (image, image.transpose(2, 0, 1), image[None].transpose(0, 3, 1, 2))
    ]
    np.testing.assert_array_equal(ways[0], ways[1])
    np.testing.assert_array_equal(ways[0], ways[2][0])


@pytest.mark.parametrize("size", [48, 100])
def test_images_of_another_size_are_resized_and_it_says_so(size):
    env = DotEnv(size=size)
    with pytest.warns(UserWarning, match=rf"Images of {size} x {size} are resized to 64 x 64"):
        model = agent(env)
    model.learn(LENGTH)
    evaluate_policy(model, env, 1, warn=False)
    [trajectory] = model.replay_buffer.trajectories
    assert trajectory.image.shape == (LENGTH + 1, 64, 64, 3)
    assert trajectory.image.max() == 250 and trajectory.image.min() == 30  # the dot, the ground


def test_reading_an_observation_that_may_not_be_written_is_silent():
    image = np.broadcast_to(np.uint8(3), (64, 64, 3))
    assert agent().predict(image)[0].shape == (4,)


# ---------------------------------------------------------------------------- recurrent state


def test_a_single_observation_keeps_the_batch_axis_of_its_state():
    model = agent()
    action, state = model.predict(noise())
    assert action.shape == (4,) and [len(x) for x in state] == [1, 1, 1]
    assert all(x.dtype == np.float32 for x in state)
    assert model.predict(noise(seed=1), state)[0].shape == (4,)


def test_the_state_matters_and_no_episode_start_means_that_none_begins():
    model = agent()
    _, state = model.predict(noise(2), deterministic=True)
    image = noise(2, seed=1)
    fresh, follows, said = (
        model.predict(image, *arguments, deterministic=True)[1][0]
        for arguments in ((), (state,), (state, np.zeros(2, bool)))
    )
    assert not np.allclose(fresh, follows)
    np.testing.assert_array_equal(follows, said)


def test_an_episode_start_forgets_its_own_row_and_no_other():
    model, image = agent(), noise(2, seed=1)
    _, state = model.predict(noise(2), deterministic=True)
    fresh = model.predict(image, deterministic=True)[1]
    follows = model.predict(image, state, deterministic=True)[1]
    mixed = model.predict(image, state, np.array([True, False]), deterministic=True)[1]
    for ours, first, later in zip(mixed, fresh, follows, strict=True):
        np.testing.assert_allclose(ours, np.stack([first[0], later[1]]), atol=1e-6)


def test_predict_leaves_what_it_is_given_alone():
    model, start = agent(), np.array([True, False])
    _, state = model.predict(noise(2))
    before = [x.copy() for x in state]
    model.predict(noise(2, seed=1), state, start)
    assert start.tolist() == [True, False]
    for was, now in zip(before, state, strict=True):
        np.testing.assert_array_equal(was, now)


def test_a_state_of_other_environments_is_refused():
    _, state = (model := agent()).predict(noise(3))
    with pytest.raises(ValueError, match="state is of 3 environments, the observation of 2"):
        model.predict(noise(2), state)


def test_the_prior_actor_remembers_three_images_of_each_episode():
    model = agent(ClockEnv(), warmup_steps=0)
    model.cloned = True
    clock = [np.full((1, 64, 64, 3), t, np.uint8) for t in range(5)]
    state = None
    for image in clock[:4]:
        _, state = model.prior.predict(image, state)
    assert state[0][0, :, 0, 0, 0].tolist() == [1, 2, 3]
    _, state = model.prior.predict(clock[4], state, np.array([True]))
    assert state[0][0, :, 0, 0, 0].tolist() == [4, 4, 4]


def test_setting_an_environment_forgets_the_open_episode():
    model = agent(clocks(2)).learn(4)
    assert isinstance(model.rollout, Rollout)
    model.set_env(clocks(4))
    assert model.rollout is None and model._last_obs is None


# --------------------------------------------------------------------------------- evaluation


def by_hand(model, env, episodes):
    returns = []
    for _ in range(episodes):
        (obs, _), state, over, total = env.reset(), None, False, 0.0
        while not over:
            action, state = model.predict(obs, state, deterministic=True)
            obs, reward, terminated, truncated, _ = env.step(action)
            total, over = total + reward, terminated or truncated
        returns.append(total)
    return returns


def test_evaluate_policy_measures_what_a_plain_loop_does():
    model, env = agent(DotEnv()), Monitor(DotEnv())
    env.reset(seed=5)
    returns, lengths = evaluate_policy(model, env, 3, return_episode_rewards=True)
    env.reset(seed=5)
    np.testing.assert_allclose(by_hand(model, env, 3), returns, atol=1e-5)
    assert lengths == [LENGTH] * 3


@pytest.mark.parametrize("n", [1, 4])
def test_evaluate_policy_works_in_several_environments(n):
    rewards, lengths = evaluate_policy(
        agent(clocks(n)), VecMonitor(clocks(n)), 5, return_episode_rewards=True
    )
    assert rewards == [28.0] * 5 and lengths == [7] * 5


@pytest.mark.parametrize("deterministic", [True, False])
def test_evaluating_in_the_middle_of_rollouts_changes_nothing(tmp_path, deterministic):
    plain = agent(DotEnv()).learn(3 * LENGTH)
    model, env = agent(DotEnv()), Monitor(DotEnv())
    callback = EvalCallback(
        env,
        n_eval_episodes=1,
        eval_freq=11,
        best_model_save_path=tmp_path,
        log_path=tmp_path,
        deterministic=deterministic,
        verbose=0,
    )
    model.learn(3 * LENGTH, callback=callback)
    assert same(weights(model), weights(plain))
    for one, other in zip(
        model.replay_buffer.trajectories, plain.replay_buffer.trajectories, strict=True
    ):
        np.testing.assert_array_equal(one.action, other.action)
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [11, 22, 33, 44, 55, 66]
    assert WPT.load(tmp_path / "best_model").policy.action_space.shape == (2,)


def test_evaluating_after_every_step_changes_nothing():
    plain = agent(ClockEnv()).learn(35)
    model = agent(ClockEnv())
    callback = EvalCallback(Monitor(ClockEnv()), n_eval_episodes=1, eval_freq=1, verbose=0)
    model.learn(35, callback=callback)
    assert callback.n_calls == 35 and callback.last_mean_reward == 28
    assert same(weights(model), weights(plain)) and model.updates == plain.updates > 0
    for one, other in zip(
        model.replay_buffer.trajectories, plain.replay_buffer.trajectories, strict=True
    ):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.action, other.action)


def test_evaluating_several_environments_changes_nothing_in_several(tmp_path):
    plain = agent(clocks(3)).learn(42)
    env = DummyVecEnv([lambda: Monitor(ClockEnv())] * 2)
    callback = EvalCallback(env, eval_freq=4, n_eval_episodes=2, verbose=0)
    assert same(weights(agent(clocks(3)).learn(42, callback=callback)), weights(plain))
    assert callback.last_mean_reward == 28


# ---------------------------------------------------------------------------------- callbacks


def test_checkpoints_hold_the_model_and_its_replay(tmp_path):
    model = agent(ClockEnv())
    model.learn(14, callback=CheckpointCallback(7, tmp_path, save_replay_buffer=True))
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "rl_model_14_steps.zip",
        "rl_model_7_steps.zip",
        "rl_model_replay_buffer_14_steps.pkl",
        "rl_model_replay_buffer_7_steps.pkl",
    ]
    loaded = WPT.load(tmp_path / "rl_model_7_steps", env=ClockEnv(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_7_steps.pkl")
    assert loaded.num_timesteps == len(loaded.replay_buffer) == 7
    loaded.learn(7, reset_num_timesteps=False)
    assert same(weights(loaded), weights(model))


def test_training_stops_at_a_reward_threshold():
    stop = StopTrainingOnRewardThreshold(28, verbose=0)
    callback = EvalCallback(Monitor(ClockEnv()), stop, eval_freq=10, verbose=0)
    assert agent(ClockEnv()).learn(100, callback=callback).num_timesteps == 10


def test_training_stops_after_some_episodes():
    model = agent(clocks(2)).learn(100, callback=StopTrainingOnMaxEpisodes(2))
    assert model.num_timesteps == 28 and len(model.replay_buffer.trajectories) == 4


class Record(BaseCallback):
    """The order of the calls, and what the steps can see."""

    def __init__(self):
        super().__init__()
        self.calls, self.seen = [], {}

    def _init_callback(self):
        self.calls.append("init")

    def _on_training_start(self):
        self.calls.append("training_start")
        self.total = self.locals["total_timesteps"]

    def _on_rollout_start(self):
        self.calls.append("rollout_start")

    def _on_step(self):
        self.calls.append("step")
        self.seen = self.locals
        return True

    def _on_rollout_end(self):
        self.calls.append("rollout_end")

    def _on_training_end(self):
        self.calls.append("training_end")


def test_callbacks_come_in_order_and_see_the_step():
    record = Record()
    model = agent(ClockEnv()).learn(8, callback=record)
    assert record.calls == [
        *("init", "training_start"),
        *("rollout_start", *["step"] * 7, "rollout_end"),
        *("rollout_start", "step", "rollout_end"),
        "training_end",
    ]
    assert record.total == 8 and record.seen["self"] is model
    assert record.seen["rewards"].tolist() == [1] and record.seen["dones"].tolist() == [False]
    assert record.seen["new_obs"].shape == (1, 64, 64, 3) and len(record.seen["infos"]) == 1
    assert record.seen["actions"].shape == (1, 2)


def test_callbacks_may_be_a_list_or_a_function():
    seen = []

    def look(local, _):
        seen.append(local["self"].num_timesteps)
        return True

    agent(ClockEnv()).learn(3, callback=look)
    assert seen == [1, 2, 3]
    both = [Record(), Record()]
    agent(ClockEnv()).learn(3, callback=both)
    assert both[0].calls == both[1].calls


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_the_progress_bar_counts_steps_and_survives_an_exception(capfd):
    def fail(*_):
        raise RuntimeError("stop here")

    model = agent(clocks(2))
    with pytest.raises(RuntimeError, match="stop here"):
        model.learn(14, callback=fail, progress_bar=True)
    model.learn(14, progress_bar=True)
    assert "14/14" in "".join(capfd.readouterr())


# ------------------------------------------------------------------------------------ logging

KEYS = {
    *("rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate", "time/fps"),
    *("train/value", "train/entropy", "train/saturated_actions", "train/kl"),
    *("train/reward_loss", "train/reconstruction_loss", "train/actor_grad_norm"),
}


def test_tensorboard_gets_the_curves(tmp_path):
    model = agent(ClockEnv(), tensorboard_log=str(tmp_path), train_ratio=4)
    model.learn(28, log_interval=1, tb_log_name="run").logger.close()
    events = EventAccumulator(str(tmp_path / "run_1")).Reload()
    assert set(events.Tags()["scalars"]) >= KEYS
    assert [e.step for e in events.Scalars("rollout/ep_rew_mean")] == [7, 14, 21, 28]
    assert [e.value for e in events.Scalars("rollout/ep_rew_mean")] == [28] * 4
    assert events.Scalars("rollout/success_rate")[-1].value == 1


def test_a_logger_of_ones_own_is_kept(tmp_path):
    model = agent(clocks(2))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(56, log_interval=2).logger.close()
    table = np.genfromtxt(tmp_path / "progress.csv", delimiter=",", names=True)
    assert table["timetotal_timesteps"].tolist() == [14, 28, 42, 56]


def test_monitor_writes_every_episode_once(tmp_path):
    env = Monitor(ClockEnv(), str(tmp_path / "0"))
    agent(env).learn(21)
    env.close()
    assert load_results(str(tmp_path))["r"].tolist() == [28, 28, 28]


def test_a_video_of_the_policy_can_be_recorded(tmp_path):
    model = agent(DotEnv())
    env = VecVideoRecorder(
        DummyVecEnv([DotEnv]), str(tmp_path), lambda step: step == 0, video_length=5
    )
    obs, state = env.reset(), None
    for _ in range(6):
        action, state = model.predict(obs, state)
        obs, *_ = env.step(action)
    env.close()
    assert [p.suffix for p in tmp_path.iterdir()] == [".mp4"]


def test_normalised_rewards_are_what_it_learns_from():
    env = VecNormalize(clocks(), norm_obs=False, clip_reward=0.5)
    model = agent(env).learn(7)
    assert model.get_vec_normalize_env() is env
    assert model.replay_buffer.trajectories[0].reward.max() <= 0.5


# ------------------------------------------------------------------------------ the remainder


def test_nothing_but_what_is_named_goes_into_the_file(tmp_path):
    model = agent()
    model.lock = threading.Lock()  # SB3 pickles every attribute, and fails on this one
    model.save(tmp_path / "model")
    assert not hasattr(WPT.load(tmp_path / "model"), "lock")


def test_a_compiled_part_saves_under_its_plain_names(tmp_path):
    model = agent()
    model.policy.actor = torch.compile(model.policy.actor, backend="eager")
    model.save(tmp_path / "model")
    loaded = weights(WPT.load(tmp_path / "model"))
    assert same(loaded, {k.replace("_orig_mod.", ""): v for k, v in weights(model).items()})


def test_the_zoo_of_sb3_makes_and_loads_it_by_its_own_keywords(tmp_path):
    model = WPT(policy="WPTPolicy", env=ClockEnv(), tensorboard_log=None, verbose=0, **SETTINGS)
    model.save(tmp_path / "model")
    keywords = {"seed": 3, "tensorboard_log": str(tmp_path), "verbose": 0, "gamma": 0.9}
    loaded = WPT.load(tmp_path / "model.zip", env=ClockEnv(), custom_objects={}, **keywords)
    assert (loaded.seed, loaded.gamma, loaded.tensorboard_log) == (3, 0.9, str(tmp_path))


def test_custom_objects_replace_keywords_of_the_file(tmp_path):
    agent().save(tmp_path / "model")
    custom = {"gamma": 0.9, "lam": 0.8, "lr_schedule": lambda _: 0.0, "clip_range": 0.2}
    loaded = WPT.load(tmp_path / "model", custom_objects=custom, lam=0.7)
    assert (loaded.gamma, loaded.lam) == (0.9, 0.7)  # a keyword of `load` comes first


@pytest.mark.parametrize("side", [64, 32])
@pytest.mark.parametrize("ibrl", [False, True])
def test_of_no_observations_there_are_no_actions(side, ibrl):
    model = agent(ClockEnv())
    model.policy.ibrl = ibrl
    none = np.zeros((0, side, side, 3), np.uint8)
    action, state = model.predict(none)
    assert action.shape == (0, 2)
    assert model.predict(none, state, np.zeros(0, bool))[0].shape == (0, 2)
    with pytest.raises(ValueError, match="of 2 environments, the observation of 0"):
        model.predict(none, model.policy.initial_state(2))
    assert PriorPolicy(model.policy).predict(none)[0].shape == (0, 2)


def test_the_policy_alone_answers_as_sb3s_do():
    policy = agent(ClockEnv(low=0.0)).policy
    action = policy._predict(torch.from_numpy(noise(2)), deterministic=True)
    np.testing.assert_allclose(action, policy.predict(noise(2), deterministic=True)[0])
