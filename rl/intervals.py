"""Averages with their intervals: bootstrap for scores, Wilson for successes.

After Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import binomtest, bootstrap, trim_mean

LEVEL = 0.95
"""Confidence level of the intervals."""
RESAMPLES = 2000
MAX_RESAMPLED = 2**26
"""Largest number of values that are resampled at once: 512 MB."""
_MAX_DIGITS = 6
"""Largest number of decimals of a rate's ends, which have as many as tell them apart."""
TRIM = 0.25
"""Fraction that the interquartile mean leaves out at each end."""


@dataclass(frozen=True)
class Interval:
    """An average or a rate with its interval.

    The ends are nan if the samples cannot tell them: there is one, or all resamples have one mean.
    """

    value: float
    low: float
    high: float

    def as_percent(self) -> str:
        """Return a rate as text, such as ``85% (64% to 95%)``."""
        ends = (self.low, self.high)
        texts = [[f"{end:.{digits}%}" for end in ends] for digits in range(_MAX_DIGITS + 1)]
        low, high = next((pair for pair in texts if pair[0] != pair[1]), texts[-1])
        return f"{self.value:.0%} ({low} to {high})"


def stratified_mean_interval(strata: Sequence[ArrayLike]) -> Interval:
    """Return the mean of the strata's means, with a bootstrap that resamples every stratum.

    Args:
        strata: Independent samples of each stratum, such as the episodes of each robot, shape (k,).

    Raises:
        ValueError: If there is no stratum, or one has no samples.
    """
    tables = tuple(_table(samples, 1) for samples in strata)
    mean = float(np.mean([table.mean() for table in tables]))
    if min(len(table) for table in tables) < 2:
        return Interval(mean, math.nan, math.nan)

    def statistic(*samples: NDArray[Any], axis: int = -1) -> NDArray[Any]:
        values: NDArray[Any] = np.mean([sample.mean(axis=axis) for sample in samples], axis=0)
        return values

    return _interval(mean, tables, statistic, paired=False)


def success_interval(rates: ArrayLike, trials: ArrayLike) -> Interval:
    """Return a mean success rate with its interval (Wilson 1927), which stays within 0 and 1.

    It has a width at 0 and 1, too. It is that of one rate for all strata: strata of different rates
    make it too wide, never too narrow.

    Args:
        rates: Success rate of each stratum, such as the episodes of a robot and seed, shape (k,);
            or that of all, a number.
        trials: Number of trials of each stratum, at least 1, shape (k,) or a number.
    """
    rates, trials = np.broadcast_arrays(np.asarray(rates, dtype=np.float64), trials)
    mean = float(rates.mean())
    # As many trials as have the variance of the mean of the strata: all, if they are equally large.
    total = round(rates.size**2 / float(np.sum(1 / trials)))
    result = binomtest(round(mean * total), total).proportion_ci(LEVEL, method="wilson")
    return Interval(mean, float(result.low), float(result.high))


def episode_interval(
    scores: Sequence[ArrayLike], successes: Sequence[ArrayLike], *, relative: bool
) -> Interval:
    """Return the mean over robots of their mean scores.

    Its interval is ``success_interval`` if the score of an episode is its success, as that of push;
    else ``stratified_mean_interval``.

    Args:
        scores: Scores of the episodes of each robot, shape (k,).
        successes: Whether each of these episodes was a success, shape (k,).
        relative: Whether the scores are relative to the random policy, and so no successes.

    Raises:
        ValueError: If there is no robot, or one has no episodes.
    """
    if not relative and all(map(np.array_equal, scores, successes)):
        tables = [_table(each, 1) for each in successes]
        return success_interval([each.mean() for each in tables], [len(each) for each in tables])
    return stratified_mean_interval(scores)


def iqm_interval(scores: ArrayLike, *, together: bool) -> Interval:
    """Return the interquartile mean of all scores, with a stratified bootstrap over seeds.

    Robots are the strata: every resample has as many scores of each robot as the original.

    Args:
        scores: Scores of every seed on every robot, shape (seeds, robots).
        together: Resample whole seeds, as the scores of a seed come from one policy; otherwise
            resample the scores of each robot independently.

    Raises:
        ValueError: If there are no scores.
    """
    table = _table(scores, 2)
    iqm = float(trim_mean(table.ravel(), TRIM))
    if len(table) < 2:
        return Interval(iqm, math.nan, math.nan)

    def statistic(*strata: NDArray[Any], axis: int = -1) -> NDArray[Any]:
        values: NDArray[Any] = trim_mean(np.concatenate(strata, axis=axis), TRIM, axis=axis)
        return values

    return _interval(iqm, tuple(table.T), statistic, paired=together)


def _interval(
    value: float,
    samples: tuple[NDArray[np.float64], ...],
    statistic: Callable[..., Any],
    *,
    paired: bool,
) -> Interval:
    if all(np.ptp(sample) == 0 for sample in samples):
        return Interval(value, math.nan, math.nan)
    num_values = sum(len(sample) for sample in samples)
    interval = bootstrap(
        samples,
        statistic,
        paired=paired,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=min(RESAMPLES, max(1, MAX_RESAMPLED // num_values)),
        confidence_level=LEVEL,
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    if interval.low == interval.high:
        return Interval(value, math.nan, math.nan)
    return Interval(value, float(interval.low), float(interval.high))


def _table(values: ArrayLike, axes: int) -> NDArray[np.float64]:
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != axes or not table.size:
        raise ValueError(f"scores of shape {table.shape}: expected {axes} axes, none of them empty")
    return table
