"""Averages with bootstrap intervals.

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
TRIM = 0.25
"""Fraction that the interquartile mean leaves out at each end."""


@dataclass(frozen=True)
class Interval:
    """An average or a rate with its interval; the ends are nan if there is only one sample."""

    value: float
    low: float
    high: float

    def as_percent(self) -> str:
        """Return a rate as text, such as ``85% (64% to 95%)``."""
        return f"{self.value:.0%} ({self.low:.0%} to {self.high:.0%})"


def mean_interval(samples: ArrayLike) -> Interval:
    """Return the mean of independent samples, shape (k,).

    Raises:
        ValueError: If there are no samples.
    """
    values = _table(samples, 1)
    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, math.nan, math.nan)
    return _interval(mean, (values,), np.mean, paired=False)


def stratified_mean_interval(strata: Sequence[ArrayLike]) -> Interval:
    """Return the mean of the strata's means, with a bootstrap that resamples every stratum.

    Args:
        strata: Independent samples of each stratum, such as the episodes of each robot, shape (k,).

    Raises:
        ValueError: If a stratum has no samples.
    """
    tables = tuple(_table(samples, 1) for samples in strata)
    mean = float(np.mean([table.mean() for table in tables]))
    if min(len(table) for table in tables) < 2:
        return Interval(mean, math.nan, math.nan)

    def statistic(*samples: NDArray[Any], axis: int = -1) -> NDArray[Any]:
        values: NDArray[Any] = np.mean([sample.mean(axis=axis) for sample in samples], axis=0)
        return values

    return _interval(mean, tables, statistic, paired=False)


def wilson_interval(successes: int, trials: int) -> Interval:
    """Return a success rate with its interval (Wilson 1927), which stays within 0 and 1.

    Args:
        successes: Number of successes.
        trials: Number of trials, at least 1.
    """
    result = binomtest(successes, trials).proportion_ci(LEVEL, method="wilson")
    return Interval(successes / trials, float(result.low), float(result.high))


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
        return Interval(value, value, value)
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
    return Interval(value, float(interval.low), float(interval.high))


def _table(values: ArrayLike, axes: int) -> NDArray[np.float64]:
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != axes or not table.size:
        raise ValueError(f"scores of shape {table.shape}: expected {axes} axes, none of them empty")
    return table
