"""Long and endless episodes are stored in parts, which are replayed while the episode goes on."""

import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, ClockEnv, agent, on_time, same, weights
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import DummyVecEnv

from wpt_agents.agents.curious import ICMExplorer
from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.rlpd import RLPD
from wpt_agents.agents.wpt import WPT
from wpt_agents.zoo.run.checkpoints import Checkpoints

SCRATCH = {"offline_ratio": 0.0, "guidance": 0.0}
ENDLESS = 10**9
FRAMES = {"channels": 2, "feature_dim": 8, "hidden_dim": 16, "batch_size": 4, "device": "cpu"}


def stored(model):
    return model.replay_buffer.trajectories


def times(trajectory):
    """The time that each image of a ClockEnv shows."""
    return trajectory.image[:, 0, 0, 0].tolist()


def test_a_long_episode_is_stored_in_parts_that_meet_in_one_image():
    env = ClockEnv(length=7, terminates=True)
    model = agent(env, train_ratio=0, max_trajectory_length=3, **SCRATCH).learn(14)
    parts = [[0, 1, 2, 3], [3, 4, 5, 6], [6, 7]]
    assert [times(part) for part in stored(model)] == parts + parts
    assert [part.reward.tolist() for part in stored(model)[:3]] == [[1, 2, 3], [4, 5, 6], [7]]
    assert [part.terminated for part in stored(model)[:3]] == [False, False, True]
    assert (model.episodes, model.progress.cut, model.num_timesteps) == (2, 4, 14)


def test_an_episode_of_the_greatest_length_is_stored_whole():
    env = ClockEnv(length=7, terminates=True)
    model = agent(env, train_ratio=0, max_trajectory_length=7, **SCRATCH).learn(14)
    assert all(on_time(episode) and episode.terminated for episode in stored(model))
    assert (model.episodes, model.progress.cut) == (2, 0)


def test_the_policy_does_not_notice_a_cut():
    def actions(longest):
        settings = {"train_ratio": 0, "warmup_steps": 0, "max_trajectory_length": longest}
        model = agent(ClockEnv(length=12), **settings, **SCRATCH).learn(12)
        return np.concatenate([part.action for part in stored(model)])

    np.testing.assert_array_equal(actions(5), actions(12))


def test_environments_are_cut_each_at_its_own_time():
    venv = DummyVecEnv([lambda: ClockEnv(length=7), lambda: ClockEnv(length=4)])
    model = agent(venv, train_ratio=0, max_trajectory_length=3, **SCRATCH).learn(2 * 8)
    # Step 3 cuts both, 4 ends the second, 6 cuts the first, 7 ends the first and cuts the second,
    # 8 ends the second.
    expected = [[0, 1, 2, 3], [0, 1, 2, 3], [3, 4], [3, 4, 5, 6], [6, 7], [0, 1, 2, 3], [3, 4]]
    assert [times(part) for part in stored(model)] == expected
    assert (model.episodes, model.progress.cut) == (3, 4)


@pytest.mark.parametrize("train_freq", ["episode", "step"])
def test_an_endless_episode_is_learnt_from_while_it_goes_on(train_freq):
    model = agent(ClockEnv(ENDLESS), train_freq=train_freq, max_trajectory_length=10, **SCRATCH)
    before = weights(model, "actor")
    model.learn(64)
    assert model.updates == 4  # each step pays for 0.5 / (2 * 4) of one
    assert [len(part) for part in stored(model)] == [10] * 6 and model.episodes == 0
    assert not same(weights(model, "actor"), before)


@pytest.mark.parametrize("make", [DrQv2, RLPD])
@pytest.mark.parametrize("train_freq", ["episode", "step"])
def test_model_free_agents_learn_from_an_endless_episode(make, train_freq):
    settings = {"learning_starts": 10, "update_every": 5, "train_freq": train_freq, "seed": 0}
    if make is RLPD:
        settings |= {"critics": 2, "offline_ratio": 0.0}
    model = make("CnnPolicy", ClockEnv(ENDLESS), max_trajectory_length=8, **settings, **FRAMES)
    model.learn(40)
    assert model.updates == 6  # of 30 steps behind learning_starts
    assert [len(part) for part in stored(model)] == [8] * 5


def test_the_warm_up_of_an_endless_episode_ends():
    model = agent(
        ClockEnv(ENDLESS), train_ratio=0, warmup_steps=6, max_trajectory_length=5, **SCRATCH
    )
    guided = []
    guide = model.guide
    model.guide = lambda frames: guided.append(model.num_timesteps) or guide(frames)
    model.learn(20)
    assert guided == list(range(10))  # to the end of the part that begins before step 6


def test_guidance_windows_lie_inside_a_part():
    model = agent(ClockEnv(ENDLESS), episode_length=500, max_trajectory_length=20, **SCRATCH)
    assert model.expected_length() == 20


def test_a_resumed_run_of_cut_episodes_equals_one_that_was_never_interrupted(tmp_path):
    settings = {"max_trajectory_length": 3, "train_ratio": 4, **SCRATCH}
    whole = agent(ClockEnv(length=7), **settings).learn(49)
    half = agent(ClockEnv(length=7), **settings).learn(28)  # an episode's border
    half.save(tmp_path / "model.zip")
    half.save_replay_buffer(tmp_path / "replay.zip")
    rest = WPT.load(tmp_path / "model.zip", env=ClockEnv(length=7), device="cpu")
    rest.load_replay_buffer(tmp_path / "replay.zip")
    rest.learn(21, reset_num_timesteps=False)
    assert rest.updates == whole.updates > half.updates
    assert same(weights(rest), weights(whole))
    for one, other in zip(stored(rest), stored(whole), strict=True):
        np.testing.assert_array_equal(one.action, other.action)


def test_learning_goes_on_in_the_open_episode():
    settings = {"max_trajectory_length": 10, **SCRATCH}
    model = agent(ClockEnv(ENDLESS), **settings).learn(15)
    model.learn(25, reset_num_timesteps=False)
    whole = agent(ClockEnv(ENDLESS), **settings).learn(40)
    assert [times(part) for part in stored(model)] == [times(part) for part in stored(whole)]
    assert same(weights(model), weights(whole))


def test_checkpoints_are_written_between_episodes_only(tmp_path):
    model = agent(ClockEnv(length=7), max_trajectory_length=3, train_ratio=0, **SCRATCH)
    model.learn(20, callback=Checkpoints(tmp_path, every=1))
    names = [path.name for path in sorted((tmp_path / "checkpoints").iterdir())]
    assert names == ["step-000000014", "step-000000020"]  # the last two; the second is of the end


def test_an_endless_episode_leaves_a_learning_curve(tmp_path):
    model = agent(ClockEnv(ENDLESS), max_trajectory_length=10, **SCRATCH)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, log_interval=2).logger.close()
    rows = np.genfromtxt(tmp_path / "progress.csv", delimiter=",", names=True)
    # Rewards are the time: two parts of steps 1 .. 20, then two of 21 .. 40.
    assert rows["rolloutreward_per_step"].tolist() == [10.5, 30.5]


def test_an_explorer_ends_endless_episodes():
    settings = {**SETTINGS, **SCRATCH, "max_trajectory_length": 9}
    explorer = ICMExplorer("WPTPolicy", ClockEnv(ENDLESS), **settings)
    episodes = list(explorer.explore(3))
    assert [times(episode) for episode in episodes] == [list(range(10))] * 3
    assert explorer.episodes == 3 and explorer.updates == 1  # of 27 steps, one in 16


def test_a_task_begun_in_an_endless_episode_is_dropped_with_other_actions():
    model = agent(ClockEnv(ENDLESS), max_trajectory_length=4, **SCRATCH).learn(12)
    model.set_env(ClockEnv(ENDLESS, actions=3))
    assert len(model.replay_buffer) == 0


def test_an_episode_of_an_earlier_query_image_is_remembered_behind_a_cut():
    model = agent(ClockEnv(ENDLESS), max_trajectory_length=4, train_ratio=0, **SCRATCH).learn(10)
    assert (model.first_images(1) == 0).all()  # the episode's first, not that of its third part


def test_parts_that_are_shorter_than_a_batch_are_joined():
    model = agent(ClockEnv(ENDLESS), max_trajectory_length=2, **SCRATCH).learn(32)
    batch = model.replay_buffer.sample(3, 4, 4, np.random.default_rng(0))
    assert torch.isfinite(batch.reward).all() and batch.is_first[:, 0].all()


def test_an_exploration_that_makes_no_update_says_so_and_the_remedy_works():
    def explorer():
        return ICMExplorer("WPTPolicy", ClockEnv(), **SETTINGS | SCRATCH | {"learning_starts": 500})

    with pytest.warns(UserWarning, match=r"explore\(3\) made no update.*learning_starts=500.* 21"):
        list(explorer().explore(3))
    model = explorer()
    model.learning_starts = 0
    model.warmup_steps = 0
    assert len(list(model.explore(3))) == 3 and model.updates == 1
