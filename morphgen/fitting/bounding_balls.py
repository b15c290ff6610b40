"""The smallest balls around sets of points, in any dimension: circles and spheres."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from morphgen.typing import Array

_ON_BALL = 1e-12
"""Relative excess of squared distance at which a point is on a ball."""
_PIVOTS = 100
"""Most points that a ball is pivoted on."""


def smallest_balls(points: Array) -> tuple[Array, Array]:
    """The smallest balls around ``n`` sets of ``m`` points.

    Each ball is spanned by few points on its boundary; the farthest point outside is taken in and
    the ball grows, until none is outside.

    Args:
        points: Shape (n, d, m).

    Returns:
        Centres, shape (n, d), and radii that reach every point, shape (n,).
    """
    n, d, _ = points.shape
    live = np.arange(n)
    centres = points[live, :, _squares(points - points[:, :, :1]).argmax(axis=1)]
    squares = np.zeros(n)
    support = np.repeat(centres[:, :, None], d + 1, axis=2)
    for _ in range(_PIVOTS):
        distances = _squares(points[live] - centres[live, :, None])
        farthest = distances.argmax(axis=1)
        outside = distances.max(axis=1) > squares[live] * (1 + _ON_BALL)
        live, farthest = live[outside], farthest[outside]
        if not len(live):
            break
        new = points[live, :, farthest]
        offsets, grown, kept = _smallest_through(support[live] - new[:, :, None])
        larger = np.isfinite(grown) & (grown > squares[live])
        live, new, kept = live[larger], new[larger], kept[larger]
        support[live, :, :d] = np.take_along_axis(support[live], kept[:, None], axis=2)
        support[live, :, d] = new
        centres[live] = new + offsets[larger]
        squares[live] = grown[larger]
    return centres, np.sqrt(_squares(points - centres[:, :, None]).max(axis=1))


def _smallest_through(others: Array) -> tuple[Array, Array, NDArray[np.intp]]:
    """Smallest balls with the origin on their boundary around ``d + 1`` other points.

    Args:
        others: Shape (n, d, d + 1).

    Returns:
        Centres, shape (n, d), squared radii (infinite where none was found), and which points are
        on the boundary, shape (n, d), some repeated.
    """
    d = others.shape[1]
    centres, unique, chosen = [], [], []
    for k in range(1, d + 1):
        some = np.array(list(itertools.combinations(range(d + 1), k)))
        chosen.append(some[:, np.arange(d) % k])
        spokes = others[:, :, some].transpose(0, 2, 3, 1)
        gram = spokes @ spokes.swapaxes(2, 3)
        lengths = np.diagonal(gram, axis1=2, axis2=3)
        unique.append(np.linalg.det(gram) > _ON_BALL * lengths.prod(axis=2))
        gram = np.where(unique[-1][:, :, None, None], gram, np.eye(k))
        centres.append((spokes * np.linalg.solve(gram, lengths[..., None] / 2)).sum(axis=2))
    centre = np.concatenate(centres, axis=1).swapaxes(1, 2)
    squares = _squares(centre)
    farthest = _squares(others[:, :, None] - centre[..., None]).max(axis=2)
    holds = np.concatenate(unique, axis=1) & (farthest <= squares * (1 + 100 * _ON_BALL))
    squares = np.where(holds, squares, np.inf)
    best, rows = squares.argmin(axis=1), np.arange(len(others))
    return centre[rows, :, best], squares[rows, best], np.concatenate(chosen)[best]


def _squares(vectors: Array) -> Array:
    """Squared lengths along axis 1."""
    return np.asarray(np.square(vectors).sum(axis=1))
