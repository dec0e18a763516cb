"""Imitation of the prior actor from fixed latent states."""

from collections import defaultdict

import pytest
import torch
from debug_agent import pretrained, recorded, same, weights
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.model.behavior_cloning import FRAMES
from wpt_agents.training import imitating
from wpt_agents.training.imitating import imitate, states_and_advice


@pytest.fixture
def store(tmp_path):
    with TrajectoryDataset.create(tmp_path / "data") as dataset:
        dataset.extend(recorded(seed=i, embodiment="dot") for i in range(4))
    return dataset


def learner_and_batches(store, **settings):
    model = pretrained(store, env=DotEnv(), guidance=1, **settings).learn(2 * LENGTH)
    rng = model.streams.numpy(0, 0)
    return model, [model.mixed_batch(rng) for _ in range(3)]


def error(model, actor, feats, advice):
    mask = model.policy.action_mask
    with torch.no_grad():
        return (actor.dist(feats, mask).mode - advice)[:, mask].square().mean().item()


def test_the_states_are_those_of_images_that_the_prior_actor_can_see(store):
    model, batches = learner_and_batches(store)
    feats, advice = states_and_advice(model.learner, batches, model.streams)
    rows, length = batches[0].is_first.shape
    assert len(feats) == len(advice) == 3 * rows * (length - FRAMES + 1)
    frames = batches[1].image[0, :FRAMES]
    assert not batches[1].is_first[0, 1:FRAMES].any()  # they are of one episode
    expected = model.policy.prior_actor.act(frames[None], model.policy.action_mask)
    number = rows * (length - FRAMES + 1)
    torch.testing.assert_close(advice[number], expected[0], atol=1e-5, rtol=0)


def test_a_copy_of_the_actor_learns_the_prior_actors_actions(store):
    model, batches = learner_and_batches(store)
    feats, advice = states_and_advice(model.learner, batches, model.streams)
    before = weights(model)
    actor, loss = imitate(model.learner, batches, 200, 16, model.streams)
    assert same(before, weights(model))  # nothing but the copy has changed
    begun = error(model, model.policy.actor, feats, advice)
    assert error(model, actor, feats, advice) < begun / 10
    assert loss < begun / 10


def test_the_rate_falls_from_that_of_actor_and_critic_to_zero(store, monkeypatch):
    model, batches = learner_and_batches(store)
    rates, descend = [], model.learner.descend

    def noted(optimizer, *args):
        rates.append(optimizer.param_groups[0]["lr"] / model.learner.actor_critic_rate)
        return descend(optimizer, *args)

    monkeypatch.setattr(model.learner, "descend", noted)
    imitate(model.learner, batches, 4, 16, model.streams)
    assert rates == pytest.approx([1, 0.75, 0.5, 0.25])


def test_the_agent_imitates_once_after_the_head_start_of_each_task(store, monkeypatch):
    calls, metrics = [], []

    def noted(learner, batches, steps, *args):
        calls.append((model.task_updates, len(list(batches)), steps))
        return learner.policy.actor, torch.tensor(0.5)

    monkeypatch.setattr("wpt_agents.agents.wpt.imitate", noted)
    settings = {"guidance": 1, "actor_delay": 3, "imitation_steps": 150}
    model = pretrained(store, env=DotEnv(), learning_starts=LENGTH, **settings)
    update = model.update

    def watched(_):
        lists = defaultdict(list)
        update(lists)
        metrics.append("train/imitation_loss" in lists)

    monkeypatch.setattr(model, "update", watched)
    model.learn(4 * LENGTH)
    assert calls == [(3, 2, 150)]  # 150 steps need two batches
    assert metrics[:4] == [False, False, True, False]
    model.reset_task()
    assert not model.progress.imitated


def test_an_interrupted_imitation_is_made_again(store, monkeypatch):
    settings = {"guidance": 1, "actor_delay": 2, "imitation_steps": 20}
    model = pretrained(store, env=DotEnv(), learning_starts=LENGTH, **settings)
    calls, bc_loss = [], imitating.bc_loss

    def interrupted(*args):
        calls.append(args)
        if len(calls) == 5:
            raise KeyboardInterrupt
        return bc_loss(*args)

    monkeypatch.setattr(imitating, "bc_loss", interrupted)
    with pytest.raises(KeyboardInterrupt):
        model.learn(2 * LENGTH)
    assert not model.progress.imitated and model.task_updates == 2
    model.learn(LENGTH, reset_num_timesteps=False)
    assert model.progress.imitated and len(calls) == 25


def test_it_needs_a_prior_actor_and_is_remembered(store, tmp_path):
    model = pretrained(store, env=DotEnv(), guidance=0, imitation_steps=2).learn(2 * LENGTH)
    assert model.prior is None and not model.progress.imitated
    model = pretrained(store, env=DotEnv(), guidance=1, imitation_steps=2).learn(2 * LENGTH)
    model.save(tmp_path / "model")
    assert WPT.load(tmp_path / "model").progress.imitated
    with pytest.raises(ValueError, match=r"imitation_steps .*3 images.*batch_length=2"):
        pretrained(store, env=DotEnv(), guidance=1, imitation_steps=2, batch_length=2)
