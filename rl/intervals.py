"""Averages with bootstrap intervals.

After Agarwal et al. 2021, "Deep reinforcement learning at the edge of the statistical precipice".
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import bootstrap, trim_mean

LEVEL = 0.95
"""Of the intervals."""
RESAMPLES = 2000
TRIM = 0.25
"""Share that the interquartile mean leaves away at each end."""


@dataclass(frozen=True)
class Interval:
    """An average, and where it is in 95 of 100 resamples; nan if there is nothing to resample."""

    value: float
    low: float
    high: float


def mean_interval(samples: ArrayLike) -> Interval:
    """Mean of independent samples, shape (k,).

    Raises:
        ValueError: If there is none.
    """
    values = _table(samples, 1)
    found = float(values.mean())
    if len(values) < 2:
        return Interval(found, math.nan, math.nan)
    return _interval(found, (values,), np.mean, paired=False)


def iqm_interval(scores: ArrayLike, *, together: bool) -> Interval:
    """Interquartile mean of all scores, with an interval by the stratified bootstrap over seeds.

    Robots are the strata: every resample has as many scores of each robot as there are.

    Args:
        scores: Of runs with as many seeds on robots, shape (seeds, robots).
        together: Whether a seed's scores come of one policy, so that seeds are drawn whole; else
            those of each robot are drawn by themselves.

    Raises:
        ValueError: If there is none.
    """
    table = _table(scores, 2)
    found = _iqm(table.ravel())
    if len(table) < 2:
        return Interval(found, math.nan, math.nan)

    def statistic(*strata: NDArray[Any], axis: int = -1) -> NDArray[Any]:
        values: NDArray[Any] = trim_mean(np.concatenate(strata, axis=axis), TRIM, axis=axis)
        return values

    return _interval(found, tuple(table.T), statistic, paired=together)


def _iqm(values: NDArray[np.float64]) -> float:
    return float(trim_mean(values, TRIM))


def _interval(
    value: float,
    samples: tuple[NDArray[np.float64], ...],
    statistic: Callable[..., Any],
    *,
    paired: bool,
) -> Interval:
    if all(np.ptp(sample) == 0 for sample in samples):
        return Interval(value, value, value)
    found = bootstrap(
        samples,
        statistic,
        paired=paired,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    return Interval(value, float(found.low), float(found.high))


def _table(values: ArrayLike, axes: int) -> NDArray[np.float64]:
    table = np.asarray(values, dtype=np.float64)
    if table.ndim != axes or not table.size:
        raise ValueError(f"scores of shape {table.shape}: expected {axes} axes, none of them empty")
    return table
