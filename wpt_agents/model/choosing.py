"""How actor and prior actor act together: by the value of their actions, or by their sum.

The choice is that of imitation-bootstrapped RL (IBRL, https://arxiv.org/abs/2311.02198). IBRL
compares the two actions by a Q-function; here the world model imagines the next state s' of each.
Values include the reward for arriving in a state (Eq. 2), so the value of an action is γ v(s'). As
γ is the same for both actions, v(s') is compared.
"""

from typing import Protocol

import torch
from torch import Tensor

from wpt_agents.model.actor_critic import Actor, Critic
from wpt_agents.model.behavior_cloning import PriorActor
from wpt_agents.model.distributions import TruncatedNormal
from wpt_agents.model.rssm import RSSM, Latent
from wpt_agents.model.world_model import WorldModel


class Chooser(Protocol):
    """A policy with the networks that take part in the choice."""

    world_model: WorldModel
    target_critic: Critic
    prior_actor: PriorActor
    action_mask: Tensor  # (A,) bool, True at the embodiment's own entries

    @property
    def acting_imitator(self) -> Actor | None:
        """The imitator of the prior actor, if there is one yet."""


def choose_by_value(
    action: Tensor, proposal: Tensor, value: Tensor, proposed_value: Tensor
) -> Tensor:
    """Return `proposal` where its value is larger, and `action` elsewhere.

    :param action: (N, A)
    :param proposal: (N, A)
    :param value: (N,), of `action`
    :param proposed_value: (N,), of `proposal`
    :return: (N, A)
    """
    assert action.shape == proposal.shape, (action.shape, proposal.shape)
    assert value.shape == proposed_value.shape == action.shape[:1], (value.shape, action.shape)
    return torch.where((proposed_value > value)[:, None], proposal, action)


def value_of_action(rssm: RSSM, critic: Critic, state: Latent, action: Tensor) -> Tensor:
    """Return v(s') of the most likely state s' that an action leads to.

    No random number is drawn, so that acting is as reproducible as without the choice.

    :param state: (N, ...)
    :param action: (N, A)
    :return: (N,)
    """
    states, _ = rssm.imagine(state, lambda _, __: action, 1, sample=False)
    return critic.value(states.feat[:, 1])


def actor_or_prior(policy: Chooser, state: Latent, action: Tensor, frames: Tensor) -> Tensor:
    """Return the actor's action, or the prior actor's where the target critic's value is larger.

    :param state: (N, ...), where to act
    :param action: (N, A), the actor's
    :param frames: (N, F, 64, 64, 3) uint8, what the prior actor sees
    :return: (N, A)
    """
    proposal = policy.prior_actor.act(frames, policy.action_mask)
    rssm = policy.world_model.rssm
    values = (value_of_action(rssm, policy.target_critic, state, a) for a in (action, proposal))
    return choose_by_value(action, proposal, *values)


def corrected(
    policy: Chooser, dist: TruncatedNormal, state: Latent, frames: Tensor
) -> TruncatedNormal:
    """Return the actor's distribution around the prior actor's action, not its imitation of it.

    The mean is the prior actor's action plus what learning in imagination has changed: the
    difference between the actor and an imitator of the prior actor. Where actor and imitator agree,
    as before learning in imagination, the prior actor itself acts, and not its imitation from
    latent states, which lack details of the images. Source of learning corrections to a policy:
    https://arxiv.org/abs/1812.06298

    :param dist: the actor's, (N, A)
    :param state: (N, ...), where to act
    :param frames: (N, F, 64, 64, 3) uint8, what the prior actor sees
    """
    mask = policy.action_mask
    prior_action = policy.prior_actor.act(frames, mask)
    imitator = policy.acting_imitator
    imitation = dist.mean if imitator is None else imitator.dist(state.feat, mask).mean
    return TruncatedNormal((prior_action + (dist.mean - imitation)).clamp(-1, 1), dist.std, mask)
