"""Search for the primitives of largest intersection over union (IoU) with a solid.

Initial guesses are improved by gradient ascent on a soft IoU; counted sample points decide.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, canonical
from morphgen.fitting.soft_iou import Candidates, ascend, covered, distances, overlaps
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import IDENTITY, normalize
from morphgen.processes import one_torch_thread
from morphgen.typing import Array

TRIM = 0.03
"""Share of a cloud's points outside of a guess at either end of an axis."""
MIN_POINTS = 8
"""Smallest number of points of a cluster."""
_NUM_CLUSTERS = (1, 2, 3)
"""Numbers of clusters of the uncovered points, each of which may get a further primitive."""
_MIN_HALF_EXTENT = 1e-3
"""Smallest half extent of a guess, relative to the solid's size."""
_BOX, _CYLINDER, _SPHERE = map(KINDS.index, ("box", "cylinder", "sphere"))
_AXES_TO_Z = (
    np.eye(3),
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
)
"""Rotations whose z axis is the z, x and y axis."""


def around(points: Array, axes: list[Array], *, sphere: bool = False) -> Candidates:
    """Return guesses of one primitive each around a point cloud.

    points: Points, shape (n, 3).
    axes: Rotations, shape (3, 3) each, whose axes boxes and cylinders follow, besides the
        principal axes of the points.
    """
    _, principal_axes = np.linalg.eigh(np.cov(points.T))
    principal_axes *= (1.0, 1.0, np.linalg.det(principal_axes))  # right-handed
    guesses = [guess for R in (*axes, principal_axes) for guess in _along(points, R)]
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
) -> Candidates | None:
    """Return guesses of ``k`` primitives: the best guess around each of ``k`` clusters.

    points: Points over the solid and its surroundings, shape (n, 3).
    inside: Points that are inside the solid, shape (n,).
    weights: Weights of the points, shape (n,).

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
            _best_of_each_kind(cloud[label == j], weights[inside][label == j], *outside)
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
) -> Candidates | None:
    """Return guesses with one more primitive, around a part of the solid that is not covered.

    points: Points over the solid and its surroundings, shape (n, 3).
    inside: Points that are inside the solid, shape (n,).
    weights: Weights of the points, shape (n,).

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
                more = _best_of_each_kind(*piece, *outside)
                rows.append(Candidates.join([fewer.take(np.zeros(len(more.kinds), int)), more]))
    return Candidates.stack(rows) if rows else None


def _best_of_each_kind(
    piece: Array, piece_weights: Array, outside: Array, outside_weights: Array
) -> Candidates:
    """Return guesses around a cluster: the best, the best box, the best cylinder.

    piece: Points of the cluster, shape (n, 3).
    piece_weights: Weights of these points, shape (n,).
    outside: Points outside the solid, shape (m, 3).
    outside_weights: Weights of these points, shape (m,).
    """
    guesses = around(piece, [np.eye(3)])
    points = np.concatenate([piece, outside])
    weights = np.concatenate([piece_weights, outside_weights])
    ious = overlaps(guesses, points, np.arange(len(points)) < len(piece), weights)
    kinds = guesses.kinds[:, 0]
    best = [
        int(np.argmax(np.where(allowed, ious, -1.0)))
        for allowed in (kinds >= 0, kinds == _BOX, kinds == _CYLINDER)
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


COARSE_POINTS = 2**11
"""Number of sample points of the first ascent."""
NEAR_POINTS, FAR_POINTS = 2**14, 2**12
"""Numbers of sample points close to the solid and further away."""
NEAR, FAR = 0.02, 0.35
"""Margins of their boxes around the bounding box, relative to the solid's size."""
NUM_CLUSTERINGS = 4
"""Number of clusterings from which the search for several primitives starts."""
NUM_REFINED = 2
"""Number of candidates that are refined on all sample points."""
DIGITS = 6
"""Decimals of dimensions and positions in metres; quaternions have three more."""


@dataclass(frozen=True)
class SampledSolid:
    """A solid as sample points in the frame and units of its smallest bounding box.

    In that frame a thin oblique solid is hit by as many points as one along the link's axes.
    """

    solid: Solid
    points: Array
    """Points over the solid and its surroundings [sizes of the solid], shape (n, 3), shuffled."""
    inside: NDArray[np.bool_]
    """Points that are inside the solid, shape (n,)."""
    weights: Array
    """Volume that each point represents, mean 1, shape (n,); sparse points weigh more."""

    R_link_box: Array
    """Axes of the smallest bounding box in the link frame, shape (3, 3)."""
    centre: Array
    """Centre of the smallest bounding box in the link frame [m], shape (3,)."""

    @cached_property
    def link_points(self) -> Array:
        """The points in the link frame [m]."""
        return np.asarray(self.points * self.solid.size @ self.R_link_box.T + self.centre)

    def shapes(self, candidates: Candidates, row: int) -> tuple[Shape, ...]:
        """Return one candidate as rounded shapes in the link frame."""
        size = self.solid.size
        R_box_primitive = Rotation.from_quat(candidates.quaternions[row], scalar_first=True)
        R_link_primitive = Rotation.from_matrix(self.R_link_box) * R_box_primitive
        shapes = []
        for kind, centre, quaternion, halves in zip(
            candidates.kinds[row],
            candidates.centres[row] * size @ self.R_link_box.T + self.centre,
            R_link_primitive.as_quat(scalar_first=True),
            np.round(candidates.halves[row] * size, DIGITS),
            strict=True,
        ):
            x, y, z = np.maximum(halves, 10.0**-DIGITS).tolist()
            geometry: Box | Cylinder | Sphere
            match KINDS[kind]:
                case "box":
                    geometry = Box((2 * x, 2 * y, 2 * z))
                case "cylinder":
                    geometry = Cylinder(x, 2 * z)
                case "sphere":
                    geometry = Sphere(x)
            a, b, c = np.round(centre, DIGITS).tolist()
            w, i, j, k = np.round(quaternion, DIGITS + 3).tolist()
            pose = Pose((a, b, c), normalize((w, i, j, k)))
            shapes.append(canonical(Shape(geometry, pose)))
        return tuple(shapes)


@dataclass(frozen=True)
class SearchResult:
    """The best primitives of a search."""

    shapes: tuple[Shape, ...]
    """Primitives in the link frame."""
    iou: float
    """Intersection over union on the sample points of the search."""
    candidate: Candidates
    """The same primitives in the frame of the search, one row."""


def sample_solid(solid: Solid, seed: int) -> SampledSolid:
    """Draw the sample points of a search."""
    T_box_link, extents = trimesh.bounds.oriented_bounds(solid.hull)
    T_link_box = np.linalg.inv(T_box_link)
    R_link_box, centre, extents = T_link_box[:3, :3], T_link_box[:3, 3], extents / solid.size
    near, far = extents / 2 + NEAR, extents / 2 + FAR
    rng = np.random.default_rng(seed)
    near_points = near * (2 * qmc.Sobol(3, rng=rng).random(NEAR_POINTS) - 1)
    far_points = far * (2 * qmc.Sobol(3, rng=rng).random(FAR_POINTS) - 1)
    far_points = far_points[np.any(np.abs(far_points) > near, axis=1)]
    points = np.concatenate([near_points, far_points])
    volumes = np.repeat(
        [np.prod(near) / NEAR_POINTS, np.prod(far) / FAR_POINTS],
        [len(near_points), len(far_points)],
    )
    order = rng.permutation(len(points))
    points, volumes = points[order], volumes[order]
    inside = solid.contains(points * solid.size @ R_link_box.T + centre)
    if inside[:COARSE_POINTS].sum() < 2 * MIN_POINTS:
        raise FitError(f"the solid is too thin: it fills {inside.mean():.2%} of its bounding box")
    return SampledSolid(solid, points, inside, volumes / volumes.mean(), R_link_box, centre)


def best_single(target: SampledSolid) -> SearchResult:
    """Return the single primitive of largest IoU."""
    with one_torch_thread():
        cloud = target.points[target.inside]
        start = around(cloud, [np.eye(3), target.R_link_box.T], sphere=True)
        return _refine(target, ascend_coarsely(target, start, target.weights, (0.03, 0.008)))


def best_several(target: SampledSolid, fewer: SearchResult, seed: int) -> SearchResult | None:
    """Return the primitives of largest IoU, one more than in an earlier result.

    Returns:
        The primitives; None if the solid has too few sample points for them.
    """
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS)]
    subset = slice(4 * COARSE_POINTS)
    cloud = target.points[subset], target.inside[subset], target.weights[subset]
    k = len(fewer.shapes) + 1
    with one_torch_thread():
        starts = (
            by_pieces(*cloud, k, seeds),
            by_growth(fewer.candidate, *cloud, seeds[0]),
        )
        guesses = [start for start in starts if start is not None]
        if not guesses:
            return None
        start = Candidates.stack(guesses)
        return _refine(target, ascend_coarsely(target, start, target.weights, (0.02, 0.006)))


def _refine(target: SampledSolid, coarse: Candidates) -> SearchResult:
    """Improve the best candidates on all points, and return the best one."""
    points, inside, weights = target.points, target.inside, target.weights
    order = np.argsort(-overlaps(coarse, points, inside, weights), kind="stable")
    fine = ascend_finely(target, coarse.take(order[:NUM_REFINED]), weights)
    ious = overlaps(fine, points, inside, weights)
    row = int(np.argmax(ious))
    return SearchResult(target.shapes(fine, row), float(ious[row]), fine.take(np.array([row])))


def ascend_coarsely(
    target: SampledSolid, start: Candidates, weights: Array, tau: tuple[float, float]
) -> Candidates:
    """Improve candidates on few sample points; see ``soft_iou.ascend`` for the arguments."""
    return ascend(
        start,
        target.points[:COARSE_POINTS],
        target.inside[:COARSE_POINTS],
        weights=weights[..., :COARSE_POINTS],
        num_steps=100,
        tau=tau,
        rate=(0.01, 0.003),
    )


def ascend_finely(target: SampledSolid, coarse: Candidates, weights: Array) -> Candidates:
    """Improve candidates on all sample points; see ``soft_iou.ascend`` for the arguments."""
    return ascend(
        coarse,
        target.points,
        target.inside,
        weights=weights,
        num_steps=60,
        tau=(0.006, 0.0015),
        rate=(0.004, 0.0004),
    )


NUM_SPHERE_CLUSTERINGS = 2
"""Number of clusterings from which the search starts; more bring next to nothing."""
EMPHASES = (6.0, 20.0, 100.0)
"""Weights of points inside, relative to points outside, of fits that must cover the solid; tuned on
the Panda and the UR5. The best one is larger the thinner the solid and the fewer the spheres."""
RESERVE = 0.2
"""Share of the volume that may stay uncovered by which a fit covers more than it must, because the
cover is counted on sample points."""
_TAU = (0.02, 0.006)
"""Softness of the membership in the first ascent [sizes of the solid]."""
_MIN_RADIUS = 1e-3
"""Smallest radius of a guess and after a change of all radii [sizes of the solid]."""


def best_spheres(target: SampledSolid, n: int, cover: float | None, seed: int) -> SearchResult:
    """Return the spheres of largest IoU."""
    seeds = np.random.SeedSequence(seed).generate_state(NUM_SPHERE_CLUSTERINGS + 1).tolist()
    emphases = (1.0,) if cover is None else EMPHASES
    judge = target if cover is None else sample_solid(target.solid, seeds[-1])
    with one_torch_thread():
        start, weights = _starts(target, n, seeds[:NUM_SPHERE_CLUSTERINGS], emphases)
        coarse = ascend_coarsely(target, start, weights, _TAU)
        ious = overlaps(*_judged(target, coarse, cover))
        best = np.array([np.argmax(ious)])
        fine = ascend_finely(target, coarse.take(best), weights[best])
        judged = _judged(judge, fine, cover)
        (iou,) = overlaps(*judged)
    final = judged[0]
    return SearchResult(target.shapes(final, 0), float(iou), final)


def _starts(
    target: SampledSolid, n: int, seeds: list[int], emphases: tuple[float, ...]
) -> tuple[Candidates, Array]:
    """Return guesses from every clustering for every emphasis, and their weights of the points."""
    cloud = target.points[target.inside][: 2 * COARSE_POINTS]
    centres = np.zeros((len(seeds), n, 3))
    radii = np.zeros((len(seeds), n))
    for row, seed in enumerate(seeds):
        with warnings.catch_warnings():
            # A cluster without points is a guess as good as any.
            warnings.filterwarnings("ignore", "One of the clusters is empty")
            centres[row], label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        squares = np.square(cloud - centres[row][label]).sum(axis=1)
        counts = np.maximum(np.bincount(label, minlength=n), 1)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radii[row] = np.sqrt(5 / 3 * np.bincount(label, squares, minlength=n) / counts)
    candidates = _spheres(centres, np.maximum(radii, _MIN_RADIUS))
    emphasis = np.repeat(emphases, len(seeds))[:, None]
    weights = np.where(target.inside, emphasis, 1.0) * target.weights
    return Candidates.stack([candidates] * len(emphases)), weights


def _spheres(centres: Array, radii: Array) -> Candidates:
    """Return candidates from centres (n, k, 3) and radii (n, k)."""
    shape = radii.shape
    return Candidates(
        np.full(shape, KINDS.index("sphere")),
        centres,
        np.broadcast_to(IDENTITY, (*shape, 4)).copy(),
        np.repeat(radii[..., None], 3, axis=2),
    )


def _judged(
    sample: SampledSolid, candidates: Candidates, cover: float | None
) -> tuple[Candidates, Array, NDArray[np.bool_], Array]:
    """Return candidates that cover a share of the sample's inside, and the sample's points.

    The radii of each candidate change by one length, up or down.

    Returns:
        The arguments of ``overlaps``.
    """
    points, inside, weights = sample.points, sample.inside, sample.weights
    if cover is not None:
        share = 1 - (1 - cover) * (1 - RESERVE)
        away = distances(candidates, points[inside])
        order = np.argsort(away, axis=1)
        covered = np.cumsum(weights[inside][order], axis=1) / weights[inside].sum()
        last = np.argmax(covered >= share, axis=1)
        change = np.take_along_axis(away, order, axis=1)[np.arange(len(away)), last]
        halves = np.maximum(candidates.halves + change[:, None, None], _MIN_RADIUS)
        candidates = replace(candidates, halves=halves)
    return candidates, points, inside, weights
