"""rliable's definitions, by hand and against numbers that rliable itself gave."""

import numpy as np
import pytest
from scipy import stats

from wpt_agents.zoo.report.aggregates import estimate
from wpt_agents.zoo.statistics import (
    bootstrap,
    iqm,
    mean,
    mean_interval,
    median,
    optimality_gap,
    performance_profile,
    probability_of_improvement,
    resamplable,
    resample,
    sign_test,
)

TASKS = [np.array([0.0, 1.0]), np.array([0.5, 0.7]), np.array([1.2, 1.4])]


def test_aggregates_by_hand():
    # means of the tasks: 0.5, 0.6, 1.3
    assert mean(TASKS) == pytest.approx(2.4 / 3)
    assert median(TASKS) == pytest.approx(0.6)
    # sorted 0 .5 .7 1 1.2 1.4; a quarter of 6 is 1 off each end: (.5 + .7 + 1 + 1.2) / 4
    assert iqm(TASKS) == pytest.approx(0.85)
    # short of 1 by 1, .5, .3, 0, 0, 0
    assert optimality_gap(TASKS) == pytest.approx(1.8 / 6)


def test_the_iqm_of_few_scores_is_their_mean_and_ignores_outliers_among_many():
    assert iqm([np.array([1.0, 2.0, 6.0])]) == pytest.approx(3)
    assert iqm([np.array([-1e6, 2.0, 4.0, 1e6])]) == pytest.approx(3)


def test_a_profile_is_the_share_of_scores_above_each_threshold():
    shares = performance_profile(TASKS, np.array([-1, 0, 0.6, 1.2, 2]))
    assert shares == pytest.approx([1, 5 / 6, 4 / 6, 1 / 6, 0])


def test_the_probability_of_improvement_counts_ties_half():
    # task 1, (0, 1) against (0, 2): 0=0 half, 0<2, 1>0, 1<2: 1.5 / 4; task 2: .5, .7 > .1 always
    ours = TASKS[:2]
    theirs = [np.array([0.0, 2.0]), np.array([0.1])]
    assert probability_of_improvement(ours, theirs) == pytest.approx((1.5 / 4 + 1) / 2)
    assert probability_of_improvement(theirs, ours) == pytest.approx(1 - (1.5 / 4 + 1) / 2)


def test_resampling_never_mixes_strata_and_strata_may_differ_in_length():
    drawn = resample([np.array([1.0, 2.0]), np.array([5.0, 6.0, 7.0])], 100, rng())
    assert [d.shape for d in drawn] == [(100, 2), (100, 3)]
    assert set(drawn[0].ravel()) == {1, 2} and set(drawn[1].ravel()) == {5, 6, 7}


def test_an_estimate_has_no_interval_where_a_task_has_one_run():
    assert estimate(mean, TASKS)[1] is not None
    assert estimate(mean, [*TASKS, np.array([0.3])]) == (pytest.approx(2.7 / 4), None, None)


def rng():
    return np.random.default_rng(0)


def test_the_interval_is_the_central_95_percent_of_all_draws():
    # a stratum (0, 1), each mean of two draws: 0 (1/4), .5 (1/2), 1 (1/4)
    assert bootstrap(mean, [np.array([0.0, 1.0])]) == (0, 1)
    # of 200 the mean is nearly normal: .5 -+ 1.96 * .5 / sqrt(200)
    low, high = bootstrap(mean, [np.tile([0.0, 1.0], 100)])
    assert (low, high) == (pytest.approx(0.4307, abs=0.006), pytest.approx(0.5693, abs=0.006))


def test_episodes_within_seeds_vary_less_than_all_episodes_together():
    seeds = [np.array([1.0, 1.2]), np.array([9.0, 9.2])]
    low, high = bootstrap(mean, seeds)
    assert (low, high) == (pytest.approx(5.0), pytest.approx(5.2))
    low, high = bootstrap(mean, [np.concatenate(seeds)])
    assert high - low > 4


def test_the_interval_is_a_function_of_its_seed():
    scores = [np.random.default_rng(7).random(10)]
    assert bootstrap(iqm, scores, seed=1) == bootstrap(iqm, scores, seed=1)
    assert bootstrap(iqm, scores, seed=1) != bootstrap(iqm, scores, seed=2)


# Five runs of four tasks, and three others. The values below are what rliable 1.2.0 gives for them;
# the intervals stem from its stratified bootstrap of 50,000 draws, the last two from 2,000.
RUNS = np.array(
    [
        [0.41, 0.21, 0.48, 0.17],
        [0.32, 0.61, 0.78, 0.63],
        [0.43, 0.25, 0.11, 0.32],
        [0.71, 0.77, 0.80, 0.19],
        [0.31, 0.60, 0.78, 0.47],
    ]
)
OTHERS = np.array([[0.40, 0.62, 0.45, 0.31], [0.52, 0.24, 0.32, 0.55], [0.60, 0.10, 0.40, 0.48]])


@pytest.mark.parametrize(
    ("statistic", "value", "low", "high"),
    [
        (mean, 0.4675, 0.375, 0.5565),
        (median, 0.462, 0.359, 0.564),
        (iqm, 0.458, 0.33, 0.589),
        (optimality_gap, 0.5325, 0.4435, 0.625),
    ],
)
def test_aggregates_and_their_intervals_are_rliables(statistic, value, low, high):
    assert statistic(list(RUNS.T)) == pytest.approx(value)
    assert bootstrap(statistic, list(RUNS.T)) == pytest.approx((low, high), abs=0.006)


def test_the_probability_of_improvement_and_its_interval_are_rliables():
    groups = list(RUNS.T), list(OTHERS.T)
    assert probability_of_improvement(*groups) == pytest.approx(0.53333333)
    interval = bootstrap(probability_of_improvement, *groups)
    assert interval == pytest.approx((0.3333, 0.7167), abs=0.02)


def test_the_profile_and_its_band_are_rliables():
    def profile(scores):
        return performance_profile(scores, np.array([0.2, 0.5, 0.8]))

    assert profile(list(RUNS.T)) == pytest.approx([0.85, 0.4, 0])
    low, high = bootstrap(profile, list(RUNS.T))
    assert low == pytest.approx([0.7, 0.2, 0], abs=0.01)
    assert high == pytest.approx([1, 0.6, 0], abs=0.01)


@pytest.mark.parametrize("n", [3, 10, 31, 32, 50])
def test_the_interval_is_students(n):
    values = np.random.default_rng(n).normal(5, 2, n)
    expected = stats.t.interval(0.95, n - 1, values.mean(), stats.sem(values))
    assert mean_interval(values.tolist())[1:] == pytest.approx(expected, abs=1e-4)


def test_fewer_than_three_values_have_no_interval():
    assert mean_interval([3.0]) == (3.0, None, None)
    assert mean_interval([0.0, 1.0]) == (0.5, None, None)


def test_a_bootstrap_needs_two_scores_of_each_stratum_and_two_degrees_of_freedom():
    cases = {(2,): False, (3,): True, (2, 2): True, (9, 1): False, (1,): False}
    for sizes, enough in cases.items():
        assert resamplable([np.zeros(size) for size in sizes]) == enough, sizes


def test_the_sign_test_by_hand_and_against_scipys():
    # five of five: 2 (1 / 2^5); four of five: 2 (5 + 1) / 32; as many above as below: certain
    assert [sign_test(*pair) for pair in ((5, 0), (1, 4), (2, 2), (0, 0))] == [0.0625, 0.375, 1, 1]
    assert sign_test(30, 12) == pytest.approx(stats.binomtest(30, 42).pvalue)
