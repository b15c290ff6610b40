"""A flat map of bodies whose distances are as near to the true ones as two dimensions allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from morphgen.typing import Array

_NOTHING = 1e-12
"""Eigenvalues are nothing below this share of the largest squared distance."""
_EQUAL = 1e-9
"""Relative difference within which points are equally far."""


@dataclass(frozen=True, eq=False)
class ScalingMap:
    """Points in the plane."""

    points: Array
    """Shape (n, 2), in units of the distances, centred; the first axis varies most."""
    kept: float
    """Share of the variation that two dimensions show, in [0, 1]."""


def scaling_map(distances: ArrayLike) -> ScalingMap:
    """Classical multidimensional scaling: Torgerson, Multidimensional scaling, 1952.

    The two largest eigenvectors of the squared distances, centred twice. Their share is that of
    the sum of all eigenvalues' magnitudes (Mardia, Kent and Bibby, Multivariate analysis, 1979,
    section 14.4), because distances that fit into no Euclidean space give negative ones, too. Each
    axis is turned so that the point farthest from its middle, the first of equals, is on the right.

    Args:
        distances: Symmetric, zeros on the diagonal, shape (n, n).

    Raises:
        ValueError: If they are no distances.
    """
    d = np.asarray(distances, dtype=np.float64)
    if d.ndim != 2 or d.shape[0] != d.shape[1] or not len(d):
        raise ValueError(f"distances have shape {d.shape}; expected (n, n)")
    if not np.isfinite(d).all() or (d < 0).any() or d.diagonal().any() or (d != d.T).any():
        raise ValueError("distances must be finite, symmetric, not negative, and 0 to oneself")
    squared = d * d
    rows = squared.mean(axis=0)
    values, vectors = np.linalg.eigh(-(squared - rows - rows[:, None] + rows.mean()) / 2)
    total = np.abs(values).sum()
    largest = np.maximum(values[::-1][:2], 0.0)
    points = np.zeros((len(d), 2))
    points[:, : len(largest)] = vectors[:, ::-1][:, :2] * np.sqrt(largest)
    if total <= _NOTHING * len(d) * squared.max(initial=0.0):
        return ScalingMap(np.zeros_like(points), 1.0)
    return ScalingMap(_turned(points), float(largest.sum() / total))


def _turned(points: Array) -> Array:
    """Points with the sign of each axis settled; adds 0.0 so that there is no -0."""
    size = np.abs(points)
    farthest = (size >= size.max(axis=0) * (1 - _EQUAL)).argmax(axis=0)
    sign = np.where(points[farthest, [0, 1]] < 0, -1.0, 1.0)
    return np.asarray(points * sign + 0.0)
