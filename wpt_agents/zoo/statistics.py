"""Statistics over many runs: aggregates, bootstrap intervals, profiles, comparisons.

The definitions are those of Agarwal et al., Deep RL at the Edge of the Statistical Precipice
(arXiv:2108.13264), and of their package rliable. `Scores` contain one array per stratum, which is a
task with one score per run, or a seed with one return per episode; strata may differ in length.
Every statistic also accepts arrays with leading axes, as resampling produces them.
"""

from collections.abc import Callable, Sequence
from math import comb

import numpy as np

Scores = Sequence[np.ndarray]  # (..., n) for each stratum
DRAWS = 20_000

# Student's t at 97.5 % for 1 .. 30 degrees of freedom.
T_975 = (
    *(12.70620, 4.30265, 3.18245, 2.77645, 2.57058, 2.44691, 2.36462, 2.30600, 2.26216, 2.22814),
    *(2.20099, 2.17881, 2.16037, 2.14479, 2.13145, 2.11991, 2.10982, 2.10092, 2.09302, 2.08596),
    *(2.07961, 2.07387, 2.06866, 2.06390, 2.05954, 2.05553, 2.05183, 2.04841, 2.04523, 2.04227),
)


def mean(scores: Scores) -> np.ndarray:
    """Return the mean over strata of each stratum's mean, (...)."""
    return np.mean([stratum.mean(-1) for stratum in scores], axis=0)


def median(scores: Scores) -> np.ndarray:
    """Return the median over strata of each stratum's mean, (...)."""
    return np.median([stratum.mean(-1) for stratum in scores], axis=0)


def iqm(scores: Scores) -> np.ndarray:
    """Return the interquartile mean (...) of all scores: a quarter is cut off at each end."""
    every = np.sort(np.concatenate(scores, axis=-1), axis=-1)
    cut = every.shape[-1] // 4
    return every[..., cut : every.shape[-1] - cut].mean(-1)


def optimality_gap(scores: Scores, target: float = 1.0) -> np.ndarray:
    """Return the optimality gap (...): the mean of max(0, target - score) over all scores."""
    return target - np.minimum(np.concatenate(scores, axis=-1), target).mean(-1)


def performance_profile(scores: Scores, thresholds: np.ndarray) -> np.ndarray:
    """Return the share of all scores above each threshold, (..., thresholds)."""
    every = np.concatenate(scores, axis=-1)
    return np.stack([(every > threshold).mean(-1) for threshold in thresholds], axis=-1)


def probability_of_improvement(ours: Scores, theirs: Scores) -> np.ndarray:
    """Return the probability that our run beats theirs on a task (ties: 1/2), averaged over tasks.

    :param ours: one stratum per task, in the same order as `theirs`
    """
    assert len(ours) == len(theirs), (len(ours), len(theirs))
    chances = []
    for x, y in zip(ours, theirs, strict=True):
        x, y = x[..., :, None], y[..., None, :]
        chances.append(((x > y) + 0.5 * (x == y)).mean((-2, -1)))
    return np.mean(chances, axis=0)


def resample(scores: Scores, draws: int, rng: np.random.Generator) -> list[np.ndarray]:
    """Resample within each stratum (stratified bootstrap); return (draws, n) for each one."""
    return [s[rng.integers(len(s), size=(draws, len(s)))] for s in scores]


def resamplable(scores: Scores) -> bool:
    """Return whether a bootstrap of the strata says something about the spread.

    Every stratum needs several scores, and all together need two degrees of freedom, as three seeds
    of one task or two seeds of two tasks have: that of two scores would end at these two scores.
    """
    return min(map(len, scores)) > 1 and sum(len(stratum) - 1 for stratum in scores) > 1


def bootstrap(
    statistic: Callable[..., np.ndarray], *groups: Scores, draws: int = DRAWS, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the 95 % percentile interval of `statistic(*groups)`; groups are resampled separately.

    :param groups: each a sequence of (n,) strata
    :return: lower and upper end, each of the statistic's shape
    """
    rng = np.random.default_rng(seed)
    drawn = statistic(*(resample(group, draws, rng) for group in groups))
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    return low, high


def mean_interval(values: Sequence[float]) -> tuple[float, float | None, float | None]:
    """Return the mean and its 95 % interval by Student's t, which is None below three values.

    That of two values is 13 times as wide as their difference, and says less than the two values.
    """
    middle = float(np.mean(values))
    n = len(values)
    if n < 3:
        return middle, None, None
    half = t_975(n - 1) * float(np.std(values, ddof=1)) / n**0.5
    return middle, middle - half, middle + half


def t_975(freedom: int) -> float:
    """Return Student's t at 97.5 %, accurate to 0.0001.

    Above the table it is the expansion z + (z³ + z) / 4n + (5z⁵ + 16z³ + 3z) / 96n² with z = 1.96.
    """
    if freedom <= len(T_975):
        return T_975[freedom - 1]
    return 1.959964 + 2.37227 / freedom + 2.8225 / freedom**2


def sign_test(above: int, below: int) -> float:
    """Return the two-sided p value of the sign test, without ties.

    p = 2 sum_{k >= max(above, below)} C(n, k) / 2^n with n = above + below, and at most 1.
    """
    n = above + below
    tail = sum(comb(n, k) for k in range(max(above, below), n + 1)) / 2**n
    return min(1.0, 2 * tail)
