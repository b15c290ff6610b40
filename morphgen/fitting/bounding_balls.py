"""Smallest enclosing balls of point sets in any dimension: circles and spheres.

The farthest point outside is added to the support of a ball until no point is outside (Gaertner,
"Fast and robust smallest enclosing balls", 1999). Many sets are processed at once.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from morphgen.typing import Array

_ON_BALL = 1e-12
"""Relative excess of the squared distance below which a point counts as on the ball."""
_MAX_PIVOTS = 100


def smallest_balls(points: Array) -> tuple[Array, Array]:
    """Return the smallest balls that contain each of ``n`` sets of ``m`` points.

    points: Shape (n, d, m).

    Returns:
        Centres, shape (n, d), and radii that reach every point, shape (n,).
    """
    n, d, _ = points.shape
    active = np.arange(n)
    centres = points[active, :, _squared_lengths(points - points[:, :, :1]).argmax(axis=1)]
    squared_radii = np.zeros(n)
    support = np.repeat(centres[:, :, None], d + 1, axis=2)
    for _ in range(_MAX_PIVOTS):
        distances = _squared_lengths(points[active] - centres[active, :, None])
        farthest = distances.argmax(axis=1)
        outside = distances.max(axis=1) > squared_radii[active] * (1 + _ON_BALL)
        active, farthest = active[outside], farthest[outside]
        if not len(active):
            break
        pivots = points[active, :, farthest]
        offsets, grown, kept = _balls_through_origin(support[active] - pivots[:, :, None])
        # A ball that does not grow has reached the precision of its numbers.
        larger = np.isfinite(grown) & (grown > squared_radii[active])
        active, pivots, kept = active[larger], pivots[larger], kept[larger]
        support[active, :, :d] = np.take_along_axis(support[active], kept[:, None], axis=2)
        support[active, :, d] = pivots
        centres[active] = pivots + offsets[larger]
        squared_radii[active] = grown[larger]
    return centres, np.sqrt(_squared_lengths(points - centres[:, :, None]).max(axis=1))


def _balls_through_origin(others: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Return the smallest balls around ``d + 1`` points with the origin on their boundary.

    others: Shape (n, d, d + 1).

    Returns:
        Centres, shape (n, d), squared radii (infinite where there is no such ball), and indices of
        the points on the boundary, shape (n, d), some repeated.
    """
    d = others.shape[1]
    centres, unique, chosen = [], [], []
    for k in range(1, d + 1):
        subsets = np.array(list(itertools.combinations(range(d + 1), k)))
        chosen.append(subsets[:, np.arange(d) % k])
        # The centre c solves 2 p . c = p . p for each point p of a subset.
        spokes = others[:, :, subsets].transpose(0, 2, 3, 1)
        gram = spokes @ spokes.swapaxes(2, 3)
        lengths = np.diagonal(gram, axis1=2, axis2=3)
        unique.append(np.linalg.det(gram) > _ON_BALL * lengths.prod(axis=2))
        gram = np.where(unique[-1][:, :, None, None], gram, np.eye(k))
        centres.append((spokes * np.linalg.solve(gram, lengths[..., None] / 2)).sum(axis=2))
    centre = np.concatenate(centres, axis=1).swapaxes(1, 2)
    squares = _squared_lengths(centre)
    farthest = _squared_lengths(others[:, :, None] - centre[..., None]).max(axis=2)
    holds = np.concatenate(unique, axis=1) & (farthest <= squares * (1 + 100 * _ON_BALL))
    squares = np.where(holds, squares, np.inf)
    best, rows = squares.argmin(axis=1), np.arange(len(others))
    return centre[rows, :, best], squares[rows, best], np.concatenate(chosen)[best]


def _squared_lengths(vectors: Array) -> Array:
    """Return the squared lengths along axis 1."""
    return np.asarray(np.square(vectors).sum(axis=1))
