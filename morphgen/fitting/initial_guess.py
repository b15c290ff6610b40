"""Where the search for primitives begins: boxes and cylinders around clouds of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from morphgen.fitting.canonical import KINDS
from morphgen.fitting.soft_iou import Candidates, covered, overlaps
from morphgen.typing import Array

TRIM = 0.03
"""Share of a cloud's points that a guess leaves out at either end of an axis."""
FEWEST = 8
"""Points that a piece must have."""
_CUTS = (1, 2, 3)
"""Numbers of clusters of what is left out that are tried as one primitive more."""
_THINNEST = 1e-3
"""Half extent of the thinnest guess; points are in units of the solid's size."""
_BOX, _CYLINDER, _SPHERE = (KINDS.index(kind) for kind in ("box", "cylinder", "sphere"))
_TURNS = (
    np.eye(3),
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
)
"""Rotations that bring each axis in turn to z."""


def around(points: Array, axes: list[Array], *, sphere: bool = False) -> Candidates:
    """Guesses of one primitive each around a cloud of points, shape (n, 3).

    Boxes and cylinders along the principal axes and along those given, each of shape (3, 3); and
    a sphere on request.
    """
    guesses = [guess for R in (*axes, _principal_axes(points)) for guess in _along(points, R)]
    if sphere:
        middle = points.mean(axis=0)
        radius = np.sqrt(5 / 3 * np.square(points - middle).sum(axis=1).mean())
        guesses.append((_SPHERE, middle, np.eye(3), np.full(3, radius)))
    kinds, centres, rotations, halves = zip(*guesses, strict=True)
    quaternions = Rotation.from_matrix(np.array(rotations)).as_quat(scalar_first=True)
    return Candidates(
        np.array(kinds)[:, None],
        np.array(centres)[:, None],
        quaternions[:, None],
        np.array(halves)[:, None],
    )


def by_pieces(
    points: Array, inside: NDArray[np.bool_], weights: Array, k: int, seeds: list[int]
) -> Candidates | None:
    """Guesses of ``k`` primitives: the solid is cut into ``k`` clusters, each with its best guess.

    Args:
        points: Shape (n, 3), over the solid and around it.
        inside: Whether each lies in the solid.
        weights: What each point counts.
        k: How many primitives.
        seeds: One clustering each; every one gives three guesses: the best kinds, only boxes, only
            cylinders.

    Returns:
        The guesses; None if the solid has too few points to be cut.
    """
    cloud, outside = points[inside], (points[~inside], weights[~inside])
    rows: list[Candidates] = []
    for seed in seeds:
        _, label = kmeans2(cloud, k, minit="++", seed=seed, iter=10)
        if np.bincount(label, minlength=k).min() < FEWEST:
            continue
        pieces = [
            _best_of_each_kind(cloud[label == j], weights[inside][label == j], *outside)
            for j in range(k)
        ]
        rows.append(Candidates.join(pieces))
    return Candidates.stack(rows) if rows else None


def by_growth(
    found: Candidates, points: Array, inside: NDArray[np.bool_], weights: Array, seed: int
) -> Candidates | None:
    """Guesses of one primitive more than found: where it leaves out a part of the solid.

    Args:
        found: One guess of ``k - 1`` primitives.
        points: Shape (n, 3), over the solid and around it.
        inside: Whether each lies in the solid.
        weights: What each point counts.
        seed: Of the clusterings of what is left out.

    Returns:
        The guesses; None if too few points are left out.
    """
    missed = inside & ~covered(found, points)[0]
    cloud, outside = points[missed], (points[~inside], weights[~inside])
    rows: list[Candidates] = []
    for n in _CUTS:
        if len(cloud) < n * FEWEST:
            break
        _, label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        for j in range(n):
            if np.count_nonzero(label == j) >= FEWEST:
                piece = cloud[label == j], weights[missed][label == j]
                more = _best_of_each_kind(*piece, *outside)
                rows.append(Candidates.join([found.take(np.zeros(3, np.intp)), more]))
    return Candidates.stack(rows) if rows else None


def _best_of_each_kind(piece: Array, counts: Array, outside: Array, others: Array) -> Candidates:
    """Three guesses around a piece: the best, the best box, the best cylinder."""
    guesses = around(piece, [np.eye(3)])
    points = np.concatenate([piece, outside])
    weights = np.concatenate([counts, others])
    score = overlaps(guesses, points, np.arange(len(points)) < len(piece), weights)
    kinds = guesses.kinds[:, 0]
    best = [
        int(np.argmax(np.where(allowed, score, -1.0)))
        for allowed in (kinds >= 0, kinds == _BOX, kinds == _CYLINDER)
    ]
    return guesses.take(np.array(best))


def _principal_axes(points: Array) -> Array:
    _, axes = np.linalg.eigh(np.cov(points.T))
    return np.asarray(axes * (1.0, 1.0, np.linalg.det(axes)))


def _along(points: Array, R: Array) -> list[tuple[int, Array, Array, Array]]:
    """A box with the axes of ``R`` and a cylinder along each: kind, centre, rotation, halves."""
    low, high = np.quantile(points @ R, (TRIM, 1 - TRIM), axis=0)
    centre, halves = R @ (low + high) / 2, np.maximum((high - low) / 2, _THINNEST)
    found = [(_BOX, centre, R, halves)]
    for turn in _TURNS:
        x, y, z = np.abs(turn.T @ halves)
        radius = np.sqrt(x * y)
        found.append((_CYLINDER, centre, R @ turn, np.array([radius, radius, z])))
    return found
