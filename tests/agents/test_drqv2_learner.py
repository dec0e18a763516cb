"""DrQ-v2's update equals a plain second implementation, and each loss moves its own networks."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from plain import Adam, assert_close, batch_of, encode, parameters, trunk, two_layers

from wpt_agents.agents.drqv2 import DrQv2Keywords, DrQv2Learner, DrQv2Policy

IMAGES = spaces.Box(0, 255, (64, 64, 3), np.uint8)
STRIDES, RATE, TAU, CLIP, STD = (2, 1, 1, 1), 1e-3, 0.1, 0.3, 0.4


def policy_of(actions=2, seed=0):
    torch.manual_seed(seed)
    space = spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return DrQv2Policy(IMAGES, space, channels=3, feature_dim=5, hidden_dim=7)


def learner_of(policy, **changes):
    keywords = DrQv2Keywords(learning_rate=RATE, tau=TAU, std_clip=CLIP, **changes)
    return DrQv2Learner(policy, keywords)


def copies(module):
    return {k: v.detach().clone() for k, v in module.named_parameters()}


def changed(module, before):
    return {k for k, v in module.named_parameters() if not torch.equal(v, before[k])}


class Reference:
    """One update of DrQ-v2, written out."""

    def __init__(self, policy, pre_activation=0.0):
        self.pre_activation = pre_activation
        self.f, self.q, self.mu = (
            parameters(m) for m in (policy.encoder, policy.critic, policy.actor)
        )
        self.target = {k: v.detach().clone() for k, v in self.q.items()}
        self.critic_adam, self.actor_adam = Adam(RATE, self.f, self.q), Adam(RATE, self.mu)

    def action(self, h, generator):
        mean = two_layers(self.mu, "layers", trunk(self.mu, h)).tanh()
        noise = (STD * torch.randn(mean.shape, generator=generator)).clamp(-CLIP, CLIP)
        noisy = mean + noise
        inside = noisy.detach().clamp(-1 + 1e-6, 1 - 1e-6)
        return mean + (inside - mean.detach())  # the gradient of the mean

    def both(self, w, h, action):
        x = torch.cat([trunk(w, h), action], 1)
        return two_layers(w, "q1", x)[:, 0], two_layers(w, "q2", x)[:, 0]

    def update(self, batch, generator):
        image, other = batch.image.float(), batch.next_image.float()
        h, then = (encode(self.f, x, STRIDES, 0.5) for x in (image, other))
        with torch.no_grad():
            q = torch.minimum(*self.both(self.target, then, self.action(then, generator)))
            y = batch.reward + batch.discount * q
        q1, q2 = self.both(self.q, h, batch.action)
        self.critic_adam.descend(((q1 - y) ** 2).mean() + ((q2 - y) ** 2).mean())
        h = h.detach()
        u = two_layers(self.mu, "layers", trunk(self.mu, h))
        q = torch.minimum(*self.both(self.q, h, self.action(h, generator)))
        self.actor_adam.descend(-q.mean() + self.pre_activation * (u**2).mean())
        for k, w in self.target.items():
            w.copy_((1 - TAU) * w + TAU * self.q[k].detach())


@pytest.mark.parametrize("pre_activation", [0.0, 0.5])
def test_three_updates_equal_a_plain_second_implementation(pre_activation):
    policy = policy_of()
    learner = learner_of(policy, pre_activation=pre_activation)
    reference = Reference(policy, pre_activation)
    before = copies(policy.encoder)
    ours, theirs = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
    for seed in range(3):
        batch = batch_of(8, 2, seed)
        learner.update(batch, STD, ours)
        reference.update(batch, theirs)
    assert changed(policy.encoder, before) == set(before)
    for module, expected in (
        (policy.encoder, reference.f),
        (policy.critic, reference.q),
        (policy.actor, reference.mu),
        (policy.target_critic, reference.target),
    ):
        assert_close(module, expected)


def test_the_critics_loss_moves_encoder_and_critic_and_the_actors_loss_the_actor_alone():
    policy = policy_of()
    learner = learner_of(policy)
    modules = {n: getattr(policy, n) for n in ("encoder", "critic", "actor")}
    seen = {}
    for name, optimizer in (("Q", learner.critic_optimizer), ("π", learner.actor_optimizer)):
        step = optimizer.step

        def recorded(step=step, name=name):
            before = {n: copies(m) for n, m in modules.items()}
            step()
            seen[name] = {n for n, m in modules.items() if changed(m, before[n])}

        optimizer.step = recorded
    learner.update(batch_of(8, 2), STD)
    assert seen == {"Q": {"encoder", "critic"}, "π": {"actor"}}


def test_the_target_critic_moves_by_tau_and_has_no_encoder():
    policy = policy_of()
    before = copies(policy.target_critic)
    learner_of(policy).update(batch_of(8, 2), STD)
    for k, w in policy.target_critic.named_parameters():
        expected = before[k] + TAU * (dict(policy.critic.named_parameters())[k] - before[k])
        torch.testing.assert_close(w, expected.detach())
    assert not [k for k in policy.state_dict() if k.startswith("target_encoder")]


def test_a_loss_that_is_not_finite_is_refused_and_leaves_the_weights():
    policy = policy_of()
    before, batch = copies(policy), batch_of(8, 2)
    batch.reward[0] = torch.nan
    try:
        learner_of(policy).update(batch, STD)
    except FloatingPointError as error:
        assert "critic loss" in str(error)
    else:
        raise AssertionError("a NaN was learnt from")
    assert not changed(policy, before)


def test_another_action_width_draws_networks_of_that_width():
    policy = policy_of(2)
    policy.set_action_space(spaces.Box(-1.0, 1.0, (4,), np.float32))
    image = np.zeros((2, 64, 64, 3), np.uint8)
    action, state = policy.act(image, None, None)
    assert action.shape == (2, 4) and state[0].shape == (2, 3, 64, 64, 3)
