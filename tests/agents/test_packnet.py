"""PackNet: equal shares by magnitude, and earlier tasks that act bit-equal after later ones."""

import copy
import pickle
import sys
from collections import defaultdict

import numpy as np
import pytest
import torch
from debug_agent import ClockEnv, noise, same, weights
from torch import nn
from toy_env import DotEnv

from wpt_agents.agents.drqv2 import DrQv2
from wpt_agents.agents.packnet import FREE, PackNet, prune

SETTINGS = {
    "channels": 6,
    "feature_dim": 8,
    "hidden_dim": 16,
    "batch_size": 4,
    "learning_starts": 0,
    "warmup_steps": 0,
    "train_freq": "episode",
    "std": 0.3,
    "retrain": 0.5,
    "tasks": 3,
    "seed": 0,
    "device": "cpu",
}
IMAGES = noise(5)


def agent(env=None, **changes):
    return PackNet("CnnPolicy", env or DotEnv(), **SETTINGS | changes)


def actions(policy):
    return policy.predict(IMAGES, deterministic=True)[0]


def test_pruning_by_hand():
    weight = torch.tensor([[0.1, -5.0, 2.0], [-0.3, 4.0, 0.0]])
    owner = torch.tensor([[FREE, 0, FREE], [FREE, FREE, FREE]], dtype=torch.int8)
    # five are free, and one task comes after: round(5 / 2) = 2 are kept, those of 4 and 2
    after = prune(weight, owner, task=1, tasks_left=1)
    assert after.tolist() == [[FREE, 0, 1], [FREE, 1, FREE]]


def test_a_sequence_shares_the_weights_equally():
    owner = torch.full((100, 7), FREE, dtype=torch.int8)
    for task, left in ((0, 5), (1, 4), (2, 3), (3, 2), (4, 1)):
        owner = prune(torch.randn(100, 7), owner, task, left)
    shares = [(owner == task).sum().item() for task in (0, 1, 2, 3, 4, FREE)]
    assert sum(shares) == 700 and max(shares) - min(shares) <= 1


def test_the_first_task_is_learned_as_by_drqv2():
    settings = {k: v for k, v in SETTINGS.items() if k not in ("retrain", "tasks")}
    ours, plain = agent(ClockEnv(25)), DrQv2("CnnPolicy", ClockEnv(25), **settings)
    names = "encoder", "actor", "critic", "target_critic"
    before = weights(plain, *names)
    assert same(before, weights(ours, *names))
    assert same(weights(ours.learn(50), *names), weights(plain.learn(50), *names))
    assert not same(before, weights(plain, *names))


@pytest.mark.slow
def test_earlier_tasks_act_bit_equal_after_later_ones():
    model, at_the_end = agent(), []
    for task in range(3):
        model.learn(25)
        if task < 2:
            model.next_task(DotEnv())
            at_the_end.append(actions(model.policy_of(task)))
    model.learn(25)
    assert model.progress.task == 2
    for task, then in enumerate(at_the_end):
        assert (actions(model.policy_of(task)) == then).all()
    assert (actions(model.policy_of(0)) != actions(model.policy_of(2))).any()
    assert (actions(model.policy_of(0)) != actions(model.policy_of(1))).any()


def test_the_retrained_policy_is_what_a_task_keeps():
    model = agent().learn(25)
    model.policy.prune(0, 2)
    model.policy.freeze_rest()
    pruned = weights(model, "actor", "encoder")
    model._retrain(False)
    after = weights(model, "actor", "encoder")
    for name, weight in model.policy.managed():
        owned = model.policy.owner(name) == 0
        assert (weight[~owned] == 0).all()  # free weights stay out of it
        changed = (pruned[name] != after[name]) & owned
        assert changed.any(), name
    rest = after.keys() - {name for name, _ in model.policy.managed()}
    assert rest and all((pruned[k] == after[k]).all() for k in rest)


def test_a_later_task_changes_only_free_weights_and_draws_a_new_critic():
    model = agent().learn(25)
    critic = weights(model, "critic")
    model.next_task(DotEnv())
    assert not model.replay_buffer.trajectories and not same(critic, weights(model, "critic"))
    before = weights(model, "actor", "encoder")
    model.learn(25)
    after = weights(model, "actor", "encoder")
    for name, _ in model.policy.managed():
        owned = model.policy.owner(name) == 0
        assert owned.float().mean() == pytest.approx(1 / 3, abs=0.1)
        assert (before[name] == after[name])[owned].all()
        assert (before[name] != after[name])[~owned].any()
    frozen = before.keys() - {name for name, _ in model.policy.managed()}
    assert any("bias" in k for k in frozen) and any("trunk.1" in k for k in frozen)
    assert all((before[k] == after[k]).all() for k in frozen)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
def test_a_copy_leaves_the_weights_of_earlier_tasks_alone(copied):
    model = agent(ClockEnv(25)).learn(25)
    model.next_task(ClockEnv(25))
    other = copied(model)
    other.set_env(ClockEnv(25))
    before = actions(other.policy_of(0))
    other.learn(25)
    assert other.updates > model.updates
    assert (actions(other.policy_of(0)) == before).all()


def test_another_action_width_begins_a_new_sequence(tmp_path):
    model = agent(ClockEnv(25), tasks=2).learn(25)
    model.next_task(ClockEnv(25))
    model.set_env(ClockEnv(25, actions=5))
    assert model.progress.task == 0
    model.learn(25)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay.zip")
    loaded = PackNet.load(tmp_path / "model", env=ClockEnv(25, actions=5), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    for one in (model, loaded):
        one.learn(25, reset_num_timesteps=False)
        one.next_task(ClockEnv(25, actions=5))
    assert model.progress == loaded.progress and same(weights(model), weights(loaded))


def test_a_task_whose_end_failed_goes_on_and_can_be_ended_again(tmp_path, monkeypatch):
    model = agent(ClockEnv(25)).learn(25)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay.zip")
    loaded = PackNet.load(tmp_path / "model", env=ClockEnv(25), device="cpu")
    with pytest.raises(ValueError, match=r"load_replay_buffer\(\) first, or set model.retrain = 0"):
        loaded.next_task(ClockEnv(25))
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    update = PackNet.update

    def interrupted(self, metrics):
        update(self, metrics)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(PackNet, "update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            loaded.next_task(ClockEnv(25))
    assert loaded.progress == model.progress and same(weights(model), weights(loaded))
    for one in (model, loaded):
        one.next_task(ClockEnv(25))
        one.learn(25)
    assert loaded.progress == model.progress and same(weights(model), weights(loaded))


@pytest.mark.parametrize("by_file", [True, False])
def test_parameters_of_another_task_are_loaded_in_place(by_file, tmp_path):
    first = agent(ClockEnv(25)).learn(25)
    later = agent(ClockEnv(25)).learn(25)
    later.next_task(ClockEnv(25))
    later.learn(25)
    for source, target in ((later, agent(ClockEnv(25))), (first, later)):
        source.save(tmp_path / "model")
        target.set_parameters(tmp_path / "model" if by_file else source.get_parameters())
        assert target.progress.task == source.progress.task
        target.updates = source.updates
        target.replay_buffer = source.replay_buffer
        for one in (source, target):
            one.update(defaultdict(list))
        assert same(weights(source), weights(target))


def test_freed_weights_are_drawn_again():
    model = agent().learn(25)
    model.next_task(DotEnv())
    for name, weight in model.policy.managed():
        assert (weight[model.policy.owner(name) == FREE] != 0).float().mean() > 0.9


def test_stale_moments_would_move_masked_weights_and_a_fresh_adam_does_not():
    for fresh in (False, True):
        weight = nn.Parameter(torch.ones(4))
        adam = torch.optim.Adam([weight], 1e-2)
        weight.sum().backward()
        adam.step()
        before, weight.grad = weight.detach().clone(), torch.zeros(4)
        if fresh:
            adam = torch.optim.Adam([weight], 1e-2)
        adam.step()
        assert torch.equal(weight.detach(), before) == fresh


@pytest.mark.slow
@pytest.mark.parametrize("at", [25, 75])
def test_a_loaded_model_goes_on_exactly_in_any_task(at, tmp_path):
    # every episode of this environment is alike, whatever its seed
    def run(model, steps):
        while steps:
            left = 50 - model.num_timesteps
            now = min(left, steps)
            model.learn(now, reset_num_timesteps=False)
            steps -= now
            if model.num_timesteps == 50 and steps:
                model.next_task(ClockEnv(25))
                model.num_timesteps = 0
        return model

    whole = run(agent(ClockEnv(25)), 100)
    half = run(agent(ClockEnv(25)), at)
    half.save(tmp_path / "model")
    half.save_replay_buffer(tmp_path / "replay.zip")
    loaded = PackNet.load(tmp_path / "model", env=ClockEnv(25), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay.zip")
    assert same(weights(half), weights(loaded))
    run(loaded, 100 - at)
    assert loaded.progress == whole.progress and same(weights(whole), weights(loaded))


def test_a_sequence_that_is_over_and_another_action_width_are_refused():
    model = agent(tasks=2).learn(25)
    with pytest.raises(ValueError, match="actions of one width"):
        model.next_task(ClockEnv(actions=5))
    model.next_task(DotEnv())
    with pytest.raises(ValueError, match="no further task"):
        model.next_task(DotEnv())
    assert np.isfinite(actions(model.policy_of(1))).all()
    with pytest.raises(ValueError, match="no policy of task 2 yet: pass a number from 0 to 1"):
        model.policy_of(2)


def test_noise_warm_up_and_the_first_update_begin_again_with_every_task():
    changes = {"std": "linear(1,0,50)", "learning_starts": 20, "warmup_steps": 10}
    model = agent(ClockEnv(25), **changes).learn(25)
    made = model.updates
    assert model.std_now == 0.5 and made > 0
    model.next_task(ClockEnv(25))
    retrained = model.updates
    assert model.std_now == 1.0 and model.num_timesteps == 0
    drawn, window = [], model._next_window
    model._next_window = lambda: drawn.append(window()) or drawn[-1]
    model.learn(25, reset_num_timesteps=False)
    assert drawn[0] == (0, sys.maxsize)  # the whole first episode is random, as in the first task
    assert model.updates - retrained == made
