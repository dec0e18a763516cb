"""RLPD's update equals a plain second implementation, with and without the reward ensemble."""

import math

import numpy as np
import pytest
import torch
from gymnasium import spaces
from plain import Adam, assert_close, batch_of, encode, parameters, trunk, two_layers

from wpt_agents.agents.optimistic import optimistic_reward
from wpt_agents.agents.rlpd import RLPDKeywords, RLPDLearner, RLPDPolicy
from wpt_agents.data.transitions import Transitions
from wpt_agents.training.model_files import optimizers

IMAGES = spaces.Box(0, 255, (64, 64, 3), np.uint8)
STRIDES, RATE, TAU, BETA = (2, 2, 2, 2), 1e-3, 0.1, 0.7
CRITICS, HEADS, ONLINE = 3, 4, 5


def policy_of(heads=0, actions=2):
    torch.manual_seed(0)
    space = spaces.Box(-1.0, 1.0, (actions,), np.float32)
    widths = {"channels": 2, "feature_dim": 5, "hidden_dim": 7}
    return RLPDPolicy(IMAGES, space, critics=CRITICS, reward_members=heads, **widths)


def learner_of(policy):
    return RLPDLearner(policy, RLPDKeywords(learning_rate=RATE, tau=TAU, beta=BETA))


def copies(module):
    return {k: v.detach().clone() for k, v in module.named_parameters()}


def changed(module, before):
    return {k for k, v in module.named_parameters() if not torch.equal(v, before[k])}


def member(w, k, x, normed):
    """Member k of an ensemble of two hidden layers, with or without layer norm."""
    step = 3 if normed else 2
    for i in (0, step):
        x = x @ w[f"layers.{i}.weight"][k] + w[f"layers.{i}.bias"][k]
        if normed:
            mean, var = x.mean(1, keepdim=True), x.var(1, correction=0, keepdim=True)
            x = (x - mean) / (var + 1e-5).sqrt()
            x = x * w[f"layers.{i + 1}.weight"][k] + w[f"layers.{i + 1}.bias"][k]
        x = x.clamp_min(0)
    last = 2 * step
    return (x @ w[f"layers.{last}.weight"][k] + w[f"layers.{last}.bias"][k])[:, 0]


class Reference:
    """One update of RLPD from pixels, written out."""

    def __init__(self, policy):
        self.f, self.q, self.pi = (
            parameters(m) for m in (policy.encoder, policy.critic, policy.actor)
        )
        self.alpha = {"log": torch.tensor(math.log(0.1), requires_grad=True)}
        self.f_bar, self.q_bar = (
            {k: v.detach().clone() for k, v in w.items()} for w in (self.f, self.q)
        )
        self.adams = Adam(RATE, self.f, self.q), Adam(RATE, self.pi), Adam(RATE, self.alpha)
        self.heads = parameters(policy.reward_ensemble) if policy.widths.reward_members else None
        self.reward_adam = Adam(RATE, self.heads) if self.heads else None

    def act(self, h, generator):
        out = two_layers(self.pi, "layers", trunk(self.pi, h))
        mean, log_std = out[:, :2], out[:, 2:].clamp(-20, 2)
        u = mean + log_std.exp() * torch.randn(mean.shape, generator=generator)
        normal = torch.distributions.Normal(mean, log_std.exp()).log_prob(u)
        return u.tanh(), (normal - torch.log(1 - u.tanh() ** 2)).sum(1)

    def critic(self, w, k, h, action):
        return member(w, k, torch.cat([trunk(w, h), action], 1), True)

    def labelled(self, reward, z, generator):
        if self.heads is None:
            return reward
        r = torch.stack([member(self.heads, k, z[:ONLINE], False) for k in range(HEADS)])
        shown = (torch.rand(r.shape, generator=generator) < 0.8).float()
        self.reward_adam.descend((shown * (r - reward[:ONLINE]) ** 2).sum() / shown.sum())
        with torch.no_grad():
            r = torch.stack([member(self.heads, k, z[ONLINE:], False) for k in range(HEADS)])
            mean = sum(r) / HEADS
            std = (sum((x - mean) ** 2 for x in r) / HEADS).sqrt()
        return torch.cat([reward[:ONLINE], mean + BETA * std])

    def update(self, batch, generator):
        image, other = batch.image.float(), batch.next_image.float()
        h = encode(self.f, image, STRIDES, 0)
        with torch.no_grad():
            then = encode(self.f, other, STRIDES, 0)
            action, _ = self.act(then, generator)
            j = int(torch.randint(CRITICS, (), generator=generator))
            q = self.critic(self.q_bar, j, encode(self.f_bar, other, STRIDES, 0), action)
            z = trunk(self.q, then)
        y = self.labelled(batch.reward, z, generator) + batch.discount * q
        errors = [(self.critic(self.q, k, h, batch.action) - y) ** 2 for k in range(CRITICS)]
        self.adams[0].descend(sum(e.mean() for e in errors) / CRITICS)
        alpha, h = self.alpha["log"].exp().item(), h.detach()
        action, log_prob = self.act(h, generator)
        q = sum(self.critic(self.q, k, h, action) for k in range(CRITICS)) / CRITICS
        self.adams[1].descend((alpha * log_prob - q).mean())
        entropy = -log_prob.detach().mean()
        self.adams[2].descend(self.alpha["log"].exp() * (entropy + 0.5 * 2))
        for bar, w in ((self.f_bar, self.f), (self.q_bar, self.q)):
            for k in bar:
                bar[k] = (1 - TAU) * bar[k] + TAU * w[k].detach()


@pytest.mark.parametrize("heads", [0, HEADS])
def test_three_updates_equal_a_plain_second_implementation(heads):
    policy = policy_of(heads)
    learner, reference = learner_of(policy), Reference(policy)
    ours, theirs = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
    for seed in range(3):
        batch = batch_of(8, 2, seed)
        learner.update(batch, ONLINE, ours)
        reference.update(batch, theirs)
    for module, expected in (
        (policy.encoder, reference.f),
        (policy.critic, reference.q),
        (policy.actor, reference.pi),
        (policy.target_encoder, reference.f_bar),
        (policy.target_critic, reference.q_bar),
    ):
        assert_close(module, expected, 1e-5)
    torch.testing.assert_close(policy.log_alpha, reference.alpha["log"])
    if heads:
        assert_close(policy.reward_ensemble, reference.heads, 1e-5)


def test_each_loss_moves_its_own_networks():
    policy = policy_of(HEADS)
    learner, seen = learner_of(policy), {}
    names = "encoder", "critic", "actor", "reward_ensemble"
    for name, optimizer in optimizers(learner).items():
        step = optimizer.step

        def recorded(step=step, name=name):
            before, alpha = {n: copies(getattr(policy, n)) for n in names}, policy.log_alpha.item()
            step()
            seen[name] = {n for n in names if changed(getattr(policy, n), before[n])}
            if policy.log_alpha.item() != alpha:
                seen[name].add("alpha")

        optimizer.step = recorded
    learner.update(batch_of(8, 2), ONLINE)
    assert seen == {
        "critic_optimizer": {"encoder", "critic"},
        "actor_optimizer": {"actor"},
        "temperature_optimizer": {"alpha"},
        "reward_optimizer": {"reward_ensemble"},
    }


def test_the_target_encoder_moves_by_tau():
    policy = policy_of()
    before = copies(policy.target_encoder)
    learner_of(policy).update(batch_of(8, 2), ONLINE)
    now = dict(policy.encoder.named_parameters())
    for k, w in policy.target_encoder.named_parameters():
        torch.testing.assert_close(w, (before[k] + TAU * (now[k] - before[k])).detach())


def test_the_reward_ensemble_never_reads_the_offline_rows_rewards():
    results = []
    for poison in (0.0, 1e6):
        policy, batch = policy_of(HEADS), batch_of(8, 2)
        batch.reward[ONLINE:] = poison
        learner_of(policy).update(batch, ONLINE, torch.Generator().manual_seed(0))
        results.append(copies(policy))
    assert all(torch.equal(results[0][k], results[1][k]) for k in results[0])


def squares(columns):
    """Stacks of frames (n, 3, 64, 64, 3) with a bright square at each of the columns."""
    image = np.zeros((len(columns), 3, 64, 64, 3), np.uint8)
    for row, column in enumerate(columns):
        image[row, :, 24:40, column : column + 16] = 250
    return torch.from_numpy(image)


def test_the_bonus_falls_on_repeated_images_and_is_larger_on_unseen_ones():
    torch.manual_seed(0)
    box = spaces.Box(-1.0, 1.0, (2,), np.float32)
    widths = {"channels": 4, "feature_dim": 16, "hidden_dim": 32, "critics": 2}
    policy = RLPDPolicy(IMAGES, box, reward_members=5, **widths)
    learner = RLPDLearner(policy, RLPDKeywords(learning_rate=RATE, beta=1.0))
    seen, unseen = squares(range(0, 16, 2)), squares(range(32, 48, 2))
    n, reward = len(seen), torch.linspace(0, 1, len(seen))
    image = torch.cat([seen, seen])  # the second half stands for offline data, of the same images
    poison = torch.full((n,), 1e6)
    batch = Transitions(
        image, torch.zeros(2 * n, 2), torch.cat([reward, poison]), torch.full((2 * n,), 0.9), image
    )
    metrics = [learner.update(batch, n) for _ in range(150)]
    first, last = metrics[0], metrics[-1]
    assert last["explore/bonus"] < 0.5 * first["explore/bonus"]
    assert last["explore/bonus_share"] < first["explore/bonus_share"]
    with torch.no_grad():
        latent = policy.critic.trunk(policy.encoder(unseen))
        _, surprise = optimistic_reward(policy.reward_ensemble(latent), 1.0)
    assert surprise.mean() > 2 * last["explore/bonus"]
