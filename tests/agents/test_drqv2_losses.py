"""DrQ-v2's networks and losses, by hand."""

import torch
from torch import nn

from wpt_agents.agents.drqv2 import (
    EDGE,
    Actor,
    Critic,
    actor_loss,
    critic_loss,
    noisy_action,
    td_target,
)
from wpt_agents.model.frames import FrameEncoder


def count(*networks):
    return sum(p.numel() for network in networks for p in network.parameters())


def test_the_published_network_has_5_36_million_parameters_at_64_pixels():
    encoder = FrameEncoder((32,) * 4, (2, 1, 1, 1), centre=0.5)
    networks = Actor(20_000, 50, 1024, 6), Critic(20_000, 50, 1024, 6)
    assert round(count(encoder, *networks) / 1e6, 2) == 5.36


def test_shapes_and_ranges():
    actor, critic = Actor(10, 4, 8, 3), Critic(10, 4, 8, 3)
    embed = torch.randn(5, 10)
    action = actor(embed)
    assert action.shape == (5, 3) and (action.abs() < 1).all()
    assert critic(embed, action).shape == (2, 5)


def test_td_target_by_hand():
    # min(4, 6) = 4 and 2 + 0.5 * 4 = 4;  min(9, 1) = 1 and 3 + 0 * 1 = 3
    next_q = torch.tensor([[4.0, 9.0], [6.0, 1.0]])
    target = td_target(torch.tensor([2.0, 3.0]), torch.tensor([0.5, 0.0]), next_q)
    assert target.tolist() == [4.0, 3.0]


def test_critic_loss_by_hand():
    q, target = torch.tensor([[1.0, 2.0], [3.0, 5.0]]), torch.tensor([2.0, 4.0])
    # Q_1: (1 + 4) / 2 = 2.5;  Q_2: (1 + 1) / 2 = 1
    assert critic_loss(q, target).item() == 3.5


def test_actor_loss_by_hand():
    # -(min(1, 3) + min(2, 0)) / 2 = -0.5
    assert actor_loss(torch.tensor([[1.0, 2.0], [3.0, 0.0]])).item() == -0.5


def test_no_gradient_reaches_the_target():
    q, target = torch.zeros(2, 3, requires_grad=True), torch.ones(3, requires_grad=True)
    critic_loss(q, target).backward()
    assert target.grad is None and (q.grad != 0).all()


def test_noise_is_clipped_only_where_asked():
    mean = torch.zeros(10_000, 1)
    free = noisy_action(mean, 0.25)
    assert (free.abs() > 0.3).any() and abs(free.std().item() - 0.25) < 0.01
    clipped = noisy_action(mean, 0.25, 0.3)
    assert (clipped.abs() <= 0.3).all() and (clipped.abs() == 0.3).any()


def test_the_gradient_passes_the_clamp_unchanged():
    mean = torch.full((4, 2), 0.99, requires_grad=True)
    action = noisy_action(mean, 5.0, generator=torch.Generator().manual_seed(0))
    assert (action.abs() == torch.tensor(EDGE)).any() and (action.abs() <= EDGE).all()
    action.sum().backward()
    assert (mean.grad == 1).all()


def test_both_critics_share_the_trunk_and_nothing_else():
    critic = Critic(10, 4, 8, 3)
    critic(torch.randn(5, 10), torch.zeros(5, 3))[0].sum().backward()
    assert isinstance(critic.trunk, nn.Module) and critic.trunk[0].weight.grad.abs().sum() > 0
    assert all(p.grad is None or (p.grad == 0).all() for p in critic.q2.parameters())
