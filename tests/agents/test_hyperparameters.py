"""Keywords of a WPT: written, they are checked, take effect and are saved, or say why not."""

import inspect
from collections import defaultdict
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
import torch
from debug_agent import SETTINGS, agent, noise, pretrained, recorded, same, weights
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.curious import Plan2Explore
from wpt_agents.agents.wpt import WPT
from wpt_agents.model import ops
from wpt_agents.training.hyperparameters import FINE_TUNING, Hyperparameters
from wpt_agents.training.keywords import Stage


@pytest.fixture
def data():
    return [recorded(seed=seed) for seed in range(4)]


def test_the_signature_is_flat_and_holds_every_keyword_with_its_default():
    parameters = inspect.signature(WPT).parameters
    for name, keyword in Hyperparameters.declared().items():
        assert parameters[name].default == getattr(Hyperparameters(), name), name
        assert f":param {name}: {keyword.doc.split()[0]}" in WPT.__doc__
    rest = parameters.keys() - Hyperparameters.declared().keys()
    public = {name for name in rest if not name.startswith("_")}
    assert public == {"policy", "env", "dataset", "tensorboard_log", "verbose", "device"}


def test_a_discount_that_is_written_takes_effect_and_is_saved(tmp_path):
    model, other = agent(DotEnv()), agent(DotEnv(), gamma=0.5)
    model.gamma = 0.5
    assert model.gamma == model.learner.hyperparameters.gamma == 0.5
    assert same(weights(model.learn(2 * LENGTH)), weights(other.learn(2 * LENGTH)))
    model.save(tmp_path / "model")
    assert WPT.load(tmp_path / "model").gamma == 0.5


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("gamma", 1.5, r"gamma must be a number in \[0, 1\], got 1.5"),
        ("train_freq", "nonsense", "No train_freq 'nonsense'"),
        ("guidance", "linear(1)", r"guidance='linear\(1\)' is not understood"),
        ("size", "tiny", "size='tiny' can no longer take effect: the networks are made; make a"),
        ("batch_length", 50, "pass batch_length=9 or less"),
    ],
)
def test_a_value_that_is_refused_says_why_and_changes_nothing(data, name, value, message):
    model = pretrained(data)
    before = model.hyperparameters
    with pytest.raises(ValueError, match=message):
        setattr(model, name, value)
    assert model.hyperparameters is before and getattr(model, name) == before.value(name)
    assert model.learner.hyperparameters == before.resolved()


def test_a_keyword_of_a_stage_that_is_over_says_how_to_go_back_to_it(data):
    model = pretrained(data, env=DotEnv())
    model.bc_steps = 3  # not cloned yet
    model.num_retrieve = 2
    model.learn(1)
    assert len(model.retrieved_ids) == 2
    with pytest.raises(ValueError, match=r"bc_steps=5 .* prior actor is cloned; call reset_task"):
        model.bc_steps = 5
    with pytest.raises(ValueError, match=r"num_retrieve=3 .* are retrieved; call reset_task"):
        model.num_retrieve = 3
    model.reset_task()
    model.bc_steps = 5
    model.num_retrieve = 3
    assert len(model.learn(1).retrieved_ids) == 3


def test_kickstarting_can_begin_at_any_time(data):
    model = pretrained(data, env=DotEnv()).learn(LENGTH)
    metrics = defaultdict(list)
    model.update(metrics)
    assert "train/kickstart_loss" not in metrics
    model.kickstart = 20
    model.update(metrics)
    assert len(metrics["train/kickstart_loss"]) == 1


def test_learning_rates_are_the_sizes_own_until_they_are_written():
    model = agent()
    assert model.learning_rate == model.actor_critic_learning_rate == 1e-3  # of debug
    assert model.hyperparameters.learning_rate is None
    model.learning_rate = 0.5
    rates = [group["lr"] for group in model.learner.model_optimizer.param_groups]
    assert rates == [0.5, 0.5] and model.learner.actor_optimizer.param_groups[0]["lr"] == 1e-3
    decays = [g["lr"] * g["weight_decay"] for g in model.learner.model_optimizer.param_groups]
    assert decays == pytest.approx([1e-6, 1e-6])


def test_an_explorers_own_optimiser_follows_the_learning_rate():
    model = Plan2Explore("WPTPolicy", **SETTINGS)
    model.learning_rate = 0.5
    assert model.learner.curiosity_optimizer.param_groups[0]["lr"] == 0.5


def test_hyperparameters_themselves_cannot_be_written():
    with pytest.raises(FrozenInstanceError):
        agent().hyperparameters.gamma = 0.5


@pytest.mark.parametrize(
    ("name", "value", "why"),
    [
        ("zero_init_heads", True, r"weights are loaded; call reset_task\(\) to draw others"),
        ("actor_outscale", 0.01, r"weights are loaded; call reset_task\(\) to draw others"),
        ("num_retrieve", 1, r"trajectories are retrieved; call reset_task\(\)"),
        ("bc_steps", 1, r"prior actor is cloned; call reset_task\(\)"),
    ],
)
def test_a_keyword_that_comes_too_late_for_a_model_file_is_warned_of(
    data, name, value, why, tmp_path
):
    model = pretrained(data, env=DotEnv(), zero_init_heads=False).learn(1)
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=f"{name}={value} has no effect yet: .*{why}") as caught:
        WPT.load(tmp_path / "model", **{name: value})
    assert caught[0].filename == __file__
    WPT.load(tmp_path / "model", **{name: getattr(model, name)})  # says nothing
    WPT.load(tmp_path / "model", dataset=[recorded(seed=9)], num_retrieve=1, bc_steps=1)


def test_a_keyword_that_was_warned_of_takes_effect_after_a_reset(tmp_path):
    agent().save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"actor_outscale=0.0 has no effect yet"):
        loaded = WPT.load(tmp_path / "model", actor_outscale=0.0)
    assert loaded.policy.actor.layers[-1].weight.any()
    loaded.reset_task()
    assert not loaded.policy.actor.layers[-1].weight.any()


def test_no_keyword_comes_too_late_where_other_actions_begin_a_new_task(data, tmp_path):
    pretrained(data, env=DotEnv()).learn(1).save(tmp_path / "model")
    late = {"actor_outscale": 0.0, "num_retrieve": 1, "bc_steps": 1}
    loaded = WPT.load(tmp_path / "model", env=DotEnv(actions=3), **late)  # says nothing
    assert not loaded.policy.actor.layers[-1].weight.any()
    assert not loaded.retrieved_ids and loaded.prior is None


def test_a_keyword_of_new_heads_takes_effect_where_a_file_has_none(tmp_path):
    model = agent(zero_init_heads=False)
    model.save_world_model(tmp_path / "shared.zip")
    loaded = WPT.load(tmp_path / "shared.zip", zero_init_heads=True)
    assert not loaded.policy.critic.layers[-1].weight.any()
    assert model.policy.critic.layers[-1].weight.any()


def test_fine_tuning_keywords_are_those_that_pre_training_does_not_use():
    assert {"gamma", "guidance", "bc_steps", "num_retrieve", "actor_delay", "fast"} <= FINE_TUNING
    assert not {"size", "batch_size", "learning_rate", "unimix", "seed"} & FINE_TUNING
    stages = {keyword.stage for keyword in Hyperparameters.declared().values()}
    assert stages == set(Stage)


def test_a_model_of_keywords_of_numpy_holds_pythons_own():
    assert type(Hyperparameters(gamma=np.float32(0.5)).gamma) is float


def test_without_fast_no_twin_is_used_and_the_numbers_are_close(data, monkeypatch):
    fast = pretrained(data, env=DotEnv())
    used = []
    for op in ops.OPERATIONS:
        twins = [(when, noting(twin, used)) for when, twin in op.twins]
        monkeypatch.setattr(op, "twins", twins)
    slow = pretrained(data, env=DotEnv(), fast=False).learn(LENGTH)
    slow.predict(noise(2))
    slow.update(defaultdict(list))
    assert not used
    fast.predict(noise(2))
    assert used
    slow.fast = True
    used.clear()
    slow.predict(noise(2))
    assert used
    one, other = weights(fast, "world_model"), weights(pretrained(data, fast=False), "world_model")
    torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-4)


def noting(twin, used):
    def noted(*args, **kwargs):
        used.append(twin)
        return twin(*args, **kwargs)

    return noted
