"""Initial guesses for the search for primitives: boxes and cylinders around point clouds."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation

from morphgen.fitting.soft_iou import SEARCH_KINDS, Candidates, covered, overlaps
from morphgen.typing import Array

TRIM = 0.03
"""Share of a cloud's points outside of a guess at either end of an axis."""
MIN_POINTS = 8
"""Smallest number of points of a cluster."""
_NUM_CLUSTERS = (1, 2, 3)
"""Numbers of clusters of the uncovered points, each of which may get a further primitive."""
_MIN_HALF_EXTENT = 1e-3
"""Smallest half extent of a guess, relative to the solid's size."""
_CAP_LENGTH = 2 / 3
"""Length of a cylinder of the volume of a capsule's cap, relative to the radius."""
_BOX, _CYLINDER, _SPHERE, _CAPSULE = (
    SEARCH_KINDS.index(kind) for kind in ("box", "cylinder", "sphere", "capsule")
)
_AXES_TO_Z = (
    np.eye(3),
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
)
"""Rotations whose z axis is the z, x and y axis."""


def around(
    points: Array, axes: list[Array], *, sphere: bool = False, capsules: bool = False
) -> Candidates:
    """Return guesses of one primitive each around a point cloud.

    Args:
        points: Points, shape (n, 3).
        axes: Rotations, shape (3, 3) each, whose axes boxes and cylinders follow, besides the
            principal axes of the points.
        sphere: Add a sphere.
        capsules: Add a capsule for each cylinder.
    """
    _, principal_axes = np.linalg.eigh(np.cov(points.T))
    principal_axes *= (1.0, 1.0, np.linalg.det(principal_axes))  # right-handed
    guesses = [guess for R in (*axes, principal_axes) for guess in _along(points, R)]
    if capsules:
        guesses += [
            (_CAPSULE, centre, R, np.array([r, r, max(h - _CAP_LENGTH * r, _MIN_HALF_EXTENT)]))
            for kind, centre, R, (r, _, h) in guesses
            if kind == _CYLINDER
        ]
    if sphere:
        centre = points.mean(axis=0)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radius = np.sqrt(5 / 3 * np.square(points - centre).sum(axis=1).mean())
        guesses.append((_SPHERE, centre, np.eye(3), np.full(3, radius)))
    kinds, centres, rotations, halves = zip(*guesses, strict=True)
    quaternions = Rotation.from_matrix(np.array(rotations)).as_quat(scalar_first=True)
    return Candidates(
        np.array(kinds)[:, None],
        np.array(centres)[:, None],
        quaternions[:, None],
        np.array(halves)[:, None],
    )


def by_pieces(
    points: Array,
    inside: NDArray[np.bool_],
    weights: Array,
    k: int,
    seeds: list[int],
    *,
    capsules: bool = False,
) -> Candidates | None:
    """Return guesses of ``k`` primitives: the best guess around each of ``k`` clusters.

    Args:
        points: Points over the solid and its surroundings, shape (n, 3).
        inside: Points that are inside the solid, shape (n,).
        weights: Weights of the points, shape (n,).
        k: Number of primitives.
        seeds: Seeds of one clustering each. A clustering gives three guesses: the best kind for
            each cluster, only boxes, and only cylinders.
        capsules: Capsules are among the kinds, and a fourth guess has only capsules.

    Returns:
        The guesses; None if a cluster has too few points in every clustering.
    """
    cloud, outside = points[inside], (points[~inside], weights[~inside])
    rows: list[Candidates] = []
    for seed in seeds:
        _, label = kmeans2(cloud, k, minit="++", seed=seed, iter=10)
        if np.bincount(label, minlength=k).min() < MIN_POINTS:
            continue
        pieces = [
            _best_of_each_kind(
                cloud[label == j], weights[inside][label == j], *outside, capsules=capsules
            )
            for j in range(k)
        ]
        rows.append(Candidates.join(pieces))
    return Candidates.stack(rows) if rows else None


def by_growth(
    fewer: Candidates,
    points: Array,
    inside: NDArray[np.bool_],
    weights: Array,
    seed: int,
    *,
    capsules: bool = False,
) -> Candidates | None:
    """Return guesses with one more primitive, around a part of the solid that is not covered.

    Args:
        fewer: One candidate of ``k - 1`` primitives.
        points: Points over the solid and its surroundings, shape (n, 3).
        inside: Points that are inside the solid, shape (n,).
        weights: Weights of the points, shape (n,).
        seed: Seed of the clusterings of the uncovered points.
        capsules: Add guesses with a capsule.

    Returns:
        The guesses; None if too few points are uncovered.
    """
    missed = inside & ~covered(fewer, points)[0]
    cloud, outside = points[missed], (points[~inside], weights[~inside])
    rows: list[Candidates] = []
    for n in _NUM_CLUSTERS:
        if len(cloud) < n * MIN_POINTS:
            break
        _, label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        for j in range(n):
            if np.count_nonzero(label == j) >= MIN_POINTS:
                piece = cloud[label == j], weights[missed][label == j]
                more = _best_of_each_kind(*piece, *outside, capsules=capsules)
                rows.append(Candidates.join([fewer.take(np.zeros(len(more.kinds), int)), more]))
    return Candidates.stack(rows) if rows else None


def by_replacement(
    candidates: Candidates, points: Array, inside: NDArray[np.bool_], weights: Array, seed: int
) -> Candidates | None:
    """Return guesses in which one primitive is replaced by one where the rest leaves a gap.

    Each primitive of each candidate is replaced in turn, also by capsules. Arguments and result
    are those of ``by_growth``.
    """
    n, k = candidates.kinds.shape
    rows = [
        by_growth(rest.without(i), points, inside, weights, seed, capsules=True)
        for rest in (candidates.take(np.array([row])) for row in range(n))
        for i in range(k)
    ]
    guesses = [guess for guess in rows if guess is not None]
    return Candidates.stack(guesses) if guesses else None


def _best_of_each_kind(
    piece: Array, piece_weights: Array, outside: Array, outside_weights: Array, *, capsules: bool
) -> Candidates:
    """Return guesses around a cluster: the best, the best box, the best cylinder, a capsule.

    Args:
        piece: Points of the cluster, shape (n, 3).
        piece_weights: Weights of these points, shape (n,).
        outside: Points outside the solid, shape (m, 3).
        outside_weights: Weights of these points, shape (m,).
        capsules: Guess capsules, too.
    """
    guesses = around(piece, [np.eye(3)], capsules=capsules)
    points = np.concatenate([piece, outside])
    weights = np.concatenate([piece_weights, outside_weights])
    ious = overlaps(guesses, points, np.arange(len(points)) < len(piece), weights)
    kinds = guesses.kinds[:, 0]
    best = [
        int(np.argmax(np.where(allowed, ious, -1.0)))
        for allowed in (kinds >= 0, kinds == _BOX, kinds == _CYLINDER, kinds == _CAPSULE)
        if allowed.any()
    ]
    return guesses.take(np.array(best))


def _along(points: Array, R: Array) -> list[tuple[int, Array, Array, Array]]:
    """Return a box along the axes of ``R`` and a cylinder along each of them.

    Each guess is a kind, a centre, a rotation and half extents.
    """
    low, high = np.quantile(points @ R, (TRIM, 1 - TRIM), axis=0)
    centre, halves = R @ (low + high) / 2, np.maximum((high - low) / 2, _MIN_HALF_EXTENT)
    guesses = [(_BOX, centre, R, halves)]
    for to_z in _AXES_TO_Z:
        x, y, z = np.abs(to_z.T @ halves)
        radius = np.sqrt(x * y)
        guesses.append((_CYLINDER, centre, R @ to_z, np.array([radius, radius, z])))
    return guesses
