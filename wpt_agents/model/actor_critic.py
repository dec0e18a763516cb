"""Learning to act in imagination (A.3): Eq. (2) lambda_return, (3) critic_loss, (4) actor_loss."""

from copy import deepcopy

import torch
from torch import Generator, Tensor, nn

from wpt_agents.model.distributions import (
    BIN_RANGE,
    BINS,
    TruncatedNormal,
    two_hot_loss,
    two_hot_mean,
)
from wpt_agents.model.layers import Head
from wpt_agents.model.sizes import Size

CONTEXT = 3  # images that a state has to have seen; more of them do not improve predictions


def lambda_return(
    reward: Tensor,
    value: Tensor,
    gamma: float = 0.99,  # Table 2, as are the other defaults of this module
    lam: float = 0.95,
    goes_on: Tensor | None = None,
) -> Tensor:
    """Eq. (2): V_t = r_t + γ [(1 - λ) v_{t+1} + λ V_{t+1}] and V_H = v_H.

    Where episodes can end, γ is multiplied by the probability c_t that they go on after step t, as
    in DreamerV3. The paper has no such tasks.

    :param reward: (B, H), predicted at the imagined steps 0 .. H-1
    :param value: (B, H + 1), the critic's means at the steps 0 .. H
    :param gamma: γ, the discount factor
    :param lam: λ, the weight of the longer returns
    :param goes_on: (B, H), c; 1 everywhere if None
    :return: (B, H), the targets of Eq. (3)
    """
    assert value.shape[1] == reward.shape[1] + 1, (value.shape, reward.shape)
    returns = [value[:, -1]]
    for t in reversed(range(reward.shape[1])):
        bootstrap = (1 - lam) * value[:, t + 1] + lam * returns[-1]
        bootstrap = bootstrap if goes_on is None else goes_on[:, t] * bootstrap
        returns.append(reward[:, t] + gamma * bootstrap)
    return torch.stack(returns[:0:-1], dim=1)


def draw_starts(
    batch_size: int, length: int, number: int, generator: Generator | None, device: torch.device
) -> Tensor:
    """Draw the states, of the B x T replayed ones, from which imagination starts.

    Algorithm 1 starts from all of them, as 0 for `number` does here. A subset is a deviation from
    the paper, in the sizes that set `Size.imagine_starts`: gradients of different states are
    similar, so a random subset teaches about as much at a fraction of the cost. Every row
    contributes the same number of states (to within one), so that the share of retrieved rows is
    kept. The states of a row's first two images are left out, because they contain little
    information; those at the beginning of a further trajectory in a row (`data.windows`) are not.

    :param batch_size: B
    :param length: T
    :param number: N, the number of states to draw without replacement, or all but those of the
        first two images if there are fewer; 0 for all
    :return: (N,) indices into the flattened states, sorted
    """
    blind = CONTEXT - 1 if length >= CONTEXT else 0
    if number == 0 or number > batch_size * (length - blind):
        first = 0 if number == 0 else blind
        index = torch.arange(batch_size * length, device=device).view(batch_size, length)
        return index[:, first:].flatten()
    order = torch.rand(batch_size, length, device=device, generator=generator)
    order[:, :blind] = 2.0  # behind all others
    # row b draws ends[b + 1] - ends[b] states: rows differ by one at most
    ends = torch.arange(batch_size + 1, device=device) * number // batch_size
    rank = order.argsort(1).argsort(1)  # each state's place in the random order of its row
    return (rank < ends.diff()[:, None]).flatten().nonzero().squeeze(1)


def critic_loss(
    logits: Tensor,
    lambda_return: Tensor,
    gamma: float = 0.99,
    goes_on: Tensor | None = None,
    bin_range: float = BIN_RANGE,
) -> Tensor:
    """Eq. (3): -ln v(V_t | s_t), averaged, step t weighing γ^t.

    :param logits: (B, H, bins), the critic's outputs on detached states
    :param lambda_return: (B, H); no gradient reaches it
    :param gamma: γ of the weights
    :param goes_on: (B, H), c of `lambda_return`: steps that an episode hardly reaches weigh less
    :param bin_range: largest bin, in symlog space
    :return: scalar
    """
    assert logits.shape[:2] == lambda_return.shape, (logits.shape, lambda_return.shape)
    weight = discounts(lambda_return.shape[1], gamma, like=lambda_return)
    weight = weight if goes_on is None else weight * survival(goes_on)
    return (weight * two_hot_loss(logits, lambda_return.detach(), bin_range)).mean()


def actor_loss(
    lambda_return: Tensor,
    entropy: Tensor,
    ent_coef: float = 1e-4,
    gamma: float = 0.99,
    return_scale: Tensor | float = 1.0,
    goes_on: Tensor | None = None,
) -> Tensor:
    """Eq. (4): -V_t - η H[a_t | s_t], averaged, step t weighing γ^t.

    V_0 contains the reward of the starting state, which no imagined action caused. So the loss
    pairs the actions of the steps 0 .. H-2 with the returns of the steps 1 .. H-1.

    :param lambda_return: (B, H), with its gradient through the dynamics
    :param entropy: (B, H), of the actor at the steps 0 .. H-1
    :param ent_coef: η, the weight of the entropy, which is in nats
    :param gamma: γ of the weights
    :param return_scale: divides the returns; 1 in the paper
    :param goes_on: (B, H), c of `lambda_return`: an action weighs as much as the episode is likely
        to continue after it
    :return: scalar
    """
    assert lambda_return.shape == entropy.shape, (lambda_return.shape, entropy.shape)
    weight = actor_weight(gamma, entropy, goes_on)
    # Eq. (4) prints v_t, but the text says that the λ-return is maximised: V_t.
    # Not in place: in the authors' code the entropy leaks into the critic's target by that.
    objective = lambda_return[:, 1:] / return_scale + ent_coef * entropy[:, :-1]
    return -(weight * objective).mean()


def discounts(length: int, gamma: float, like: Tensor) -> Tensor:
    """Return the weights 1, γ, γ², ...: (length,), with the device and dtype of `like`."""
    return gamma ** torch.arange(length, device=like.device, dtype=torch.float32)


def survival(goes_on: Tensor) -> Tensor:
    """Return Π_{k<t} c_k: the probability that the episode has not ended before step t.

    :param goes_on: (B, H), c of the steps 0 .. H-1; no gradient reaches it
    :return: (B, H), 1 at step 0
    """
    products = goes_on.detach()[:, :-1].cumprod(1)
    return torch.cat([torch.ones_like(goes_on[:, :1]), products], 1)


def actor_weight(gamma: float, like: Tensor, goes_on: Tensor | None = None) -> Tensor:
    """Return the weights of the actions at the steps 0 .. H-2: γ^t Π_{k<=t} c_k.

    An action at a step that ends the episode has no consequences, so its weight contains c_t.

    :param gamma: γ
    :param like: (B, H), a tensor with the device, dtype and length H to use
    :param goes_on: (B, H), c; 1 everywhere if None
    :return: (H - 1,) or (B, H - 1)
    """
    weight = discounts(like.shape[1] - 1, gamma, like)
    return weight if goes_on is None else weight * survival(goes_on)[:, 1:]


def return_range(lambda_return: Tensor, low: float = 0.05, high: float = 0.95) -> Tensor:
    """Return the range between two quantiles of the returns, by which DreamerV3 divides them.

    :param lambda_return: (B, H); no gradient reaches it
    :param low: the lower quantile
    :param high: the upper quantile
    :return: scalar
    """
    quantiles = torch.quantile(
        lambda_return.detach().flatten(),
        torch.tensor([low, high], device=lambda_return.device),
    )
    return quantiles[1] - quantiles[0]


@torch.no_grad()
def ema_update(target: nn.Module, source: nn.Module, fraction: float = 0.02) -> None:
    """Move each weight t of `target` to t + fraction (s - t), where s is that of `source`."""
    torch._foreach_lerp_(list(target.parameters()), list(source.parameters()), fraction)


def debiased_fraction(fraction: float, n: int) -> float:
    """Return the share by which an average moves to its n-th value, f / (1 - (1 - f)^n).

    The k-th of n values then weighs (1 - f)^(n - k), divided by the sum of these weights: an
    exponential average without the value that it began with. Source: Algorithm 1 of
    https://arxiv.org/abs/1412.6980

    :param fraction: f, the share for large n
    :param n: the number of the value; the first one, with n = 1, replaces the average
    """
    return fraction / (1 - (1 - fraction) ** n)


class Actor(Head):
    """π(a | s): a truncated normal with tanh means and standard deviations from 0.1 to 1.

    :param size: the widths
    :param action_dim: the padded action width, A
    :param outscale: factor on the initial weights of the last layer
    """

    def __init__(self, size: Size, action_dim: int, outscale: float = 1.0) -> None:
        super().__init__(size, 3, 2 * action_dim)  # 3 layers: Table 2
        with torch.no_grad():
            for parameter in self.layers[-1].parameters():
                parameter.mul_(outscale)

    def dist(self, feat: Tensor, mask: Tensor) -> TruncatedNormal:
        """Return the action distribution.

        :param feat: (..., D + S*K)
        :param mask: (A,) bool, False in the padding
        """
        return self.truncated(self(feat), mask)

    @staticmethod
    def truncated(outputs: Tensor, mask: Tensor) -> TruncatedNormal:
        """Return the distribution that the network's outputs (..., 2 A) parametrise."""
        mean, std = outputs.float().chunk(2, -1)
        # These bounds are the authors', the paper does not print them.
        # The 2 makes exploration wide at first: a network that outputs 0 has a deviation of 0.89.
        return TruncatedNormal(torch.tanh(mean), 0.9 * torch.sigmoid(std + 2) + 0.1, mask)


def averaged(average: Actor | None, actor: Actor | None, fraction: float) -> Actor | None:
    """Move an average towards an actor by `fraction`, or begin it; None without either."""
    if actor is None or not fraction:
        return None
    if average is None:
        return deepcopy(actor).requires_grad_(False)
    ema_update(average, actor, fraction)
    return average


class Critic(Head):
    """v(V | s): a distribution over returns, two-hot in symlog space.

    :param size: the widths
    :param zero_init: start with the value 0 everywhere
    :param bin_range: largest bin, in symlog space
    """

    def __init__(self, size: Size, zero_init: bool = False, bin_range: float = BIN_RANGE) -> None:
        super().__init__(size, 3, BINS, zero_init)  # 3 layers: Table 2
        self.bin_range = bin_range

    def value(self, feat: Tensor) -> Tensor:
        """Return the mean return: (..., D + S*K) -> (...)."""
        return two_hot_mean(self(feat), self.bin_range)
