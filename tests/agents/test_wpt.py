"""Algorithm 1 from end to end, and each of its stages on its own."""

from collections import defaultdict
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import (
    SETTINGS,
    ClockEnv,
    agent,
    noise,
    on_time,
    pretrained,
    recorded,
    same,
    weights,
)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import LENGTH, DotEnv

from wpt_agents.agents import wpt
from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.replay import ReplayBuffer
from wpt_agents.data.retrieval import Retriever
from wpt_agents.data.trajectory import MarkedBatch, Trajectory
from wpt_agents.model.observations import stack_frames
from wpt_agents.model.ops import definitions
from wpt_agents.model.prior_policy import prior_action
from wpt_agents.training import cloning, pretraining
from wpt_agents.training.kickstarting import Adaptive
from wpt_agents.training.learner import Learner
from wpt_agents.training.randomness import Purpose
from wpt_agents.training.rollout import Rollout


@pytest.fixture
def store(tmp_path):
    """Four dots of two actions, and two of four."""
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend(recorded(seed=i, embodiment="dot") for i in range(4))
        dataset.extend(recorded(seed=i, actions=4, embodiment="wide") for i in range(2))
    return dataset


# ------------------------------------------------------------------------------- end to end


def test_algorithm_1_from_reward_free_data_to_actions(store):
    model = WPT.pretrain(store.path, env=DotEnv(), steps=2, **SETTINGS)
    before = weights(model, "actor", "critic", "world_model", "prior_actor")
    assert model.learn(3 * LENGTH) is model
    after = weights(model, "actor", "critic", "world_model", "prior_actor")
    assert model.num_timesteps == len(model.replay_buffer) == 3 * LENGTH
    assert len(model.retrieved.trajectories) == 3 and model.prior is not None
    moved = {k.split(".")[0] for k in before if (before[k] != after[k]).any()}
    assert moved == {"actor", "critic", "world_model", "prior_actor"}
    action, _ = model.predict(noise(2), deterministic=True)
    assert action.shape == (2, 2)


def test_every_switch_off_is_learning_from_scratch(store):
    model = agent(DotEnv(), offline_ratio=0, guidance=0, dataset=store).learn(2 * LENGTH)
    assert model.retrieved is None and model.prior is None and model.updates > 0


def test_equal_seeds_give_equal_weights_and_others_do_not(store):
    one, same_seed, other = (
        pretrained(store, env=DotEnv(), seed=seed).learn(2 * LENGTH) for seed in (0, 0, 1)
    )
    assert same(weights(one), weights(same_seed))
    assert not same(weights(one), weights(other))


def test_sb3s_seed_of_all_generators_makes_agents_without_a_seed_repeatable():
    def learned(seed):
        set_random_seed(seed)
        env = DotEnv()
        env.reset(seed=0)
        return weights(agent(env, seed=None).learn(2 * LENGTH))

    one = learned(0)
    assert same(one, learned(0)) and not same(one, learned(1))


def test_a_reseeded_model_draws_anew():
    one, other = agent(DotEnv()), agent(DotEnv(), seed=3)
    other.set_random_seed(0)
    other.policy.load_state_dict(one.policy.state_dict())
    assert same(weights(one.learn(2 * LENGTH)), weights(other.learn(2 * LENGTH)))


# ------------------------------------------------------------------------------ pre-training


def test_pretraining_teaches_the_world_model_and_nothing_else(store):
    start, end = agent(), pretrained(store)
    moved = {k for k, v in weights(start).items() if (v != weights(end)[k]).any()}
    assert moved and all(k.startswith("world_model") for k in moved)
    assert not any("reward_head" in k for k in moved)
    assert end.num_timesteps == end.updates == 0


def test_a_new_model_is_adapted_to_its_data_once_and_loaded_weights_never(store, tmp_path):
    new, twin, off = agent(), agent(), agent(data_dependent_init=False)
    before = weights(new, "world_model")
    for model in (new, twin, off):
        model.adapt_to_data(store)
    adapted = weights(new, "world_model")
    changed = {name.split(".")[2] for name in before if (before[name] != adapted[name]).any()}
    assert changed == {"post_in", "post_out"}
    assert same(weights(twin, "world_model"), adapted)  # by the seed
    assert same(weights(off, "world_model"), before)
    new.save(tmp_path / "model.zip")
    loaded, by_dict, by_file = WPT.load(tmp_path / "model.zip"), agent(seed=1), agent(seed=1)
    by_dict.set_parameters(new.get_parameters())
    by_file.set_parameters(tmp_path / "model.zip")
    for model in (new, loaded, by_dict, by_file):
        model.adapt_to_data(store)
        assert same(weights(model, "world_model"), adapted)


def test_pretraining_calls_back_after_every_update_with_finite_metrics(store):
    seen = []
    pretrained(store, steps=3, callback=lambda step, metrics: seen.append((step, metrics)))
    assert [step for step, _ in seen] == [1, 2, 3]
    assert all("train/kl" in m and np.isfinite(list(m.values())).all() for _, m in seen)


def test_pretraining_prepares_batches_ahead_and_draws_them_by_seed_and_step(store, monkeypatch):
    seen, update = [], Learner.update_world_model

    def watch(self, batch, *rest):
        seen.append(batch)
        return update(self, batch, *rest)

    monkeypatch.setattr(Learner, "update_world_model", watch)
    model = pretrained(store, steps=3)
    shape = model.batch_size, model.batch_length, model.max_action_dim
    for step, batch in enumerate(seen):
        drawn = store.sample(*shape, rng=model.streams.numpy(Purpose.PRETRAIN, step))
        assert batch.image.equal(drawn.image) and batch.action.equal(drawn.action)
    assert len(seen) == 3


def test_marked_pixels_weigh_more_in_pretraining_and_in_fine_tuning(store, monkeypatch):
    seen, update = [], Learner.update_world_model

    def watch(self, batch, *rest, **options):
        seen.append(batch)
        return update(self, batch, *rest, **options)

    monkeypatch.setattr(Learner, "update_world_model", watch)
    plain, weighted = (pretrained(store, steps=2, pixel_weight=w) for w in (1.0, 8.0))
    assert [isinstance(batch, MarkedBatch) for batch in seen] == [False, False, True, True]
    assert not same(weights(plain), weights(weighted))
    in_passes = pretrained(store, steps=2, pixel_weight=8.0, accumulate=2)
    for ours, theirs in zip(weights(in_passes).values(), weights(weighted).values(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-3, atol=1e-4)
    del seen[:]
    weighted.set_env(DotEnv())
    weighted.learn(2 * LENGTH)
    assert seen and all(isinstance(batch, MarkedBatch) for batch in seen)


def test_pretraining_shows_the_time_left(store, capfd):
    pretrained(store, progress_bar=True)
    assert "2/2" in capfd.readouterr().err


def test_pretraining_in_two_parts_equals_one_to_the_last_bit(store, tmp_path):
    pretrained(store, steps=2, run_dir=tmp_path)
    parts, whole = pretrained(store, steps=5, run_dir=tmp_path), pretrained(store, steps=5)
    assert same(weights(parts), weights(whole))
    # the optimiser's averages too: another step keeps them equal
    batch = store.sample(2, 4, 4, np.random.default_rng(0))
    for model in (parts, whole):
        model.learner.update_world_model(batch, torch.Generator().manual_seed(0))
    assert same(weights(parts), weights(whole))


def test_killed_pretraining_goes_on_from_its_last_checkpoint(store, tmp_path, monkeypatch):
    monkeypatch.setattr(pretraining, "SAVE_EVERY", 2)

    def die(step, _):
        if step == 3:
            raise MemoryError  # Ctrl-C would save: tests/training/test_pretraining_runs.py

    with pytest.raises(MemoryError):
        pretrained(store, steps=4, run_dir=tmp_path, callback=die)
    steps = []
    resumed = pretrained(store, steps=4, run_dir=tmp_path, callback=lambda k, _: steps.append(k))
    assert steps == [3, 4]
    assert same(weights(resumed), weights(pretrained(store, steps=4)))


def test_finished_pretraining_is_only_loaded(store, tmp_path):
    first, calls = pretrained(store, run_dir=tmp_path), []
    again = pretrained(store, run_dir=tmp_path, callback=lambda *_: calls.append(1))
    assert not calls and same(weights(first), weights(again))


def test_pretraining_refuses_the_run_folder_of_other_settings(store, tmp_path):
    pretrained(store, run_dir=tmp_path)
    with pytest.raises(ValueError, match=r"batch_size=2, now it is 3.*run_dir"):
        pretrained(store, run_dir=tmp_path, batch_size=3)


def test_pretraining_takes_trajectories_from_any_iterable():
    model = pretrained(recorded(seed=i) for i in range(3))
    assert len(model.dataset) == 3


# --------------------------------------------------------------------------------- retrieval


def test_retrieval_keeps_to_the_width_takes_each_once_and_hides_rewards(store):
    with store:
        store.append(recorded(seed=9, reward=np.ones(8)))
    model = pretrained(store, env=DotEnv(), num_retrieve=500).learn(1)
    assert sorted(model.retrieved_ids) == [0, 1, 2, 3, 6]
    assert all(t.reward is None for t in model.retrieved.trajectories)


def test_retrieval_keeps_to_the_embodiment_when_the_data_names_it(store):
    with store:
        store.append(recorded(seed=9, embodiment="other"))
    model = pretrained(store, env=DotEnv(), num_retrieve=500, embodiment="other").learn(1)
    assert model.retrieved_ids == [6]


def test_a_robot_that_the_data_do_not_name_is_told_and_gets_any_of_its_width(store):
    model = pretrained(store, env=DotEnv(), num_retrieve=9, embodiment="crab")
    with pytest.warns(
        UserWarning, match=r"no robot named 'crab' \(it has dot, wide\).*with 2 actions"
    ):
        model.learn(1)
    assert sorted(model.retrieved_ids) == [0, 1, 2, 3]


def test_retrieval_finds_the_episode_that_begins_where_the_task_does(store):
    model = pretrained(store, num_retrieve=1)
    model.set_env(DotEnv())
    model.env.seed(2)
    assert model.learn(1).retrieved_ids == [2]


def test_the_query_is_an_episodes_first_image_also_in_the_middle_of_one(store):
    model = pretrained(store, num_retrieve=1, env=DotEnv(), offline_ratio=0, guidance=0)
    model.env.seed(2)
    model.learn(LENGTH // 2)  # retrieves nothing
    model.offline_ratio = 0.5
    assert model.learn(1, reset_num_timesteps=False).retrieved_ids == [2]


def first_images(resets, seed):
    env = DotEnv()
    return [env.reset(seed=seed if i == 0 else None)[0] for i in range(resets)]


@pytest.mark.parametrize("n_envs", [1, 2])
def test_several_first_images_find_an_episode_for_each_and_the_last_one_is_begun(store, n_envs):
    action = np.zeros((1, 2), np.float32)
    starts = first_images(3, seed=2)
    with store:
        store.extend(Trajectory(np.stack([image, image]), action) for image in starts)
    model = pretrained(store, num_retrieve=3, retrieval_images=3)
    model.set_env(DummyVecEnv([DotEnv] * n_envs))
    model.env.seed(2)  # the second environment has the seed 3
    model.learn(LENGTH * n_envs)
    expected = {2, 7, 8} if n_envs == 1 else {2, 3, 7}  # with equal images, 6 comes after 2
    assert set(model.retrieved_ids) == expected
    begun = [trajectory.image[0] for trajectory in model.replay_buffer.trajectories]
    resets = 3 if n_envs == 1 else 2
    assert (begun[0] == starts[resets - 1]).all()


def test_one_first_image_resets_nothing_and_in_an_episode_there_is_only_one(store):
    model = pretrained(store, num_retrieve=1, env=DotEnv(), offline_ratio=0, guidance=0)
    model.env.seed(2)
    model.learn(LENGTH // 2)  # retrieves nothing
    model.offline_ratio, model.retrieval_images = 0.5, 5
    assert model.learn(LENGTH, reset_num_timesteps=False).retrieved_ids == [2]
    assert (model.replay_buffer.trajectories[0].image[0] == first_images(1, 2)[0]).all()


def test_random_retrieval_looks_at_nothing_but_width_and_seed(store):
    def retrieved(start, seed):
        model = pretrained(store, num_retrieve=2, retrieval="random", seed=seed)
        model.set_env(DotEnv())
        model.env.seed(start)
        return tuple(model.learn(1).retrieved_ids)

    assert retrieved(1, seed=0) == retrieved(2, seed=0)
    assert len({retrieved(1, seed) for seed in range(6)}) > 1
    assert all(i < 4 for seed in range(6) for i in retrieved(1, seed))


def test_retrieval_without_data_of_the_width_says_what_to_do(store):
    model = pretrained(store, env=DotEnv(actions=3))
    with pytest.raises(ValueError, match=r"no trajectory of 3 actions.*offline_ratio=0"):
        model.learn(1)


def test_retrieval_without_data_of_the_width_names_the_robot_that_was_asked_for():
    data = [recorded(embodiment="a"), recorded(actions=3, embodiment="b")]
    model = pretrained(data, env=DotEnv(actions=3), embodiment="a")
    with pytest.raises(ValueError, match=r"3 actions of the robot 'a'.*set another embodiment"):
        model.learn(1)


def test_the_index_is_kept_beside_the_dataset_and_used_again(store, monkeypatch):
    pretrained(store).build_index()
    monkeypatch.setattr(Retriever, "build", None)
    assert len(pretrained(store).build_index()) == 6


def test_the_index_is_built_again_when_the_dataset_has_grown(store):
    pretrained(store).build_index()
    model = pretrained(store)
    with store:
        store.append(recorded(seed=9))
    model.set_dataset(store.path)
    assert len(model.build_index()) == 7


def test_an_index_of_another_encoder_is_built_again(store):
    model = pretrained(store)
    model.build_index()
    [path] = store.path.glob("*.index")
    Retriever(np.zeros((6, 4), np.float32), np.ones(6), [None] * 6, "another").save(path)
    with pytest.warns(UserWarning, match=r"built again: .*the encoder another"):
        model.build_index()
    assert Retriever.load(path, model.policy.encoder_id()).features.any()


def test_a_subset_has_an_index_of_its_own(store):
    model = pretrained(store)
    model.build_index()
    for ids in ([0, 1], [2, 3], [5, 4, 3, 2, 1, 0], [0, 0, 1, 2, 3, 4]):
        model.set_dataset(store.subset(ids))
        first = next(store.subset(ids).first_observations())
        np.testing.assert_array_equal(model.build_index().features, model.policy.embed(first))
    model.set_dataset(store)
    whole = np.concatenate(list(store.first_observations()))
    np.testing.assert_array_equal(model.build_index().features, model.policy.embed(whole))


def test_an_index_of_other_trajectories_is_built_anew(store):
    model = pretrained(store)
    model.build_index()
    size = (store.path / "shard-00000.bin").stat().st_size
    content = bytearray((store.path / "shard-00000.bin").read_bytes())
    content[size - 10] ^= 1
    (store.path / "shard-00000.bin").write_bytes(content)
    store.validate(set_aside=True)
    with store:
        store.append(recorded(seed=9))  # as many as before
    assert len(store) == 6
    first = np.concatenate(list(store.first_observations()))
    np.testing.assert_array_equal(model.build_index().features, model.policy.embed(first))


def test_an_index_that_cannot_be_written_is_kept_in_memory(store, monkeypatch):
    def read_only(*_):
        raise PermissionError("read-only file system")

    monkeypatch.setattr(Retriever, "save", read_only)
    with pytest.warns(UserWarning, match="read-only"):
        assert len(pretrained(store).build_index()) == 6


# ------------------------------------------------------------------------ collection, guidance


def by_the_prior(model, trajectory):
    """What the prior actor does at each image of an episode, in the environment's bounds."""
    state, actions = None, []
    for t, image in enumerate(trajectory.image[:-1]):
        action, state = model.prior.predict(image[None], state, np.array([t == 0]))
        actions.append(action[0])
    return np.stack(actions)


def test_the_prior_actor_drives_the_warm_up_from_end_to_end(store):
    model = pretrained(store, env=DotEnv(), warmup_steps=LENGTH, train_ratio=0).learn(LENGTH)
    [episode] = model.replay_buffer.trajectories
    np.testing.assert_allclose(episode.action, by_the_prior(model, episode), atol=1e-6)


def test_the_prior_actor_drives_in_its_window_and_nowhere_else(store, monkeypatch):
    monkeypatch.setattr(wpt, "draw_window", lambda probability, length, rng: (3, 7))
    model = pretrained(store, env=DotEnv(), warmup_steps=0, train_ratio=0).learn(LENGTH)
    [episode] = model.replay_buffer.trajectories
    guided = np.isclose(episode.action, by_the_prior(model, episode), atol=1e-6).all(1)
    assert np.flatnonzero(guided).tolist() == [3, 4, 5, 6]


def test_guidance_is_drawn_by_the_schedule_once_an_episode(store, monkeypatch):
    drawn = []
    monkeypatch.setattr(wpt, "draw_window", lambda p, length, rng: (drawn.append(p), (0, 0))[1])
    model = pretrained(store, env=DotEnv(), warmup_steps=0, guidance="linear(1,0,50)")
    model.learn(3 * LENGTH)
    assert drawn == [1.0, 0.5, 0.0]


def test_the_latent_is_filtered_with_the_action_that_was_executed(monkeypatch):
    policy, seen = agent(DotEnv()).policy, []
    act = policy.act

    def spy(image, state, first, *args, **kwargs):
        seen.append((state, first.copy()))
        return act(image, state, first, *args, **kwargs)

    monkeypatch.setattr(policy, "act", spy)
    mine = np.array([[0.5, -0.25, 0, 0]], np.float32)
    rollout = Rollout(policy, 1, 2, lambda: (1, 3), lambda frames: mine[: len(frames)])
    for _ in range(4):
        rollout.act(noise(1))
        rollout.end_step(np.zeros(1), np.zeros(1, bool), {})
    fed = [state[2] for state, _ in seen]
    assert not fed[0].any() and not (fed[1] == mine)[:, :2].any()
    np.testing.assert_array_equal(fed[2], mine)
    np.testing.assert_array_equal(fed[3], mine)
    assert [bool(first[0]) for _, first in seen] == [True, False, False, False]


def test_without_a_prior_actor_the_warm_up_is_uniform_and_the_actor_takes_over():
    model = agent(DotEnv(), warmup_steps=LENGTH, train_ratio=0).learn(2 * LENGTH)
    warm, acted = (t.action for t in model.replay_buffer.trajectories)
    # the actor of fresh weights is a normal of mean about 0; the uniform's quartiles are at 0.5
    assert 0.3 < (np.abs(warm) > 0.5).mean() < 0.7
    assert not (warm == acted).any()


def test_no_warm_up_repeats_the_random_actions_of_an_earlier_one():
    model = agent(DotEnv(), train_ratio=0).learn(LENGTH)
    model.learn(LENGTH)  # counts its steps from 0 again
    first, second = (t.action for t in model.replay_buffer.trajectories)
    model.next_task(DotEnv())
    third = model.learn(LENGTH).replay_buffer.trajectories[0].action
    assert not (first == second).any() and not (first == third).any()
    assert not (second == third).any()


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("terminates", [True, False])
def test_episodes_are_stored_as_they_were(n_envs, terminates):
    model = agent(DummyVecEnv([lambda: ClockEnv(terminates=terminates)] * n_envs), embodiment="x")
    model.learn(2 * 7 * n_envs)
    assert len(model.replay_buffer.trajectories) == 2 * n_envs
    for trajectory in model.replay_buffer.trajectories:
        assert on_time(trajectory) and trajectory.action_dim == 2
        assert trajectory.terminated == terminates and trajectory.embodiment == "x"


def test_num_timesteps_counts_every_call_of_step():
    model = agent(DummyVecEnv([ClockEnv] * 3))
    assert model.learn(10).num_timesteps == 12  # a lower bound
    assert model.learn(7, reset_num_timesteps=False).num_timesteps == 21
    assert model.learn(5).num_timesteps == 6


def test_updates_follow_the_train_ratio():
    model = agent(ClockEnv(), learning_starts=14, train_ratio=4).learn(42)
    # 42 steps, those before learning starts too, each replayed 4 times, 2 x 4 in an update
    assert model.updates == 42 * 4 // 8


def test_no_update_is_made_before_learning_starts_and_then_all_that_were_earned():
    model = agent(ClockEnv(length=7), learning_starts=14, train_ratio=4)
    model.learn(7)
    assert model.updates == 0
    model.learn(7, reset_num_timesteps=False)
    assert model.updates == 14 * 4 // 8


def test_the_head_start_is_made_at_once_and_what_was_earned_counts_towards_it():
    model = agent(ClockEnv(length=7), learning_starts=14, train_ratio=4, actor_delay=10)
    model.learn(14)  # has earned 7 updates
    assert model.updates == 10
    model.learn(7, reset_num_timesteps=False)  # 7 * 4 / 8 = 3.5 more
    assert model.updates == 13


def test_the_rates_of_actor_and_critic_fall_over_a_call_of_learn():
    rates = []
    model = agent(ClockEnv(length=7), actor_critic_decay=True, learning_starts=7, train_ratio=4)
    model.actor_critic_learning_rate = 0.1

    class Note(BaseCallback):
        def _on_step(self):
            optimizers = model.learner.actor_optimizer, model.learner.critic_optimizer
            rates.append([o.param_groups[0]["lr"] for o in optimizers])
            return True

    model.learn(28, callback=Note())
    assert rates[6] == pytest.approx([0.1, 0.1])  # before the first update
    # the updates after step 7 use 1 - 7 / 28 of it, those after step 21 a quarter
    assert rates[7] == pytest.approx([0.075, 0.075])
    assert rates[-1] == pytest.approx([0.025, 0.025])


def test_the_average_of_the_actors_since_the_head_start_acts(tmp_path):
    settings = {"learning_starts": 7, "train_ratio": 4, "actor_delay": 3, "actor_average": 0.25}
    model = agent(ClockEnv(length=7), **settings)
    actors = []

    def note(update):
        def noted(*args, **kwargs):
            metrics = update(*args, **kwargs)
            actors.append([weight.clone() for weight in model.policy.actor.parameters()])
            return metrics

        return noted

    model.learner.update = note(model.learner.update)
    model.learn(7)  # 3.5 updates are due: the head start
    assert len(actors) == 3 and model.policy.average_actor is None
    model.learn(14, reset_num_timesteps=False)
    assert len(actors) == 10
    weights = 0.75 ** torch.arange(6.0, -1, -1)
    weights = weights / weights.sum()
    for averaged, *values in zip(model.policy.average_actor.parameters(), *actors[3:], strict=True):
        expected = sum(w * value for w, value in zip(weights, values, strict=True))
        torch.testing.assert_close(averaged, expected)
    image = np.zeros((64, 64, 3), np.uint8)
    action, _ = model.predict(image, deterministic=True)
    model.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip")
    assert np.array_equal(loaded.predict(image, deterministic=True)[0], action)
    model.policy.actor.load_state_dict(model.policy.average_actor.state_dict())
    model.policy.average(0)
    with definitions():
        assert np.allclose(model.predict(image, deterministic=True)[0], action, atol=1e-6)


def test_an_average_that_is_switched_off_acts_no_longer(tmp_path):
    settings = {"learning_starts": 7, "train_ratio": 4, "actor_average": 0.25}
    model = agent(ClockEnv(length=7), **settings).learn(14)
    model.save(tmp_path / "model.zip")
    loaded = WPT.load(tmp_path / "model.zip", actor_average=0.0)
    other = agent(ClockEnv(length=7))
    other.set_parameters(model.get_parameters())
    assert model.policy.acting_actor is not model.policy.actor
    model.actor_average = 0.0
    assert all(one.policy.acting_actor is one.policy.actor for one in (model, loaded, other))


@pytest.mark.parametrize(("number", "states"), [(None, 24), (3, 3)])
def test_dreams_start_from_as_many_states_as_the_keyword_says(number, states, monkeypatch):
    model, seen = agent(batch_size=4, batch_length=6, imagine_starts=number), []
    model.replay_buffer.add(recorded(length=20, reward=np.zeros(20)))
    draw_starts = model.learner.draw_starts

    def noted(*args):
        seen.append(draw_starts(*args))
        return seen[-1]

    def dreamt(start, *args):
        seen.append(start)
        return dream(start, *args)

    dream = model.policy.dream
    monkeypatch.setattr(model.learner, "draw_starts", noted)
    monkeypatch.setattr(model.policy, "dream", dreamt)
    model.update(defaultdict(list))
    starts, start = seen
    assert len(start.deter) == len(starts) == states
    assert (starts % 6).min() >= (0 if number is None else 2)  # which have seen three images


@pytest.mark.parametrize(("share", "newest_only"), [(0.0, False), (1.0, True)])
def test_online_rows_come_from_the_newest_episodes_by_their_share(share, newest_only, monkeypatch):
    model, seen = agent(recent_share=share, batch_size=16), []
    for number in range(12):
        image = np.full((9, 64, 64, 3), number, np.uint8)
        model.replay_buffer.add(Trajectory(image, np.zeros((8, 2), np.float32), np.zeros(8)))
    update = model.learner.update

    def noted(batch, *args):
        seen.append(batch.image[:, 0, 0, 0, 0].min().item())
        return update(batch, *args)

    monkeypatch.setattr(model.learner, "update", noted)
    model.update(defaultdict(list))
    assert (seen[0] >= 7) is newest_only


def test_the_clones_learning_rate_falls_to_zero(store, monkeypatch):
    rates = []
    model = pretrained(store, env=DotEnv(), guidance=1, bc_steps=4, bc_learning_rate=0.1)
    descend = cloning.descend

    def note_rate(optimizer, *args):
        rates.append(optimizer.param_groups[0]["lr"])
        return descend(optimizer, *args)

    monkeypatch.setattr(cloning, "descend", note_rate)
    model.learn(1)
    assert rates == pytest.approx([0.1, 0.075, 0.05, 0.025])


@pytest.mark.parametrize("settings", [{}, {"pixel_weight": 8.0}])
def test_adapting_makes_updates_of_eq_1_on_the_retrieved_trajectories(store, settings):
    plain = pretrained(store, env=DotEnv(), **settings).learn(0)
    adapted = pretrained(store, env=DotEnv(), adapt_steps=3, **settings).learn(0)
    assert adapted.progress.adapted == 3 and adapted.retrieved_ids == plain.retrieved_ids
    moved = {name for name, w in weights(plain).items() if (w != weights(adapted)[name]).any()}
    assert {name.split(".")[1] for name in moved} == {"encoder", "rssm", "decoder"}
    for number in range(3):  # the same by hand
        rng = plain.streams.numpy(Purpose.ADAPT, number)
        rows = plain.retrieved.sample(
            plain.batch_size, plain.batch_length, plain.max_action_dim, rng, bool(settings)
        )
        plain.learner.update_world_model(rows, plain.streams.torch(Purpose.ADAPT, number, "cpu"))
    assert same(weights(plain), weights(adapted))


def test_adapting_goes_on_where_it_was_interrupted_and_begins_again_for_a_new_task(
    store, monkeypatch
):
    whole = pretrained(store, env=DotEnv(), adapt_steps=4).learn(0)
    model = pretrained(store, env=DotEnv(), adapt_steps=4)
    update = model.learner.update_world_model

    def interrupted(*args):
        if model.progress.adapted == 2:
            raise KeyboardInterrupt
        return update(*args)

    monkeypatch.setattr(model.learner, "update_world_model", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(0)
    monkeypatch.undo()
    model.learn(0)
    assert same(weights(whole), weights(model))
    model.learn(0)
    assert same(weights(whole), weights(model))  # once for a task
    model.reset_task()
    assert model.progress.adapted == 0
    model.learn(0)
    assert model.progress.adapted == 4


def test_adapting_alone_retrieves_and_needs_a_dataset(store):
    alone = {"adapt_steps": 2, "offline_ratio": 0, "guidance": 0}
    model = pretrained(store, env=DotEnv(), **alone).learn(0)
    assert model.retrieved_ids and model.progress.adapted == 2 and model.prior is None
    with pytest.warns(UserWarning, match="adapt_steps=0"):
        agent(DotEnv(), **alone).learn(0)


def test_learning_in_two_calls_equals_one():
    whole, parts = agent(DotEnv()).learn(4 * LENGTH), agent(DotEnv()).learn(2 * LENGTH)
    parts.learn(2 * LENGTH, reset_num_timesteps=False)
    assert same(weights(whole), weights(parts))


def test_an_episode_goes_on_where_the_last_learn_left_it():
    model = agent(ClockEnv()).learn(10)
    model.learn(11, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 3


class StopAt(BaseCallback):
    def __init__(self, step, error=None):
        super().__init__()
        self.step, self.error, self.ended = step, error, False

    def _on_step(self):
        if self.num_timesteps == self.step and self.error is not None:
            raise self.error
        return self.num_timesteps != self.step

    def _on_training_end(self):
        self.ended = True


def test_an_episode_goes_on_where_a_callback_stopped_it():
    model, stop = agent(ClockEnv()), StopAt(10)
    assert model.learn(100, callback=stop).num_timesteps == 10 and stop.ended
    model.learn(11, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 3


def test_an_interrupted_step_costs_the_open_episode_and_no_more():
    model, stop = agent(ClockEnv()), StopAt(10, KeyboardInterrupt())
    with pytest.raises(KeyboardInterrupt):
        model.learn(100, callback=stop)
    assert stop.ended
    model.learn(14, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 3


def test_an_interrupted_update_costs_none_of_those_that_were_earned(monkeypatch):
    def learn(model):
        model.learn(4 * LENGTH, reset_num_timesteps=False)
        return model

    undisturbed, model = learn(agent(DotEnv(), train_ratio=1)), agent(DotEnv(), train_ratio=1)
    update = model.update

    def interrupted(metrics):
        if model.updates == 1:
            monkeypatch.undo()
            raise KeyboardInterrupt
        update(metrics)

    monkeypatch.setattr(model, "update", interrupted)
    with pytest.raises(KeyboardInterrupt):
        learn(model)
    model.learn(3 * LENGTH, reset_num_timesteps=False)
    assert model.num_timesteps == 4 * LENGTH
    assert (model.updates, model.credit) == (undisturbed.updates, undisturbed.credit)


def test_a_callback_after_an_update_sees_that_it_is_paid_for():
    model = agent(DotEnv(), train_ratio=1)
    credits = []
    model.after_update = lambda: credits.append(model.credit)
    model.learn(LENGTH)
    assert credits == [17, 9, 1]  # of 25 collected steps each of the three updates takes 2 x 4


def test_an_interrupted_clone_begins_anew_from_where_it_began(store, monkeypatch):
    undisturbed = pretrained(store, env=DotEnv(), bc_steps=3).learn(1)
    model = pretrained(store, env=DotEnv(), bc_steps=3)
    descend, steps = cloning.descend, []

    def interrupted(*arguments):
        steps.append(descend(*arguments))
        if len(steps) == 2:
            monkeypatch.undo()
            raise KeyboardInterrupt

    monkeypatch.setattr(cloning, "descend", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(1)
    assert not model.cloned
    model.learn(1)
    assert same(weights(model, "prior_actor"), weights(undisturbed, "prior_actor"))


@pytest.mark.parametrize("name", ["learning_rate", "actor_critic_learning_rate"])
def test_a_learning_rate_of_zero_teaches_nothing(name):
    model = agent(DotEnv(), data_dependent_init=False, **{name: 0})
    before = weights(model, "world_model", "actor", "critic")
    after = weights(model.learn(2 * LENGTH), "world_model", "actor", "critic")
    moved = {k.split(".")[0] for k in before if (before[k] != after[k]).any()}
    assert moved == {"world_model", "actor", "critic"} - (
        {"world_model"} if name == "learning_rate" else {"actor", "critic"}
    )


def test_a_given_episode_length_is_kept():
    model = agent(ClockEnv(), episode_length=5).learn(14)
    assert model.episode_length == model.hyperparameters.episode_length == 5


# ------------------------------------------------------------------------------ another task


def test_another_width_drops_behaviour_and_replay_and_keeps_the_world_model(store):
    model = pretrained(store, env=DotEnv()).learn(2 * LENGTH)
    kept, dropped = (
        weights(model, "world_model.rssm", "world_model.encoder"),
        weights(model, "actor"),
    )
    model.set_env(DotEnv(actions=4))
    assert same(kept, weights(model, "world_model.rssm", "world_model.encoder"))
    assert not same(dropped, weights(model, "actor"))
    assert len(model.replay_buffer) == 0 and model.prior is None
    assert sorted(model.learn(LENGTH).retrieved_ids) == [4, 5]
    assert model.replay_buffer.trajectories[0].action_dim == 4


def test_another_width_drops_what_was_retrieved_before_the_first_episode_ended(store):
    model = pretrained(store, env=DotEnv()).learn(1)
    assert model.cloned and model.episodes == 0
    model.set_env(DotEnv(actions=4))
    assert not model.cloned and sorted(model.learn(1).retrieved_ids) == [4, 5]


def test_another_task_begins_with_an_episode_of_its_own():
    model = agent(ClockEnv()).learn(4)
    model.reset_task()
    model.learn(3, reset_num_timesteps=False)
    assert not model.replay_buffer.trajectories  # 4 + 3 steps would have ended the old one


def test_earlier_episodes_are_kept_without_rewards_and_retrieved_for_the_next_task(store, tmp_path):
    model = pretrained(store, env=DotEnv(), num_retrieve=6, embodiment="dot").learn(2 * LENGTH)
    assert sorted(model.retrieved_ids) == [0, 1, 2, 3]
    episodes = model.replay_buffer.trajectories
    model.next_task(DotEnv())
    assert model.num_timesteps == 0 and not model.replay_buffer.trajectories
    assert len(model.kept.trajectories) == 2
    assert all(t.reward is None for t in model.kept.trajectories)
    model.learn(1)
    assert sorted(model.retrieved_ids) == [0, 1, 2, 3, 6, 7]  # the dataset has six
    earlier = [number - 6 for number in model.retrieved_ids if number >= 6]
    for number, trajectory in zip(earlier, model.retrieved.trajectories[4:], strict=True):
        assert (trajectory.image == episodes[number].image).all() and trajectory.reward is None
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model", dataset=store, env=DotEnv())
    with pytest.raises(ValueError, match=r"were retrieved, but model\.kept holds 0"):
        loaded.learn(1)
    loaded.kept = model.kept
    loaded.learn(1)
    assert len(loaded.retrieved.trajectories) == 6


def test_the_nearest_of_dataset_and_earlier_episodes_are_retrieved(store):
    model = pretrained(store, env=ClockEnv(), num_retrieve=1, embodiment="dot").learn(7)
    assert len(model.retrieved_ids) == 1 and model.retrieved_ids[0] < 4
    model.next_task(ClockEnv())
    model.learn(1)
    assert model.retrieved_ids == [6]  # it begins exactly as the task does


@pytest.mark.parametrize("begin, actions", [("next_task", 2), ("next_task", 3), ("set_env", 3)])
def test_another_task_is_drawn_by_the_seed_and_keeps_the_world_model(store, begin, actions):
    models = [pretrained(store, env=DotEnv()).learn(LENGTH) for _ in range(2)]
    before = weights(models[0])
    for number, model in enumerate(models):
        torch.manual_seed(number)  # torch's own generator must not matter
        getattr(model, begin)(DotEnv(actions=actions))
    one, other = (weights(model) for model in models)
    assert same(one, other)
    assert not same(
        weights(models[0], "actor"), {k: before[k] for k in weights(models[0], "actor")}
    )
    kept = weights(models[0], "world_model.encoder", "world_model.rssm")
    assert same(kept, {k: before[k] for k in kept})


def test_a_next_task_that_is_refused_leaves_the_present_one_as_it_was():
    model = agent(DotEnv(), offline_ratio=0, guidance=0).learn(LENGTH)
    before = weights(model)
    with pytest.raises(ValueError, match="at most max_action_dim=4"):
        model.next_task(DotEnv(actions=5))
    assert len(model.replay_buffer) == model.num_timesteps == LENGTH
    assert same(before, weights(model))


def test_episodes_are_kept_only_beside_a_dataset():
    model = agent(DotEnv(), offline_ratio=0, guidance=0)
    with pytest.raises(ValueError, match="keep_data=True keeps episodes beside a dataset"):
        model.reset_task(keep_data=True)


def test_one_pretrained_model_loads_onto_every_width(store, tmp_path):
    pretrained(store).save(tmp_path / "model")
    for actions in (1, 2, 4):
        model = WPT.load(tmp_path / "model", env=ClockEnv(actions=actions)).learn(14)
        assert model.predict(noise(), deterministic=True)[0].shape == (actions,)


def test_open_loop_shows_the_context_and_then_a_dream(store):
    trajectory = recorded(length=12)
    model = pretrained(store)
    frames = model.open_loop(trajectory, context=4, horizon=6)
    assert frames.shape == (10, 64, 64, 3) and frames.dtype == np.uint8
    assert (frames == model.open_loop(trajectory, context=4, horizon=6)).all()
    short = model.open_loop(Trajectory(trajectory.image[:8], trajectory.action[:7]))
    assert len(short) == 8


def test_the_forward_passes_can_run_in_bfloat16(store):
    model = pretrained(store, env=DotEnv(), precision="bf16").learn(2 * LENGTH)
    assert all(torch.isfinite(v).all() for v in weights(model).values())


def test_held_out_errors_are_a_squared_error_an_image_and_an_absolute_one_a_reward(monkeypatch):
    model, episode = agent(ClockEnv()), recorded(length=6)
    episode = replace(episode, reward=np.arange(6, dtype=np.float32))
    world_model = model.policy.world_model
    grey, three = torch.zeros(7, 64, 64, 3), torch.full((1, 7), 3.0)  # 0: between black and white
    monkeypatch.setattr(world_model.decoder, "forward", lambda deter, stoch: grey)
    monkeypatch.setattr(world_model, "reward", lambda feat: three)
    with definitions():
        errors = model.policy.heldout_errors(episode)
    by_hand = ((episode.image / 255 - 0.5) ** 2).sum((1, 2, 3)).mean()
    assert errors["reconstruction"] == pytest.approx(by_hand, rel=1e-4)
    assert errors["reward"] == pytest.approx(np.mean([3, 2, 1, 0, 1, 2]))
    assert len(errors) == 2


def test_every_episode_is_judged_before_it_is_replayed(monkeypatch):
    model, seen = agent(ClockEnv()), []
    judge = model.policy.heldout_errors
    monkeypatch.setattr(
        model.policy,
        "heldout_errors",
        lambda t: seen.append(len(model.replay_buffer.trajectories)) or judge(t),
    )
    model.learn(21)
    assert seen == [0, 1, 2]


def test_datasets_of_equal_shapes_are_told_apart_whatever_their_codec(tmp_path):
    for codec in ("raw", "zstd"):
        prints = set()
        for i, seeds in enumerate([(0, 1), (0, 1), (0, 2)]):
            folder = tmp_path / f"{codec}{i}"
            with TrajectoryDataset.create(folder, codec=codec) as dataset:
                dataset.extend(recorded(seed=seed) for seed in seeds)
            prints.add(dataset.fingerprint)
        assert len(prints) == 2


def test_data_in_other_units_than_the_environment_are_reported_whichever_comes_first(tmp_path):
    with TrajectoryDataset.create(tmp_path / "arm") as arm:
        arm.append(recorded(bounds=np.array([[-3.0, -3.0], [3.0, 3.0]])))
    with pytest.warns(UserWarning, match="different units"):
        agent(DotEnv(), dataset=arm)
    later = agent(DotEnv())
    with pytest.warns(UserWarning, match="different units"):
        later.set_dataset(arm)
    with pytest.warns(UserWarning, match="different units"):
        agent(dataset=arm).set_env(DotEnv())


@pytest.mark.slow
def test_trajectories_of_one_dataset_are_not_taken_from_another(store, tmp_path):
    model = pretrained(store, env=DotEnv()).learn(LENGTH)
    model.save(tmp_path / "model")
    with TrajectoryDataset.create(tmp_path / "other") as other:
        other.extend(recorded(seed=i, actions=4) for i in range(4))
        other.extend(recorded(seed=i) for i in range(3))
    loaded = WPT.load(tmp_path / "model", env=DotEnv(), dataset=other)
    assert sorted(loaded.learn(LENGTH).retrieved_ids) == [4, 5, 6]
    model.set_dataset(other)
    assert sorted(model.learn(LENGTH).retrieved_ids) == [4, 5, 6]
    assert {t.action_dim for t in model.retrieved.trajectories} == {2}


class NewData(BaseCallback):
    """Sets another dataset, and notes how many steps there are to rehearse afterwards."""

    def __init__(self, dataset):
        super().__init__()
        self.dataset, self.seen = dataset, []

    def _on_step(self):
        if self.num_timesteps == 1:
            self.model.set_dataset(self.dataset)
        self.seen.append(len(self.model.retrieved))
        return True


def test_another_dataset_counts_from_the_next_call_of_learn_on(store):
    model = pretrained(store, env=ClockEnv(7), num_retrieve=2)
    callback = NewData([recorded(length=20, seed=9)])
    clone = weights(model.learn(7, callback=callback), "prior_actor")
    assert callback.seen == [16] * 7  # the former trajectories are rehearsed to the end
    assert model.prior is not None and model.retrieved_of != model.dataset.fingerprint
    model.bc_steps, model.num_retrieve = 3, 1
    model.learn(7, reset_num_timesteps=False)
    assert len(model.retrieved) == 20 and model.cloned
    assert not same(clone, weights(model, "prior_actor"))
    with pytest.raises(ValueError, match="the prior actor is cloned"):
        model.bc_steps = 2


def test_a_prior_actor_that_another_dataset_replaces_acts_no_longer(store, monkeypatch):
    model = pretrained(store, env=ClockEnv(7), ibrl=True).learn(7)
    assert model.policy.ibrl
    model.set_dataset([recorded(length=20, seed=9)])

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(cloning, "descend", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(7)
    assert model.prior is None and not model.policy.ibrl


def test_without_any_use_of_it_the_prior_actor_of_the_former_dataset_stays(store):
    model = pretrained(store, env=ClockEnv(7)).learn(7)
    clone = weights(model, "prior_actor")
    model.guidance = 0
    model.set_dataset([recorded(seed=9)])
    model.learn(7)
    assert model.prior is not None and same(clone, weights(model, "prior_actor"))


def test_an_unknown_episode_length_is_found_out_and_kept_by_the_file(store, tmp_path):
    env = Monitor(ClockEnv(length=7))  # no spec: nothing says how long it lasts
    model = pretrained(store, env=env, guidance=1, warmup_steps=0)
    assert model.expected_length() == 500  # a guess, until an episode has been seen
    model.learn(7)
    assert model.expected_length() == 7
    model.save(tmp_path / "model")
    assert WPT.load(tmp_path / "model", env=ClockEnv(length=7)).expected_length() == 7
    model.reset_task()
    assert model.expected_length() == 500


def test_another_task_starts_from_returns_of_no_known_scale():
    model = agent(DotEnv())
    model.policy.return_scale.fill_(1000)
    model.reset_task()
    assert model.policy.return_scale == 0


def test_guidance_that_begins_later_has_a_clone_too(store):
    model = pretrained(store, env=DotEnv(), guidance="linear(0,1,40)").learn(2 * LENGTH)
    assert model.cloned


def replayed(model):
    """A batch of the model's replay and the latents of its images."""
    batch = model.replay_buffer.sample(2, 5, 4, np.random.default_rng(0))
    with torch.no_grad():
        post, *_ = model.policy.world_model.observe(batch, torch.Generator().manual_seed(0))
    return post, batch


def test_kickstarting_is_the_squared_distance_to_the_prior_actor_by_its_schedule(store):
    model = pretrained(store, env=DotEnv(), kickstart="linear(20,0,100)").learn(2 * LENGTH)
    post, batch = replayed(model)
    policy, by_hand = model.policy, []
    for b in range(2):
        frames = None
        for t in range(5):
            frames = stack_frames(batch.image[b, t : t + 1].numpy(), frames, None)
            mode = policy.actor.dist(post.feat[b : b + 1, t], policy.action_mask).mode[0].detach()
            error = (mode - torch.from_numpy(prior_action(policy, frames)[0]))[:2] ** 2
            by_hand += [error.mean().item()] * (t >= 2)
    loss = model.learner.imitation_loss(model.policy.actor, post, model.learner.advice(batch))
    assert model.num_timesteps == 50  # half way from 20 to 0
    assert model.hyperparameters.kickstart_at(50) == 10
    assert loss.item() == pytest.approx(np.mean(by_hand), rel=1e-4)


def test_the_adaptive_weight_goes_by_the_returns_since_the_warm_up(store):
    settings = {"kickstart": "adaptive(20,1)", "warmup_steps": LENGTH, "train_ratio": 8}
    model = pretrained(store, env=DotEnv(), **settings).learn(4 * LENGTH)
    by_hand = [float(episode.reward.sum()) for episode in model.replay_buffer.trajectories]
    assert model.collected_returns() == (by_hand[:1], by_hand[1:]) and len(by_hand) == 4
    expected = Adaptive(20, 1).weight(by_hand[:1], by_hand[1:])
    assert model.imitation_weight() == expected
    metrics = defaultdict(list)
    model.update(metrics)
    assert metrics["train/kickstart_weight"][0].item() == pytest.approx(expected)
    for episode in model.replay_buffer.trajectories[1:]:
        episode.reward[:] -= 1  # now they are worse than the warm-up's
    assert model.imitation_weight() == 20


def returns_of(model):
    """The returns of the collected trajectories, in their order."""
    return [float(episode.reward.sum()) for episode in model.replay_buffer.trajectories]


def test_a_loaded_model_without_its_replay_takes_no_episode_of_its_own_for_the_prior_actors(
    store, tmp_path
):
    settings = {"kickstart": "adaptive(20,1)", "warmup_steps": LENGTH}
    pretrained(store, env=DotEnv(), **settings).learn(2 * LENGTH).save(tmp_path / "model")
    model = WPT.load(tmp_path / "model", env=DotEnv(), dataset=store)
    model.learn(2 * LENGTH, reset_num_timesteps=False)
    assert model.collected_returns() == ([], returns_of(model))
    assert model.imitation_weight() == 20


def test_a_second_warm_up_counts_as_the_prior_actors(store):
    settings = {"kickstart": "adaptive(20,1)", "warmup_steps": LENGTH}
    model = pretrained(store, env=DotEnv(), **settings)
    model.learn(2 * LENGTH).learn(2 * LENGTH)
    one, two, three, four = returns_of(model)
    assert model.collected_returns() == ([one, three], [two, four])


def test_of_several_environments_each_episode_counts_by_who_acted_in_it(store):
    venv = DummyVecEnv([lambda: ClockEnv(length=7), lambda: ClockEnv(length=30)])
    settings = {"kickstart": "adaptive(20,1)", "warmup_steps": 20}
    model = pretrained(store, env=venv, **settings).learn(2 * 30)
    # At step 14 (7 of each) the warm-up goes on, at step 28 it is over; 465 began in it.
    assert model.collected_returns() == ([28, 28, 465], [28, 28])


def test_replay_buffers_without_sources_are_told_apart_by_the_steps_before(store, tmp_path):
    settings = {"kickstart": "adaptive(20,1)", "warmup_steps": LENGTH}
    model = pretrained(store, env=DotEnv(), **settings).learn(3 * LENGTH)
    labelled = model.collected_returns()
    unlabelled = ReplayBuffer()
    for episode in model.replay_buffer.trajectories:
        unlabelled.add(replace(episode, source=None))
    model.replay_buffer = unlabelled
    assert model.collected_returns() == labelled == (returns_of(model)[:1], returns_of(model)[1:])


def moved_by(model, keyword, value):
    """The weights that an update changes otherwise if `keyword` is `value` instead of 0."""
    before = deepcopy(model.policy.state_dict())
    taught = []
    for weight in (0, value):
        model.policy.load_state_dict(before)
        model.learner = model.make_learner()
        setattr(model, keyword, weight)
        model.updates = 0
        model.update(defaultdict(list))
        taught.append(weights(model))
    return {name for name in before if (taught[0][name] != taught[1][name]).any()}


def test_kickstarting_teaches_the_actor_alone_and_is_off_by_default(store):
    model = pretrained(store, env=DotEnv()).learn(2 * LENGTH)
    assert {name.split(".")[0] for name in moved_by(model, "kickstart", 5)} == {"actor"}
    assert WPT("WPTPolicy", size="debug").kickstart == 0


def test_imitation_trains_the_states_only_if_imitation_grad_says_so(store):
    model = pretrained(store, env=DotEnv(), kickstart=5).learn(2 * LENGTH)
    moved = {".".join(name.split(".")[:2]) for name in moved_by(model, "imitation_grad", 100)}
    assert {"world_model.encoder", "world_model.rssm"} <= moved
    assert WPT("WPTPolicy", size="debug").imitation_grad == 0


def test_the_loss_of_the_states_is_the_weighted_imitation_and_leaves_the_actor_fixed(store):
    model = pretrained(store, env=DotEnv(), imitation_grad=7.0).learn(2 * LENGTH)
    post, batch = replayed(model)
    advice = model.learner.advice(batch)
    deter = post.deter.requires_grad_()
    loss = model.learner.states_loss(post._replace(deter=deter), advice)
    actor = model.policy.actor
    expected = 7 * model.learner.imitation_loss(actor, post, advice).item()
    assert loss.item() == pytest.approx(expected)
    model.policy.actor.zero_grad()
    loss.backward()
    assert deter.grad.abs().sum() > 0
    assert all(p.grad is None and p.requires_grad for p in model.policy.actor.parameters())


@pytest.mark.slow
def test_a_kickstarted_actor_comes_to_act_as_the_prior_actor(store):
    distances = []
    for kickstart in (0.0, 100.0):
        model = pretrained(
            *(store, 2),
            **{"env": DotEnv(), "kickstart": kickstart, "guidance": 1, "train_ratio": 8},
            **{"actor_critic_learning_rate": 3e-3, "bc_steps": 30, "return_norm": True},
        ).learn(4 * LENGTH)
        post, batch = replayed(model)
        loss = model.learner.imitation_loss(model.policy.actor, post, model.learner.advice(batch))
        distances.append(loss.item())
    assert distances[1] < 0.2 * distances[0]


def test_kickstarting_alone_has_a_clone_and_wants_windows_of_three_images(store):
    assert pretrained(store, env=DotEnv(), guidance=0, kickstart=1).learn(LENGTH).cloned
    with pytest.raises(ValueError, match=r"kickstart .*3 images.*batch_length=2"):
        agent(DotEnv(), kickstart=1, batch_length=2)
    with pytest.raises(ValueError, match=r"actor_delay .*3 images.*batch_length=2"):
        agent(DotEnv(), actor_delay=1, guidance=1, batch_length=2)
    with pytest.raises(ValueError, match=r"residual .*3 images.*batch_length=2"):
        agent(DotEnv(), residual=True, guidance=0, batch_length=2)
    agent(DotEnv(), actor_delay=1, guidance=0, batch_length=2)  # imitates nobody


@pytest.mark.filterwarnings("ignore:No dataset")
def test_kickstarting_without_a_clone_does_not_imitate_an_untrained_one():
    model = agent(DotEnv(), kickstart=1).learn(2 * LENGTH)
    metrics = defaultdict(list)
    model.update(metrics)
    assert not model.cloned and "train/kickstart_loss" not in metrics


def test_learning_without_a_dataset_is_said_once_unless_it_is_meant(store, recwarn):
    with pytest.warns(UserWarning, match=r"No dataset: .*model.prior .*dataset=.*guidance=0"):
        assert agent(DotEnv()).learn(LENGTH).prior is None
    recwarn.clear()
    agent(DotEnv(), offline_ratio=0, guidance=0).learn(LENGTH)
    agent(DotEnv(), dataset=store).learn(LENGTH)
    assert not [warning for warning in recwarn if "No dataset" in str(warning.message)]


@pytest.mark.parametrize("keyword", ["ibrl", "residual"])
def test_the_warning_of_no_dataset_names_every_keyword_that_needs_one(keyword):
    with pytest.warns(UserWarning, match=f"No dataset: .*without .*{keyword}"):
        agent(DotEnv(), offline_ratio=0, guidance=0, **{keyword: True}).learn(LENGTH)


def test_a_prior_actor_that_was_not_finished_is_missed_without_the_dataset(store, tmp_path):
    model = pretrained(store, env=DotEnv(), offline_ratio=0).learn(0)
    model.progress.cloned = False  # as if the model was saved before the clone was finished
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match="No dataset: .* no prior actor to guide"):
        WPT.load(tmp_path / "model", env=DotEnv()).learn(LENGTH)


def test_a_seed_that_was_set_is_saved(tmp_path):
    model = agent(DotEnv())
    model.set_random_seed(5)
    model.save(tmp_path / "model")
    assert WPT.load(tmp_path / "model").seed == 5
