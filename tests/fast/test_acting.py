"""The fast step of acting is the defined one, whatever happens to the weights."""

import copy
import gc
import io
import pickle
import weakref
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
import torch
from debug_agent import agent, noise
from stable_baselines3.common.utils import polyak_update
from torch.utils._python_dispatch import TorchDispatchMode
from toy_env import LENGTH, DotEnv

from wpt_agents.fast import acting, acting_networks
from wpt_agents.fast.acting import fast_step, networks_are_known
from wpt_agents.fast.acting_networks import PATCHES
from wpt_agents.model.ops import definitions
from wpt_agents.model.policy import WPTPolicy
from wpt_agents.model.sizes import SIZES

NAMES = ("deter", "stoch", "action")


def acted(policy, n, deterministic=False, steps=3):
    """State and action after some steps; at the last of them, one environment begins an episode."""
    state, generator = None, torch.Generator().manual_seed(0)
    for t in range(steps):
        first = np.arange(n) == (n - 1 if t == steps - 1 else -1)
        image = noise(n, seed=t)
        _, state = policy.act(image, state, first, deterministic, generator)
    return dict(zip(NAMES, state, strict=True))


def by_definition(policy, *args, **kwargs):
    with definitions():
        return acted(policy, *args, **kwargs)


def assert_defined(policy, n=1, **kwargs):
    fast, expected = acted(policy, n, **kwargs), by_definition(policy, n, **kwargs)
    assert networks_are_known(policy)
    for name in NAMES:
        np.testing.assert_allclose(fast[name], expected[name], atol=1e-5, err_msg=name)


ACROSS = replace(SIZES["tiny"], gates="across", norm_eps=0.3)


@pytest.mark.parametrize("size", ["debug", "tiny", ACROSS])
@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("n", [1, 2, PATCHES // 36 + 1])  # 14 x 14 patches make 6 x 6
def test_the_quick_step_is_the_defined_one(size, deterministic, n):
    assert_defined(agent(size=size).policy, n, deterministic=deterministic)


@pytest.mark.parametrize("n", [1, 3])
def test_a_wide_z_picks_rows(n, monkeypatch):
    monkeypatch.setattr(acting_networks, "WIDE_STOCH", 64)
    policy = agent(size="tiny").policy
    assert fast_step(policy).outputs.from_stoch.rows is not None
    assert_defined(policy, n)


def test_the_quick_step_calls_fewer_operators():
    class Count(TorchDispatchMode):
        calls = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            self.calls += 1
            return func(*args, **kwargs or {})

    policy, counts = agent().policy, []
    for play in (acted, by_definition):
        play(policy, 1)
        with torch.no_grad(), Count() as count:
            play(policy, 1)
        counts.append(count.calls)
    assert counts[0] < 0.85 * counts[1], counts


def test_every_changed_weight_is_noticed():
    policy = agent().policy
    acted(policy, 1)
    for network in (policy.world_model.encoder, policy.world_model.rssm, policy.actor):
        for weight in network.parameters():
            with torch.no_grad():
                weight.add_(0.1 * torch.randn(weight.shape, generator=torch.Generator()))
    assert_defined(policy)
    for weight in (policy.world_model.rssm.post_in.weight, policy.actor.layers[0][0].bias):
        before = acted(policy, 1)["action"]
        with torch.no_grad():
            weight.mul_(-3)
        assert (acted(policy, 1)["action"] != before).any()
        assert_defined(policy)


def test_updates_and_loaded_and_replaced_weights_are_noticed():
    model, other = agent(DotEnv()), agent(seed=5).policy
    policy = model.policy
    model.learn(2 * LENGTH)
    assert model.updates > 0
    assert_defined(policy)
    policy.load_state_dict(other.state_dict())
    assert_defined(policy)
    policy.load_state_dict(agent(seed=6).policy.state_dict(), assign=True)
    assert_defined(policy)
    policy.reset_behavior()
    assert_defined(policy)
    for seed in range(3):  # in new memory, maybe that of the vector before
        vector = policy.parameters_to_vector()
        policy.load_from_vector(vector + np.random.default_rng(seed).normal(0, 0.1, vector.shape))
        assert_defined(policy)


def test_weights_that_are_written_behind_autograds_back_are_noticed():
    policy, other = agent().policy, agent(seed=5).policy
    before = acted(policy, 1)["action"]
    polyak_update(other.actor.parameters(), policy.actor.parameters(), tau=0.5)  # of `weight.data`
    assert (acted(policy, 1)["action"] != before).any()
    assert_defined(policy)
    policy.world_model.encoder.layers[0].weight.detach().numpy()[:] *= 2
    assert_defined(policy)


def test_images_may_lie_in_memory_as_they_like():
    policy, image = agent().policy, noise(2)
    turned = np.ascontiguousarray(image.transpose(0, 3, 1, 2)).transpose(0, 2, 3, 1)
    action, other = (policy.act(x, None, None, deterministic=True)[0] for x in (image, turned))
    np.testing.assert_array_equal(action, other)


def test_foreign_networks_act_by_the_definition():
    policy = agent().policy
    expected = acted(policy, 2)
    policy.actor = torch.compile(policy.actor, backend="eager")
    assert not networks_are_known(policy)
    for name, value in acted(policy, 2).items():
        np.testing.assert_allclose(value, expected[name], atol=1e-5)


def test_weights_that_count_no_changes_act_by_the_definition():
    with torch.inference_mode():
        policy = agent().policy
        assert not networks_are_known(policy)
        acted(policy, 1)


def test_the_step_is_made_again_when_weights_change_and_only_then():
    model = agent(DotEnv())
    model.learn(2 * LENGTH)
    made = fast_step(model.policy)
    acted(model.policy, 2)
    assert fast_step(model.policy) is made
    model.update(defaultdict(list))
    assert fast_step(model.policy) is not made


def action(policy):
    return policy.act(noise(1, seed=3), None, None, deterministic=True)[0]


@pytest.fixture(scope="module")
def learnt():
    """A policy that has learned and acted: at this moment copies used to fail."""
    model = agent(DotEnv())
    model.learn(2 * LENGTH)
    assert model.updates > 0
    acted(model.policy, 1)
    return model.policy


def pickled(policy):
    return pickle.loads(pickle.dumps(policy))


def stored(policy):
    file = io.BytesIO()
    torch.save(policy, file)
    file.seek(0)
    return torch.load(file, weights_only=False)


@pytest.mark.parametrize("copied", [copy.deepcopy, pickled, stored])
def test_a_copy_acts_alike_and_on_its_own(learnt, copied):
    twin, before = copied(learnt), action(learnt)
    np.testing.assert_array_equal(action(twin), before)
    with torch.no_grad():
        twin.actor.layers[-1].bias.add_(1)
    assert (action(twin) != before).any()
    np.testing.assert_array_equal(action(learnt), before)
    assert_defined(twin)
    assert_defined(learnt)


def test_averaged_weights_act_after_each_update(learnt):
    averaged = torch.optim.swa_utils.AveragedModel(learnt)
    first = action(averaged.module)
    np.testing.assert_array_equal(first, action(learnt))
    other = agent(seed=5).policy
    for _ in range(2):
        averaged.update_parameters(other)  # the second time the two are averaged
        assert_defined(averaged.module)
    assert (action(averaged.module) != first).any()


def test_a_policy_is_saved_and_loaded_alone(learnt, tmp_path):
    learnt.save(tmp_path / "policy.pth")
    loaded = WPTPolicy.load(tmp_path / "policy.pth", device="cpu")
    np.testing.assert_array_equal(action(loaded), action(learnt))
    assert loaded.action_space == learnt.action_space
    assert_defined(loaded)


def test_a_policy_is_loaded_with_the_heads_that_only_some_have_and_with_ibrl(learnt, tmp_path):
    model = copy.deepcopy(learnt)
    model.world_model.make_continue_head(1.0, 0)
    model.world_model.make_reward_members([0, 1])
    model.average(0.5)
    model.ibrl = True
    model.save(tmp_path / "policy.pth")
    loaded = WPTPolicy.load(tmp_path / "policy.pth", device="cpu")
    feat = torch.randn(5, learnt.size.deter + learnt.size.stoch * learnt.size.classes)
    assert torch.equal(loaded.world_model.rewards(feat), model.world_model.rewards(feat))
    assert torch.equal(loaded.world_model.goes_on(feat), model.world_model.goes_on(feat))
    assert loaded.average_actor is not None and loaded.ibrl
    np.testing.assert_array_equal(action(loaded), action(model))


def test_a_policy_that_is_no_longer_used_is_forgotten():
    policy = agent().policy
    acted(policy, 1)
    assert policy in acting._fast_steps
    gone = weakref.ref(policy)
    del policy
    gc.collect()
    assert gone() is None
