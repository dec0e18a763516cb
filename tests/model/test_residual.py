"""Acting by the clone's action, corrected by what imagination has changed (`residual`)."""

from collections import defaultdict
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from debug_agent import agent, assert_goes_on_exactly, noise, pretrained, recorded, same, weights
from toy_env import LENGTH, DotEnv

from wpt_agents.agents.wpt import WPT
from wpt_agents.data.dataset import TrajectoryDataset
from wpt_agents.model.choosing import corrected
from wpt_agents.model.distributions import TruncatedNormal
from wpt_agents.model.observations import stack_frames
from wpt_agents.model.prior_policy import prior_action
from wpt_agents.model.rssm import Latent


@pytest.fixture(scope="module")
def data():
    return TrajectoryDataset.of([recorded(seed=seed, length=12) for seed in range(6)])


def learned(data, **changes):
    settings = {"residual": True, "kickstart": 1.0, "actor_delay": 3, "warmup_steps": 0}
    settings |= {"guidance": 0.0, "train_ratio": 2}
    return pretrained(data, env=DotEnv(), **settings | changes).learn(LENGTH)


def test_the_mean_is_the_clones_plus_what_the_actor_has_learned():
    mask = torch.tensor([True, True, False])

    def normal(mean, std):
        return TruncatedNormal(torch.tensor([mean]), torch.tensor([std]), mask)

    policy = SimpleNamespace(
        prior_actor=SimpleNamespace(act=lambda frames, _: torch.tensor([[0.5, 0.9, 0.0]])),
        acting_imitator=SimpleNamespace(dist=lambda *_: normal([0.25, 0.5, 0.0], [1.0] * 3)),
        action_mask=mask,
    )
    actor = normal([0.5, 1.0, 0.0], [0.25, 0.5, 0.1])
    state = Latent(torch.zeros(1, 4), torch.zeros(1, 2, 2))
    dist = corrected(policy, actor, state, torch.zeros(1))
    assert dist.mean.tolist() == [[0.75, 1.0, 0.0]]  # 0.5 + (0.5 - 0.25); 0.9 + 0.5 is clipped
    assert torch.equal(dist.std, actor.std)


def test_without_imagination_the_clone_acts(data):
    policy = learned(data).policy
    policy.actor.load_state_dict(policy.imitator.state_dict())
    state = frames = None
    for image in noise(3, 2):
        action, state = policy.act(image, state, None, deterministic=True)
        frames = stack_frames(image, frames, None)
        np.testing.assert_allclose(action, prior_action(policy, frames), atol=1e-6)
        np.testing.assert_array_equal(state[-1], action)


def test_the_imitator_is_the_actor_at_the_end_of_the_head_start(data):
    model = learned(data, train_ratio=1e-9)  # the head start's updates alone
    assert model.progress.updates == 3 and model.policy.imitator is None
    model.begin_residual()
    both = zip(model.policy.actor.parameters(), model.policy.imitator.parameters(), strict=True)
    assert all(torch.equal(actor, imitator) for actor, imitator in both)


def test_the_imitator_learns_beside_the_others_and_changes_none_of_them(data, tmp_path):
    # `imitation_grad` is of the actor's imitation, which ends with the head start
    model = learned(data, train_ratio=1e-9, kickstart=0.0, imitation_grad=100.0)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    after = []
    for residual in (False, True):
        one = WPT.load(tmp_path / "model", env=DotEnv(), dataset=data, residual=residual)
        one.load_replay_buffer(tmp_path / "replay")
        one.retrieve()
        one.update(defaultdict(list))
        after.append(weights(one))
    plain, corrected = after
    imitator = {k: w for k, w in corrected.items() if k.startswith("imitator.")}
    assert imitator and same(plain, {k: w for k, w in corrected.items() if k not in imitator})
    before = weights(model, "actor.")
    assert not any(torch.equal(imitator[f"imitator.{k[6:]}"], w) for k, w in before.items())


@pytest.mark.parametrize("kickstart", [5.0, "linear(5,1,100)"])
def test_without_imagination_the_imitator_stays_equal_to_the_actor(data, kickstart):
    model = learned(data, train_ratio=1e-9, kickstart=kickstart)
    model.learner.actor_loss = lambda dream, *_: 0 * dream.entropy.sum()
    before = weights(model, "actor.")
    for _ in range(3):
        model.update(defaultdict(list))
    actor, imitator = weights(model, "actor."), weights(model, "imitator.")
    assert not same(before, actor)
    assert same(actor, {name.replace("imitator.", "actor."): w for name, w in imitator.items()})


def test_the_size_of_the_correction_is_logged(data):
    model = learned(data, train_ratio=1e-9, kickstart=5.0)
    metrics = defaultdict(list)
    model.update(metrics)
    model.update(metrics)
    first, second = metrics["train/correction"]
    assert first == 0 < second  # before the first update the imitator is a copy of the actor
    assert metrics["train/imitator_loss"][0] == metrics["train/kickstart_loss"][-2] > 0
    policy = model.policy
    imitator = policy.imitator
    with torch.no_grad():
        list(imitator.parameters())[-1][0] += 0.5
        post = policy.world_model.rssm.initial(4)
        post = Latent(*(part[None] for part in post))
        added = [a.dist(post.feat[0], policy.action_mask).mean for a in (policy.actor, imitator)]
    expected = np.sqrt(np.mean(np.square((added[0] - added[1])[:, :2].numpy())))
    assert model.learner.correction(imitator, post).item() == pytest.approx(expected) and expected


@pytest.mark.parametrize("later", [False, True])
def test_without_imagination_the_clone_acts_also_with_averages(data, later, tmp_path):
    settings = {"actor_average": 0.25, "residual": not later}
    model = learned(data, train_ratio=1e-9, kickstart=5.0, **settings)
    model.learner.actor_loss = lambda dream, *_: 0 * dream.entropy.sum()
    for switch in (not later, True):
        model.residual = switch
        for _ in range(2):
            model.update(defaultdict(list))
    model.save(tmp_path / "model")
    loaded = WPT.load(tmp_path / "model")
    image = noise(1)
    prior = prior_action(model.policy, stack_frames(image, None, None))
    for policy in (model.policy, loaded.policy):
        assert policy.acting_actor is not policy.actor and policy.imitator is not None
        action, _ = policy.act(image, None, None, deterministic=True)
        np.testing.assert_allclose(action, prior, atol=1e-6)


def test_the_imitator_has_the_rate_of_the_actor_from_its_first_update_on(data):
    model = learned(data, train_ratio=1e-9, actor_critic_decay=True)
    model.num_timesteps = 4 * LENGTH // 5
    model.update(defaultdict(list))
    learner, rate = model.learner, model.hyperparameters.value("actor_critic_learning_rate")
    rates = [o.param_groups[0]["lr"] for o in (learner.actor_optimizer, learner.imitator_optimizer)]
    assert rates == pytest.approx([rate / 5, rate / 5])


def test_an_imitator_that_is_not_used_learns_nothing(data):
    model = learned(data)
    for name, value in {"residual": False, "kickstart": 0.0, "actor_delay": 0}.items():
        setattr(model, name, value)
    model.batch_length = 2  # too short for the clone, which sees three images
    before = weights(model, "imitator.")
    model.update(defaultdict(list))
    assert before and same(before, weights(model, "imitator."))


def test_without_a_clone_the_actor_acts(data):
    model = agent(DotEnv(), residual=True, offline_ratio=0, guidance=0)
    assert not model.policy.residual and model.hyperparameters.needs_clone
    model = learned(data)
    assert model.policy.residual and model.policy.imitator is not None
    model.reset_task()
    assert not model.policy.residual and model.policy.imitator is None


def test_an_interrupted_run_goes_on_exactly(data, tmp_path):
    loaded = assert_goes_on_exactly(learned(data), data, tmp_path)
    assert loaded.policy.residual
