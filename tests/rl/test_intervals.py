"""Means and their bootstrap intervals."""

import math
from itertools import product

import numpy as np
import pytest

from morphgen.rl.scores import (
    Interval,
    episode_interval,
    iqm_interval,
    stratified_mean_interval,
    success_interval,
)


def all_resamples(values):
    """The exact distribution of the mean of resamples."""
    return [np.mean(chosen) for chosen in product(values, repeat=len(values))]


def test_the_interquartile_mean_drops_a_quarter_at_each_end():
    scores = [[-1000.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 1000.0]]
    assert iqm_interval(scores, together=True).value == pytest.approx(np.mean([2, 3, 4, 5]))


@pytest.mark.parametrize("together", [True, False])
def test_the_interval_of_one_robot_contains_95_percent_of_the_resamples(together):
    values = [1.0, 2.0, 4.0]
    found = iqm_interval(np.array(values)[:, None], together=together)
    low, high = np.quantile(all_resamples(values), (0.025, 0.975), method="inverted_cdf")
    assert (found.low, found.high) == pytest.approx((low, high))
    alone = stratified_mean_interval([values])
    assert (alone.low, alone.high) == pytest.approx((low, high))


def test_resampled_seeds_keep_their_robots_together():
    # Robots go up and down together: by themselves they make up for each other.
    scores = np.array([0.0, 1.0, 2.0, 3.0])[:, None] + np.zeros(8)
    whole, apart = (iqm_interval(scores, together=together) for together in (True, False))
    assert whole.value == apart.value == pytest.approx(1.5)
    assert whole.high - whole.low > 2 * (apart.high - apart.low) > 0


def test_robots_are_strata_of_the_bootstrap():
    # Scores differ between robots only: no resample is another.
    scores = np.tile([1.0, 5.0, 9.0, 100.0], (3, 1))
    for together in (True, False):
        found = iqm_interval(scores, together=together)
        assert (found.value, math.isnan(found.low), math.isnan(found.high)) == (7.0, True, True)


def test_the_wilson_interval_stays_within_0_and_1():
    for successes, low, high in ((0, 0.0, 0.1611), (10, 0.2993, 0.7007), (20, 0.8389, 1.0)):
        interval = success_interval(successes / 20, 20)
        assert interval.value == successes / 20
        assert interval.low == pytest.approx(low, abs=1e-4)
        assert interval.high == pytest.approx(high, abs=1e-4)


@pytest.mark.parametrize("rate", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("trials", [1, 36, [10, 10, 16], [34] * 320, 10**6])
def test_a_success_rate_always_has_an_interval_with_a_width(rate, trials):
    rates = np.full(np.shape(trials), rate)
    interval = success_interval(rates, trials)
    low, high = interval.as_percent()[:-1].split(" (")[1].split(" to ")
    assert (interval.low < interval.high, low != high, interval.value) == (True, True, rate)


def test_robots_of_equally_many_episodes_are_as_one():
    assert success_interval([0.25, 0.75], 20) == success_interval(0.5, 40)
    few, even = success_interval([0.2, 0.4], [5, 35]), success_interval([0.2, 0.4], 20)
    assert few.high - few.low > even.high - even.low  # the mean is no surer than its worst half


@pytest.mark.parametrize("value", [0, 1])
def test_scores_that_are_successes_have_the_interval_of_successes(value):
    scores, successes = [[float(value)] * 12] * 3, [[bool(value)] * 12] * 3
    found = episode_interval(scores, successes, relative=False)
    assert found == success_interval(value, 36)
    relative = episode_interval(scores, successes, relative=True)
    assert (relative.value, math.isnan(relative.low)) == (value, True)
    mixed = [[0.0, 1.0], [1.0, 1.0]]
    assert episode_interval(mixed, mixed, relative=False) == success_interval(0.75, 4)


@pytest.mark.parametrize(
    "scores", [[[0.0] * 36], [[5.5] * 3, [5.5] * 3], [[1.0] * 9, [2.0] * 9], [[3.0]]]
)
def test_scores_without_a_spread_have_no_interval(scores):
    for found in (
        stratified_mean_interval(scores),
        episode_interval(scores, [[False] * len(each) for each in scores], relative=True),
        iqm_interval(np.transpose(scores), together=True),
        iqm_interval(np.array([[1.0] * 15 + [0.9], [1.0] * 15 + [0.8]]), together=True),
    ):
        assert isinstance(found, Interval)
        assert math.isnan(found.low)
        assert math.isnan(found.high)
