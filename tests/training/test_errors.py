"""Bad input: each error names the culprit and the remedy, and nothing is lost."""

import inspect
import re
from dataclasses import asdict

import gymnasium as gym
import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, ClockEnv, agent, noise, on_time, pretrained, recorded, weights
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.data.trajectory import Trajectory
from wpt_agents.model.sizes import SIZES
from wpt_agents.training import cloning, learner, pretraining, world_model_learner
from wpt_agents.training.hyperparameters import SIZES_OWN, Hyperparameters
from wpt_agents.zoo.plan.request import Request
from wpt_agents.zoo.plan.runs import make_plan


def finite(model):
    return all(torch.isfinite(v).all() for v in weights(model).values())


# ------------------------------------------------------------------------------- environments


class Odd(ClockEnv):
    """The clock with other spaces."""

    def __init__(self, observation=None, action=None):
        super().__init__()
        self.observation_space = observation or self.observation_space
        self.action_space = action or self.action_space


@pytest.mark.parametrize(
    ("env", "words"),
    [
        (Odd(action=spaces.Discrete(3)), r"Discrete\(3\): wrap it .*TransformAction"),
        (Odd(action=spaces.Box(-1, 1, (2, 2))), r"one-dimensional Box, .*\(2, 2\)"),
        (Odd(action=spaces.Box(-np.inf, 1, (2,))), "finite bounds, .*TransformAction"),
        (ClockEnv(actions=5), "5 actions, .* max_action_dim=4: make it with max_action_dim=5"),
        (Odd(spaces.Box(-1, 1, (17,))), "sees images, .*17.*AddRenderObservation"),
        (Odd(spaces.Box(0, 1, (64, 64, 3))), "sees images, .*float32.*convert them: .*255"),
        (Odd(spaces.Box(0, 255, (64, 64, 2), np.uint8)), r"sees images, .*\(64, 64, 2\)"),
        (Odd(spaces.Dict(a=spaces.Box(0, 1, (2,)))), r"sees images, .*Dict\("),
    ],
)
def test_an_environment_that_does_not_fit_is_refused(env, words):
    model = agent(ClockEnv())
    before = model.get_env()
    with pytest.raises(ValueError, match=words):
        model.set_env(env)
    assert model.get_env() is before and model.learn(7).num_timesteps == 7
    with pytest.raises(ValueError, match=words):
        agent(env)


def test_more_actions_than_a_trained_model_takes_need_a_new_model(tmp_path):
    words = "max_action_dim=4: train a new one with max_action_dim=5"
    model = pretrained([recorded()])
    with pytest.raises(ValueError, match=words):
        model.set_env(ClockEnv(actions=5))
    model.save_world_model(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=words):
        WPT.load(tmp_path / "model.zip", env=ClockEnv(actions=5))


def test_pretraining_for_an_environment_of_more_actions_names_the_keyword_before_it_begins():
    with pytest.raises(ValueError, match="max_action_dim=4: make it with max_action_dim=5"):
        pretrained([recorded()], env=ClockEnv(actions=5))


def test_learning_without_an_environment_says_how_to_give_one():
    with pytest.raises(ValueError, match=r"call set_env\(env\), or pass env="):
        agent().learn(10)


@pytest.mark.parametrize("steps", ["100", True, 1.5, -1, np.nan, np.inf, None])
def test_learn_refuses_what_is_no_number_of_steps_and_changes_nothing(steps):
    model = agent(ClockEnv()).learn(7)
    got = re.escape(f"at least 0, got {steps!r}: pass the number of steps to collect, such as")
    with pytest.raises(ValueError, match=f"total_timesteps must be a whole number of {got}"):
        model.learn(steps)
    assert model.num_timesteps == 7


@pytest.mark.parametrize("steps", [1e1, np.int64(10), np.float32(10)])
def test_a_whole_number_of_steps_may_be_of_any_type(steps):
    assert agent(ClockEnv()).learn(steps).num_timesteps == 10


def test_an_unknown_environment_is_named():
    with pytest.raises(gym.error.Error, match="Nowhere"):
        agent().set_env("Nowhere-v0")


@pytest.mark.parametrize(
    "obs", [noise().astype(np.float32), noise()[..., :2], np.zeros(17), noise(2, 2), {"a": 1}]
)
def test_predict_refuses_what_is_no_image(obs):
    with pytest.raises(ValueError, match=r"must be an image, \(H, W, 3\) uint8"):
        agent().predict(obs)


# ------------------------------------------------------------------------------------ datasets


def refused(dataset, words, **changes):
    with pytest.raises(ValueError, match=words):
        pretrained(dataset, **changes)


def test_a_dataset_that_is_not_there_is_named(tmp_path):
    refused(tmp_path / "nowhere", "nowhere")


def test_an_empty_dataset_is_refused(tmp_path):
    TrajectoryDataset.create(tmp_path / "data")
    refused(tmp_path / "data", r"data is empty: append trajectories")
    refused([], "is an empty list")


def test_a_dataset_too_short_for_a_window_is_refused():
    refused([recorded(length=6)], "has 7 images, .* takes 8: pass batch_length=7", batch_length=8)


def test_a_dataset_of_other_images_is_refused(tmp_path):
    other = Trajectory(np.zeros((9, 84, 84, 3), np.uint8), np.zeros((8, 2)))
    with TrajectoryDataset.create(tmp_path / "data", image_size=84) as dataset:
        dataset.append(other)
    refused(dataset, r"images of 84 pixels, .* copy, TrajectoryDataset\.merge\('NEW', .*size=64\)")
    for number, passed in enumerate((dataset, dataset.subset([0]), [dataset, dataset])):
        with pytest.raises(ValueError, match="images of 84 pixels") as error:
            pretrained(passed)
        remedy = str(error.value).split("copy, ")[1].replace("NEW", f"{tmp_path}/{number}")
        with pytest.warns(UserWarning, match="84 x 84 are resized to 64 x 64"):
            small = eval(remedy, {"TrajectoryDataset": TrajectoryDataset, "dataset": passed})
        assert (len(small), small.image_size) == (1 + (number == 2), 64)
    pretrained(small)
    with pytest.warns(UserWarning, match="84 x 84 are resized to 64 x 64"):
        pretrained([other])


def test_a_dataset_of_more_actions_is_refused():
    refused([recorded(actions=4)], "4 actions, .*: pass max_action_dim=4", max_action_dim=3)


def test_a_trained_model_names_the_trajectories_that_it_can_take():
    model = pretrained([recorded()], max_action_dim=3)
    dataset = TrajectoryDataset.of([recorded(), recorded(actions=4)])
    with pytest.raises(ValueError, match="max_action_dim=4 to a new model") as error:
        model.set_dataset(dataset)
    remedy = str(error.value).split("alone, ")[1]
    model.set_dataset(eval(remedy, {"dataset": dataset}))
    assert model.dataset.lengths.size == 1


def test_a_refused_dataset_leaves_the_run_folder_alone(tmp_path):
    refused([], "is an empty list", run_dir=tmp_path)
    assert list(tmp_path.iterdir()) == []


# --------------------------------------------------------------------------------------- names


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: agent(size="smal"), "No size 'smal'. Did you mean 'small'"),
        (lambda: agent(precision="fp16"), "No precision 'fp16'.* bf16, fp32"),
        (lambda: agent(guidance="linear(1)"), r"'linear\(start,end,steps\)'"),
        (lambda: agent(free_nats_mode="sum"), "No free_nats_mode 'sum'. .*element, mean"),
        (lambda: agent(offline_ratio=25), r"offline_ratio must be .* \[0, 1\], got 25"),
        (lambda: pretrained([], batchsize=3), "No keyword 'batchsize'. Did you mean 'batch_size'"),
        (lambda: pretrained([], hidden=3), "No keyword 'hidden'. .*There are: .*train_ratio"),
    ],
)
def test_an_unknown_name_lists_the_nearest(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    ("keyword", "words"),
    [
        ("gradient_steps", "as in Stable-Baselines3: use 'train_ratio' instead. It counts"),
        ("policy_kwargs", "use 'size' instead"),
        ("buffer_size", "leave 'buffer_size' out. The replay buffer keeps every episode"),
    ],
)
def test_a_keyword_of_sb3_is_answered_with_its_replacement(keyword, words):
    with pytest.raises(TypeError, match=words):
        agent(**{keyword: 3})


def test_load_refuses_unknown_keywords(tmp_path):
    agent().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"No keyword 'ent_coeff'\. Did you mean 'ent_coef'"):
        WPT.load(tmp_path / "model", ent_coeff=1e-3)


def test_the_name_of_another_policy_is_refused_with_the_one_there_is():
    with pytest.raises(ValueError, match=r"No policy 'CnnPolicy'.* There are: WPTPolicy"):
        WPT("CnnPolicy", ClockEnv(), **SETTINGS)


def test_the_constructor_refuses_unknown_keywords():
    with pytest.raises(TypeError, match="batchsize"):
        agent(batchsize=3)


# ----------------------------------------------------------------------------------------- NaN


class Faulty(ClockEnv):
    """The clock, until `at` steps in all: then a reward or an image is of no use."""

    def __init__(self, at=10, reward=None, image=None):
        super().__init__()
        self.at, self.bad_reward, self.bad_image, self.steps = at, reward, image, 0

    def step(self, action):
        image, reward, *rest = super().step(action)
        self.steps += 1
        if self.steps == self.at:
            image = image if self.bad_image is None else self.bad_image
            reward = reward if self.bad_reward is None else self.bad_reward
        return image, reward, *rest


@pytest.mark.parametrize("reward", [np.nan, np.inf])
def test_a_reward_that_is_not_finite_stops_and_costs_the_open_episode_only(reward):
    model = agent(DummyVecEnv([ClockEnv, lambda: Faulty(reward=reward)]))
    with pytest.raises(ValueError, match=r"Environment 1 returned the reward (nan|inf) at step 18"):
        model.learn(100)
    assert finite(model)
    model.learn(14, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 4


class FloatVecEnv(DummyVecEnv):
    """Hands observations out as the environment made them, as worker processes do."""

    def _save_obs(self, env_idx, obs):
        self.obs = obs

    def _obs_from_buf(self):
        return np.stack([self.obs])


def test_observations_that_are_not_bytes_stop_and_nothing_of_them_is_stored():
    image = np.full((64, 64, 3), np.nan)
    model = agent(FloatVecEnv([lambda: Faulty(image=image)]))
    with pytest.raises(ValueError, match=r"uint8 .*float64"):
        model.learn(100)
    assert finite(model)
    model.learn(7, reset_num_timesteps=False)
    assert [on_time(t) for t in model.replay_buffer.trajectories] == [True] * 2


def poison(monkeypatch, name, after, module=learner):
    """From call `after` on, the loss of this name is NaN where `module` calls it."""
    function, calls = getattr(module, name), []

    def spoilt(*args, **kwargs):
        calls.append(1)
        out = function(*args, **kwargs)
        return out * (torch.nan if len(calls) > after else 1.0)

    monkeypatch.setattr(module, name, spoilt)


@pytest.mark.parametrize(
    ("name", "network", "module"),
    [
        ("reward_loss", "world model", world_model_learner),
        ("lambda_return", "actor", learner),
        ("actor_loss", "actor", learner),
        ("critic_loss", "critic", learner),
    ],
)
def test_a_loss_that_is_nan_stops_with_finite_weights(monkeypatch, name, network, module, tmp_path):
    model = agent(ClockEnv())
    poison(monkeypatch, name, after=1, module=module)
    with pytest.raises(FloatingPointError, match=rf"{network} loss is nan.*lower the learning"):
        model.learn(100)
    assert finite(model) and model.updates == 1
    monkeypatch.undo()
    model.save(tmp_path / "rescued")
    loaded = WPT.load(tmp_path / "rescued", env=ClockEnv()).learn(14)
    assert finite(loaded)


def test_returns_that_are_nan_in_the_head_start_stop_with_a_finite_scale(monkeypatch):
    model = agent(ClockEnv(), actor_delay=100)  # in which the actor's loss does not count
    poison(monkeypatch, "lambda_return", after=1, module=learner)
    with pytest.raises(FloatingPointError, match=r"critic loss is nan.*lower the learning"):
        model.learn(100)
    assert finite(model) and model.updates == 1


@pytest.mark.parametrize(
    ("network", "name"),
    [("world_model.encoder", "world model"), ("actor", "actor"), ("critic", "critic")],
)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_gradient_that_is_not_finite_stops_though_the_loss_is(network, name, value):
    model = agent(ClockEnv()).learn(28)
    before = weights(model)
    updates = model.updates
    parameter = next(model.policy.get_submodule(network).parameters())
    hook = parameter.register_hook(lambda gradient: torch.full_like(gradient, value))
    with pytest.raises(FloatingPointError, match=rf"The {name} loss is -?\d.*, its gradient norm"):
        model.learn(100, reset_num_timesteps=False)
    assert finite(model) and model.updates == updates
    of_it = weights(model, network)
    assert all((of_it[key] == before[key]).all() for key in of_it)  # no step was taken
    hook.remove()
    assert finite(model.learn(28, reset_num_timesteps=False))


def test_a_clone_whose_loss_is_nan_stops_with_finite_weights(monkeypatch):
    model = pretrained([recorded()], env=DotEnv())
    poison(monkeypatch, "bc_loss", after=1, module=cloning)
    with pytest.raises(FloatingPointError, match="bc loss is nan"):
        model.learn(LENGTH)
    assert finite(model) and model.prior is None


def test_pretraining_that_diverges_keeps_its_last_checkpoint(monkeypatch, tmp_path):
    monkeypatch.setattr(pretraining, "SAVE_EVERY", 2)

    def damage(step, _):
        if step == 3:
            raise_at_next_update()

    def raise_at_next_update():
        loss = world_model_learner.world_model_update_loss

        def spoilt(*args, **kwargs):
            parts, post = loss(*args, **kwargs)
            return parts._replace(total=parts.total * torch.nan), post

        monkeypatch.setattr(world_model_learner, "world_model_update_loss", spoilt)

    with pytest.raises(FloatingPointError, match="world model loss is nan"):
        pretrained([recorded()], steps=6, run_dir=tmp_path, callback=damage)
    monkeypatch.undo()
    steps = []
    resumed = pretrained(
        [recorded()], steps=4, run_dir=tmp_path, callback=lambda k, _: steps.append(k)
    )
    assert steps == [3, 4] and finite(resumed)


def test_damaged_weights_do_not_act():
    model = agent(ClockEnv())
    with torch.no_grad():
        model.policy.actor.layers[-1].bias[:] = torch.nan
    with pytest.raises(ValueError, match="weights are damaged"):
        model.predict(noise())


def test_the_debug_settings_are_all_keywords_of_the_constructor():
    assert set(SETTINGS) <= inspect.signature(WPT).parameters.keys()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gamma", 1.5, r"gamma must be a number in \[0, 1\], got 1.5"),
        ("gamma", "high", "gamma must be a number in"),
        ("batch_size", 0, "batch_size must be a whole number of at least 1, got 0"),
        ("imagine_horizon", 2.5, "imagine_horizon must be a whole number of at least 2"),
        ("imagine_horizon", 1, "imagine_horizon must be a whole number of at least 2, got 1"),
        ("batch_size", 16.0, "batch_size must be a whole number of at least 1, got 16.0"),
        ("batch_size", float("inf"), "batch_size must be a whole number of at least 1, got inf"),
        ("num_retrieve", True, "num_retrieve must be a whole number of at least 1, got True"),
        ("episode_length", -5, "episode_length must be a whole number of at least 1, got -5"),
        ("train_ratio", None, "train_ratio must be a number of at least 0, got None"),
        ("return_norm", "no", "return_norm must be True or False, got 'no'"),
        ("size", 3, "No size 3"),
        ("size", asdict(SIZES["debug"]) | {"gates": "over"}, "No gate layout 'over'"),
        ("size", asdict(SIZES["debug"]) | {"depht": 4}, "No field of Size 'depht'.*depth"),
        ("size", asdict(SIZES["debug"]) | {"hidden": 30.0}, "hidden must be a whole number"),
        ("size", asdict(SIZES["debug"]) | {"deter": 60}, "deter=60 cannot be divided into 8"),
        ("size", asdict(SIZES["debug"]) | {"norm_eps": 0}, "norm_eps must be a number above 0"),
        ("size", {"deter": 64}, "lacks hidden, stoch, classes, depth, units"),
        ("unimix", 0, "unimix must be a number above 0"),
        ("train_ratio", -1, "train_ratio must be a number of at least 0, got -1"),
        ("learning_rate", float("nan"), "learning_rate must be a number of at least 0"),
    ],
)
def test_a_value_that_makes_no_sense_is_refused_by_name(name, value, message):
    with pytest.raises(ValueError, match=message):
        agent(**{name: value})


@pytest.mark.parametrize("name", Hyperparameters.declared())
def test_every_keyword_is_checked_and_none_is_without_documentation_and_stage(name):
    with pytest.raises((ValueError, TypeError), match=name.replace("_", ".")):
        Hyperparameters.of({name: object()})
    declared = Hyperparameters.declared()[name]
    assert len(declared.doc) > 5 and not declared.doc.endswith(".")
    if Hyperparameters().value(name) is not None and name not in SIZES_OWN:
        with pytest.raises(ValueError, match=name):
            Hyperparameters.of({name: None})


def test_what_open_loop_cannot_show_is_refused_by_name():
    model, seen = agent(), recorded(actions=2)
    with pytest.raises(ValueError, match=r"context, .* at least 1, got 0"):
        model.open_loop(seen, context=0)
    with pytest.raises(ValueError, match=r"6 actions.*max_action_dim=4"):
        model.open_loop(Trajectory(seen.image, np.zeros((8, 6), np.float32)))
    with pytest.raises(ValueError, match=r"\(32, 32, 3\)"):
        model.open_loop(Trajectory(seen.image[:, ::2, ::2], seen.action))
    with pytest.raises(ValueError, match="No dataset to index"):
        model.build_index()


def test_a_plan_with_such_a_value_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(ValueError, match="gamma must be a number in"):
        make_plan("dmc", ["walker-run"], Request("debug", settings=["gamma=high"], out=tmp_path))


@pytest.mark.parametrize("task", ["metaworld-drawer-close", "drawer-close"])
def test_a_task_of_another_suite_is_told_its_suite(tmp_path, task):
    with pytest.raises(ValueError, match=r"of the suite metaworld: (pass )?--suite metaworld"):
        make_plan("dmc", [task], Request("debug", out=tmp_path))
