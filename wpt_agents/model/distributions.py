"""The three distributions: one-hot latents, two-hot returns, truncated-normal actions."""

import math
from collections.abc import Iterable

import torch
from torch import Generator, Tensor

BINS = 255  # of the two-hot heads
BIN_RANGE = 20.0  # the bins are evenly spaced over [-20, 20] in symlog space, as in DreamerV3
SQRT2 = math.sqrt(2.0)


class Share(Generator):
    """A generator for a part of a batch: each row gets the numbers of its place in the whole batch.

    :param rows: number of rows of the whole batch
    :param first: the number, in the whole batch, of the first row here
    """

    def __new__(cls, device: torch.device | str, rows: int, first: int) -> "Share":
        """Pass the device on: torch's generators take it here and not in `__init__`."""
        return super().__new__(cls, device)  # type: ignore[call-arg]  # torch's stub has no __new__

    def __init__(self, device: torch.device | str, rows: int, first: int) -> None:
        self.rows = rows
        self.first = first


class Drawn:
    """Random numbers drawn before, in the order of their use: compiled code has no generators."""

    def __init__(self, draws: Iterable[Tensor]) -> None:
        self.left = list(draws)

    def next(self) -> Tensor:
        """Return the next numbers."""
        return self.left.pop(0)


Noise = Generator | Drawn | None
"""The source of random numbers; None is torch's own generator."""


def uniform(like: Tensor, generator: Noise = None) -> Tensor:
    """Draw uniformly from [0, 1) in the shape of `like`."""
    if isinstance(generator, Drawn):
        return generator.next()
    return torch.rand(like.shape, device=like.device, generator=generator)


def exponential(like: Tensor, generator: Noise = None) -> Tensor:
    """Draw from Exp(1) in the shape of `like`, (N, ...)."""
    if isinstance(generator, Drawn):
        return generator.next()
    if not isinstance(generator, Share):
        return torch.empty_like(like).exponential_(generator=generator)
    # Draw for all rows and keep a share: a row's numbers must not depend on who computes it.
    whole = like.new_empty(generator.rows, *like.shape[1:]).exponential_(generator=generator)
    return whole[generator.first : generator.first + len(like)]


def symlog(x: Tensor) -> Tensor:
    """`sign(x) ln(|x| + 1)`: compresses rewards and returns of any scale."""
    return torch.sign(x) * torch.log1p(x.abs())


def symexp(x: Tensor) -> Tensor:
    """`sign(x) (e^|x| - 1)`, the inverse of symlog."""
    return torch.where(x < 0, -torch.expm1(-x), torch.expm1(x))  # unlike with sign, of slope 1 at 0


def two_hot(x: Tensor, bins: int = BINS, bin_range: float = BIN_RANGE) -> Tensor:
    """Express symlog(x) as weights on the two nearest bins.

    :param x: (...), any real number; it is clipped at symexp(bin_range)
    :param bin_range: the bins are evenly spaced over [-bin_range, bin_range]
    :return: (..., bins), of which at most two are not zero and the sum is 1
    """
    position = (symlog(x).clamp(-bin_range, bin_range) + bin_range) * (bins - 1) / (2 * bin_range)
    below = position.floor().clamp(max=bins - 2)
    upper = (position - below).unsqueeze(-1)
    # NaN becomes a loss that is NaN; an index out of range would end a process with a GPU
    index = below.long().clamp_(0, bins - 2).unsqueeze(-1)
    weights = torch.zeros(*x.shape, bins, device=x.device, dtype=position.dtype)
    return weights.scatter_(-1, index, 1 - upper).scatter_(-1, index + 1, upper)


def two_hot_mean(logits: Tensor, bin_range: float = BIN_RANGE) -> Tensor:
    """Return symexp of the mean bin: (..., bins) logits -> (...)."""
    logits = logits.float()
    bins = torch.linspace(-bin_range, bin_range, logits.shape[-1], device=logits.device)
    # As in DreamerV3's first version; the later one averages symexp-spaced bins instead.
    return symexp((logits.softmax(-1) * bins).sum(-1))  # a matmul would fall to bfloat16


def two_hot_loss(logits: Tensor, target: Tensor, bin_range: float = BIN_RANGE) -> Tensor:
    """Return -ln p(target), the cross entropy with the two-hot target.

    :param logits: (..., bins)
    :param target: (...), before symlog
    :return: (...)
    """
    logits = logits.float()
    return -(two_hot(target, logits.shape[-1], bin_range) * logits.log_softmax(-1)).sum(-1)


def unimix_logits(logits: Tensor, unimix: float = 0.01) -> Tensor:
    """Log-probabilities of (1 - unimix) softmax + unimix / K: no class has probability zero.

    :param logits: (..., K)
    :param unimix: share of the uniform distribution
    :return: (..., K)
    """
    probs = logits.float().softmax(-1)
    return torch.log((1 - unimix) * probs + unimix / logits.shape[-1])


def sample_one_hot(logits: Tensor, generator: Noise = None) -> Tensor:
    """Draw a one-hot sample whose gradient is that of the probabilities (straight-through).

    :param logits: (..., K) log-probabilities
    :return: (..., K)
    """
    probs = logits.exp()
    # with E_k ~ Exp(1), the largest p_k / E_k is that of class k with probability p_k
    race = exponential(probs, generator)
    return _straight_through(probs, (probs.detach() / race).argmax(-1))


def mode_one_hot(logits: Tensor) -> Tensor:
    """Return the most likely class, one-hot and straight-through: (..., K) -> (..., K)."""
    return _straight_through(logits.exp(), logits.argmax(-1))


def _straight_through(probs: Tensor, index: Tensor) -> Tensor:
    one_hot = torch.zeros_like(probs).scatter_(-1, index.unsqueeze(-1), 1.0)
    return one_hot + (probs - probs.detach())


def kl_one_hot(left: Tensor, right: Tensor) -> Tensor:
    """Return KL(left || right) in nats, summed over the groups.

    :param left: (..., S, K) log-probabilities
    :param right: (..., S, K) log-probabilities
    :return: (...)
    """
    return (left.exp() * (left - right)).sum((-1, -2))


class TruncatedNormal:
    """Independent normal distributions truncated to [-1, 1], without the padded entries.

    The authors clamp samples of a normal distribution instead, and do not mask padded samples.

    :param mean: (..., A), in [-1, 1]
    :param std: (..., A), positive
    :param mask: (..., A) bool, broadcast; where False a sample is 0 and nothing is counted
    """

    def __init__(self, mean: Tensor, std: Tensor, mask: Tensor) -> None:
        # The tails of a cumulative distribution need more digits than bfloat16 has.
        self.mean = mean.float()
        self.std = std.float()
        self.mask = mask
        self.low = (-1 - self.mean) / self.std
        self.high = (1 - self.mean) / self.std
        self.low_cdf = _cdf(self.low)
        self.mass = (_cdf(self.high) - self.low_cdf).clamp_min(1e-6)  # its logarithm is taken

    @property
    def mode(self) -> Tensor:
        """The mean of the normal before truncation, which lies in [-1, 1]: (..., A)."""
        return self.mean * self.mask

    def rsample(self, generator: Noise = None) -> Tensor:
        """Draw by the inverse of the cumulative distribution, with a gradient: (..., A)."""
        cdf = self.low_cdf + uniform(self.mean, generator) * self.mass
        # clamped because erfinv is infinite at -1 and 1
        z = SQRT2 * torch.erfinv((2 * cdf - 1).clamp(-1 + 1e-6, 1 - 1e-6))
        return (self.mean + self.std * z).clamp(-1, 1) * self.mask

    def log_prob(self, action: Tensor) -> Tensor:
        """Return ln p(action), summed over the entries that are not padded: (..., A) -> (...)."""
        z = (action - self.mean) / self.std
        log_prob = -0.5 * z * z - self.std.log() - 0.5 * math.log(2 * math.pi) - self.mass.log()
        return (log_prob * self.mask).sum(-1)

    def entropy(self) -> Tensor:
        """Return the exact entropy in nats, summed over the entries that are not padded: (...).

        With α and β the standardised bounds and Z the mass between them, it is
        ln(sqrt(2πe) s Z) + (α φ(α) - β φ(β)) / (2 Z).
        """
        # The authors estimate the entropy from one sample of the normal before clamping.
        tails = (self.low * _pdf(self.low) - self.high * _pdf(self.high)) / (2 * self.mass)
        constant = 0.5 * math.log(2 * math.pi * math.e)
        return ((constant + self.std.log() + self.mass.log() + tails) * self.mask).sum(-1)


def _cdf(z: Tensor) -> Tensor:
    return 0.5 * (1 + torch.erf(z / SQRT2))


def _pdf(z: Tensor) -> Tensor:
    return torch.exp(-0.5 * z * z) / math.sqrt(2 * math.pi)
