"""Losses of DreamerV3 (https://arxiv.org/abs/2301.04104) that the paper does not use.

Each is behind a keyword of WPT that is off by default: `actor_grad="reinforce"`, `repval_scale`,
`slow_critic_scale` (the critic's loss once more, with the target critic's values as targets), and
the continue head, which is used once an episode of the task has terminated.

Here, rewards belong to the state in which a step arrives: V_t contains r_t, which the action at
step t did not cause. The return of that action is therefore γ V_{t+1}, and its baseline v_t - r_t.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from wpt_agents.model.distributions import BIN_RANGE, two_hot_loss


def advantage(
    reward: Tensor, value: Tensor, lambda_return: Tensor, discount: Tensor | float
) -> Tensor:
    """A_t = r_t + γ V_{t+1} - v_t: how much better an action was than the critic expects.

    :param reward: (N, H), on arriving at the imagined steps 0 .. H-1
    :param value: (N, H + 1), the critic's means at the steps 0 .. H
    :param lambda_return: (N, H), V of Eq. (2)
    :param discount: γ, or (N, H) γ times the probability that the episode goes on after step t
    :return: (N, H - 1), of the actions at the steps 0 .. H-2, without gradient
    """
    if isinstance(discount, Tensor):
        discount = discount[:, :-1]
    later = discount * lambda_return[:, 1:]
    return (reward[:, :-1] + later - value[:, :-2]).detach()


def reinforce_loss(
    log_prob: Tensor,
    advantage: Tensor,
    entropy: Tensor,
    weight: Tensor,
    ent_coef: float = 3e-4,  # DreamerV3's η, the same for all domains
    return_scale: Tensor | float = 1.0,
) -> Tensor:
    """DreamerV3's Eq. (11): -A_t / S ln π(a_t | s_t) - η H[a_t | s_t], step t weighing γ^t.

    :param log_prob: (N, H - 1), of the actions that were taken, which are constants
    :param advantage: (N, H - 1)
    :param entropy: (N, H - 1), of the actor
    :param weight: (H - 1,) or (N, H - 1), γ^t, or γ^t Π_{k<t} c_k where episodes may end
    :param ent_coef: η, the weight of the entropy, which is in nats
    :param return_scale: S, by which returns are divided
    :return: scalar
    """
    assert log_prob.shape == advantage.shape == entropy.shape, (log_prob.shape, entropy.shape)
    objective = log_prob * (advantage / return_scale) + ent_coef * entropy
    return -(weight * objective).mean()


def replay_return(
    reward: Tensor,
    value: Tensor,
    is_last: Tensor,
    is_terminal: Tensor,
    gamma: float = 0.99,
    lam: float = 0.95,
) -> Tensor:
    """λ-returns of replayed steps: V_t = r_t + γ [(1 - λ) v_{t+1} + λ V_{t+1}].

    :param reward: (B, T), on arriving in each replayed state
    :param value: (B, T), the critic's mean in each replayed state
    :param is_last: (B, T) bool, whether the next state belongs to another episode
    :param is_terminal: (B, T) bool, whether the state is terminal
    :return: (B, T); at the last step of a sequence or an episode it is the critic's value
    """
    assert reward.shape == value.shape == is_last.shape == is_terminal.shape, reward.shape
    value = torch.where(is_terminal, reward, value)  # nothing follows a terminal state
    returns = [value[:, -1]]
    for t in reversed(range(reward.shape[1] - 1)):
        after = (1 - lam) * value[:, t + 1] + lam * returns[-1]
        ends = is_last[:, t] | is_terminal[:, t]
        returns.append(torch.where(ends, value[:, t], reward[:, t] + gamma * after))
    return torch.stack(returns[::-1], 1)


def replay_value_loss(
    logits: Tensor, replay_return: Tensor, known: Tensor, bin_range: float = BIN_RANGE
) -> Tensor:
    """DreamerV3's replay value loss: -ln v(V_t | s_t) where the rewards are known.

    It trains the critic on returns that were earned, since imagined returns may be too high.

    :param logits: (B, T, bins), the critic's outputs on detached replayed states
    :param replay_return: (B, T); no gradient reaches it
    :param known: (B, T) bool, where the rewards are known
    :param bin_range: largest bin, in symlog space
    :return: scalar
    """
    loss = two_hot_loss(logits, replay_return.detach(), bin_range)
    return (loss * known).sum() / known.sum().clamp_min(1)


def continue_loss(logits: Tensor, is_terminal: Tensor, known: Tensor) -> Tensor:
    """Return -ln p(c_t | s_t) of a Bernoulli: whether the episode continues after a state.

    :param logits: (B, T), the log-odds of continuing, on detached features
    :param is_terminal: (B, T) bool, whether the state is terminal
    :param known: (B, T) bool, True at steps of the task, since other tasks may end elsewhere
    :return: scalar
    """
    goes_on = (~is_terminal).float()
    loss = F.binary_cross_entropy_with_logits(logits.float(), goes_on, reduction="none")
    return (loss * known).sum() / known.sum().clamp_min(1)
