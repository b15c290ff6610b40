"""Search for the primitives of largest intersection over union (IoU) with a solid.

Initial guesses are improved by gradient ascent on a soft IoU, in rounds: the best go on with more
sample points. Counted points decide.

The membership of a point in a primitive is ``sigmoid(-distance / tau)``, so that the ratio of
volumes has a gradient; ``tau`` decreases during the ascent. The membership in a union is
``1 - prod(1 - membership)``, so overlaps count once. The distance is the largest of those beyond
the faces of a primitive. Many candidates, of one or several primitives each, are improved at once,
in NumPy: arrays are too small for the threads of a tensor library, whose import takes longer than
the fit of a link.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, canonical
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import IDENTITY, unit_quaternion, vec3
from morphgen.typing import Array

TRIM = 0.03  # share of a cloud's points outside of a guess at either end of an axis
MIN_POINTS = 8  # smallest number of points of a cluster
_NUM_CLUSTERS = (1, 2, 3)
"""Numbers of clusters of the uncovered points, each of which may get a further primitive."""
_MIN_HALF_EXTENT = 1e-3  # smallest half extent of a guess, relative to the solid's size
_BOX, _CYLINDER, _SPHERE = map(KINDS.index, ("box", "cylinder", "sphere"))
_AXES_TO_Z = (
    np.eye(3),
    np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]),
    np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
)
"""Rotations whose z axis is the z, x and y axis."""
COARSE_POINTS = 2**11  # number of sample points of the first ascent
NEAR_POINTS, FAR_POINTS = 2**14, 2**12
"""Numbers of sample points close to the solid and further away."""
NEAR, FAR = 0.02, 0.35
"""Margins of their boxes around the bounding box, relative to the solid's size."""
NUM_CLUSTERINGS = 4  # number of clusterings from which the search for several primitives starts
DIGITS = 6  # decimals of dimensions and positions in metres; quaternions have three more
NUM_SPHERE_CLUSTERINGS = 3  # number of clusterings from which the search for spheres starts
EMPHASES = (6.0, 20.0, 100.0)
"""Weights of points inside, relative to points outside, of fits that must cover the solid; tuned on
the Panda and the UR5. The best one is larger the thinner the solid and the fewer the spheres."""
RESERVE = 0.2
"""Share of the volume that may stay uncovered by which a fit covers more than it must, because the
cover is counted on sample points."""
_MIN_RADIUS = 1e-3
"""Smallest radius of a guess and after a change of all radii [sizes of the solid]."""
_MAX_DISTANCES = 2**18  # number of distances that are evaluated together; bounds memory
_MOMENTS = (0.8, 0.98)  # decay rates of Adam: a short memory, for less than 100 steps
_SMALL = 1e-12  # smallest distance from an axis or a centre, where its gradient is not finite


@dataclass(frozen=True)
class Cloud:
    """Sample points over a solid and its surroundings."""

    points: Array  # points, shape (n, 3)
    inside: NDArray[np.bool_]  # which points are inside the solid, shape (n,)
    weights: Array
    """Volume that each point represents, shape (n,); for an ascent also one per candidate."""

    def take(self, chosen: slice | NDArray[np.bool_]) -> Cloud:
        """Return some of the points."""
        return Cloud(self.points[chosen], self.inside[chosen], self.weights[..., chosen])


@dataclass(frozen=True)
class Candidates:
    """``n`` candidates of ``k`` primitives each."""

    kinds: NDArray[np.int64]  # indices into `KINDS`, shape (n, k)
    centres: Array  # centres, shape (n, k, 3)
    quaternions: Array  # rotations (w, x, y, z) of any norm, shape (n, k, 4)
    halves: Array
    """Half extents, shape (n, k, 3). A cylinder has its radius first and half its length third; a
    sphere's radius is the first."""

    def take(self, rows: NDArray[np.intp]) -> Candidates:
        """Return the candidates of some rows."""
        return Candidates(*(array[rows] for array in vars(self).values()))

    @staticmethod
    def stack(blocks: list[Candidates], axis: int = 0) -> Candidates:
        """Concatenate candidates, or with ``axis=1`` the primitives of every candidate i."""
        arrays = zip(*(vars(candidates).values() for candidates in blocks), strict=True)
        return Candidates(*(np.concatenate(array, axis=axis) for array in arrays))


@dataclass(frozen=True)
class Round:
    """One round of a search, in which the best candidates of the round before are improved."""

    candidates: int | None  # number of candidates; None for all
    points: int  # number of sample points
    steps: int  # number of steps of the gradient ascent
    tau: tuple[float, float]
    """Softness of the membership in the first and last step [sizes of the solid]."""
    rate: tuple[float, float]  # learning rate in the first and last step [sizes of the solid]


NUM_COUNTED = 2**13  # number of points that select candidates between rounds
_SAME = 0.01  # difference of centres and half extents up to which candidates are alike
ROUNDS = (
    Round(None, COARSE_POINTS, 40, (0.03, 0.008), (0.01, 0.003)),
    Round(2, NEAR_POINTS + FAR_POINTS, 60, (0.006, 0.0015), (0.004, 0.0004)),
)
"""Rounds of the search for one primitive, and for spheres."""
SEVERAL_ROUNDS = (replace(ROUNDS[0], tau=(0.02, 0.006)), replace(ROUNDS[1], candidates=4, steps=50))
"""Rounds of the search for several primitives, which has more and finer optima."""


def ascend(candidates: Candidates, cloud: Cloud, how: Round) -> Candidates:
    """Return the candidates after gradient ascent (Adam) on the soft IoU of one round."""
    n, k = candidates.kinds.shape
    rows = max(_MAX_DISTANCES // (k * len(cloud.points)), 1)
    if n > rows:
        batches = (np.arange(start, min(start + rows, n)) for start in range(0, n, rows))
        shared = cloud.weights.ndim == 1
        return Candidates.stack(
            [
                ascend(
                    candidates.take(batch),
                    cloud if shared else replace(cloud, weights=cloud.weights[batch]),
                    how,
                )
                for batch in batches
            ]
        )
    kinds = candidates.kinds.reshape(-1)
    rotations = Rotation.from_quat(candidates.quaternions.reshape(-1, 4), scalar_first=True)
    centres = candidates.centres.reshape(-1, 3)
    logs = np.log(candidates.halves.reshape(-1, 3))
    x = _homogeneous(cloud.points)
    weights = cloud.weights.astype(np.float32)
    within, beyond = np.where(cloud.inside, weights, 0), np.where(cloud.inside, 0, weights)
    volume = within.sum(axis=-1, dtype=np.float64)
    # One step of a rotation or of a logarithm moves the surface about as far as one of a centre.
    unit = np.ones((n * k, 9))
    unit[:, 3:] = np.exp(-logs.reshape(n, -1).mean(axis=1)).repeat(k)[:, None]
    mean, square = np.zeros((2, n * k, 9))
    for step in range(how.steps):
        progress = step / max(how.steps - 1, 1)
        tau, rate = (a * (b / a) ** progress for a, b in (how.tau, how.rate))
        R, halves = rotations.as_matrix(), np.exp(logs)
        local, extents, away = _beyond(x, kinds, R, centres, halves)
        distance = away.max(axis=1)
        with np.errstate(over="ignore"):  # far away the membership is zero
            member = 1 / (1 + np.exp(distance * np.float32(1 / tau)))
        member = member.reshape(n, k, -1)
        spared = (1 - member).prod(axis=1)
        held = 1 - spared
        both = (held * within).sum(axis=1, dtype=np.float64)
        either = volume + (held * beyond).sum(axis=1, dtype=np.float64)
        # The slopes of the IoU along the membership, then along the distances of the primitives.
        slope = _column(both / either**2 / tau) * beyond - _column(1 / either / tau) * within
        member *= (slope * spared)[:, None]
        by_face = (away == distance[:, None]) * member.reshape(n * k, 1, -1)
        by_log = -by_face.sum(axis=2) * halves
        local *= by_face
        local /= extents
        # Sums over the points of the slopes along local coordinates: times points, and alone.
        moments = (local @ x.T).astype(np.float64)
        times_points, pushed = moments[:, :, :3] @ R, moments[:, :, 3:]
        by_centre = -(R @ pushed)[:, :, 0]
        times_local = times_points - pushed * (centres[:, None] @ R)
        by_angle = (times_local - times_local.transpose(0, 2, 1))[:, (1, 2, 0), (2, 0, 1)]
        gradient = np.concatenate([by_centre, by_angle, by_log], axis=1)
        mean += (1 - _MOMENTS[0]) * (gradient - mean)
        square += (1 - _MOMENTS[1]) * (gradient**2 - square)
        means, squares = (
            moment / (1 - decay ** (step + 1))
            for moment, decay in zip((mean, square), _MOMENTS, strict=True)
        )
        change = rate * unit * means / (np.sqrt(squares) + 1e-8)
        centres = centres + change[:, :3]
        rotations = rotations * Rotation.from_rotvec(change[:, 3:6])
        logs = logs + change[:, 6:]
    return Candidates(
        candidates.kinds,
        centres.reshape(n, k, 3),
        rotations.as_quat(scalar_first=True).reshape(n, k, 4),
        np.exp(logs).reshape(n, k, 3),
    )


def _column(values: Array) -> NDArray[np.float32]:
    return values.astype(np.float32)[:, None]


def overlaps(candidates: Candidates, cloud: Cloud) -> Array:
    """Return the IoU of each candidate by counting points, shape (n,)."""
    held = covered(candidates, cloud.points)
    both, outside = (
        np.where(held & which, cloud.weights, 0.0).sum(axis=1)
        for which in (cloud.inside, ~cloud.inside)
    )
    volume = (cloud.weights * cloud.inside).sum(axis=-1)
    return np.asarray(both / np.maximum(volume + outside, 1e-12))


def covered(candidates: Candidates, points: Array) -> NDArray[np.bool_]:
    """Return which points (m, 3) are inside any primitive of each candidate, shape (n, m)."""
    return _distances(candidates, points) <= 0


def _distances(candidates: Candidates, points: Array) -> NDArray[np.float32]:
    """Return distances of points (m, 3) from each candidate, (n, m), negative inside."""
    n, k = candidates.kinds.shape
    x = _homogeneous(points)
    rotations = Rotation.from_quat(candidates.quaternions.reshape(-1, 4), scalar_first=True)
    R = rotations.as_matrix().reshape(n, k, 3, 3)
    block = max(_MAX_DISTANCES // k, 1)
    distances = np.empty((n, len(points)), np.float32)
    for row in range(n):
        one = (candidates.kinds[row], R[row], candidates.centres[row], candidates.halves[row])
        for start in range(0, len(points), block):
            *_, away = _beyond(x[:, start : start + block], *one)
            distances[row, start : start + block] = away.max(axis=1).min(axis=0)
    return distances


def _homogeneous(points: Array) -> NDArray[np.float32]:
    """Return points (m, 3) with a fourth coordinate of one, shape (4, m)."""
    return np.concatenate([points.T, np.ones((1, len(points)))]).astype(np.float32)


def _beyond(
    x: NDArray[np.float32], kinds: NDArray[np.int64], R: Array, centres: Array, halves: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return points (4, m) in the frames of primitives (p, 3, m), and distances beyond their faces.

    Those in the first two rows of a cylinder are equal; of spheres alone there is one row.
    """
    inverse = R.transpose(0, 2, 1)
    local = np.concatenate([inverse, -inverse @ centres[:, :, None]], axis=2).astype(np.float32) @ x
    size = halves.astype(np.float32)[:, :, None]
    if (kinds == _SPHERE).all():
        extents = _radial(local)
        return local, extents, extents - size[:, :1]
    extents = np.maximum(np.abs(local), np.float32(_SMALL))
    for kind, axes in ((_CYLINDER, 2), (_SPHERE, 3)):
        rows = np.flatnonzero(kinds == kind)
        if len(rows):
            extents[rows, :axes] = _radial(local[rows, :axes])
    return local, extents, extents - size


def _radial(local: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return distances from an axis or a centre, shape (p, 1, m)."""
    squares = np.square(local).sum(axis=1, keepdims=True)
    return np.asarray(np.maximum(np.sqrt(squares), np.float32(_SMALL)))


def around(points: Array, axes: list[Array], *, sphere: bool = False) -> Candidates:
    """Return guesses of one primitive each around points, shape (n, 3).

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
    kinds, centres, rotations, halves = (np.array(part) for part in zip(*guesses, strict=True))
    quaternions = Rotation.from_matrix(rotations).as_quat(scalar_first=True)
    return Candidates(kinds[:, None], centres[:, None], quaternions[:, None], halves[:, None])


def by_pieces(cloud: Cloud, k: int, seeds: list[int]) -> Candidates | None:
    """Return guesses of ``k`` primitives: the best around each of ``k`` clusters; or None."""
    inside, outside = cloud.take(cloud.inside), cloud.take(~cloud.inside)
    rows: list[Candidates] = []
    for seed in seeds:
        _, label = kmeans2(inside.points, k, minit="++", seed=seed, iter=10)
        if np.bincount(label, minlength=k).min() >= MIN_POINTS:
            pieces = (inside.take(label == j) for j in range(k))
            rows.append(Candidates.stack([_best_of_each_kind(p, outside) for p in pieces], axis=1))
    return Candidates.stack(rows) if rows else None


def by_growth(fewer: Candidates, cloud: Cloud, seed: int) -> Candidates | None:
    """Return guesses with one more primitive where the solid is not covered; or None."""
    outside = cloud.take(~cloud.inside)
    missed = cloud.take(cloud.inside & ~covered(fewer, cloud.points)[0])
    rows: list[Candidates] = []
    for n in _NUM_CLUSTERS:
        if len(missed.points) < n * MIN_POINTS:
            break
        _, label = kmeans2(missed.points, n, minit="++", seed=seed, iter=10)
        for j in range(n):
            if np.count_nonzero(label == j) >= MIN_POINTS:
                more = _best_of_each_kind(missed.take(label == j), outside)
                repeated = fewer.take(np.zeros(len(more.kinds), int))
                rows.append(Candidates.stack([repeated, more], axis=1))
    return Candidates.stack(rows) if rows else None


def _best_of_each_kind(piece: Cloud, outside: Cloud) -> Candidates:
    """Return guesses around a cluster inside the solid: the best, and the best of two kinds."""
    guesses = around(piece.points, [np.eye(3)])
    pairs = zip(vars(piece).values(), vars(outside).values(), strict=True)
    ious = overlaps(guesses, Cloud(*(np.concatenate(pair) for pair in pairs)))
    kinds = guesses.kinds[:, 0]
    allowed = (kinds >= 0, kinds == _BOX, kinds == _CYLINDER)
    best = [int(np.argmax(np.where(rows, ious, -1.0))) for rows in allowed]
    return guesses.take(np.array(best))


def _along(points: Array, R: Array) -> list[tuple[int, Array, Array, Array]]:
    """Return guesses along the axes of ``R``: a box and three cylinders."""
    low, high = np.quantile(points @ R, (TRIM, 1 - TRIM), axis=0)
    centre, halves = R @ (low + high) / 2, np.maximum((high - low) / 2, _MIN_HALF_EXTENT)
    guesses = [(_BOX, centre, R, halves)]
    for to_z in _AXES_TO_Z:
        x, y, z = np.abs(to_z.T @ halves)
        radius = np.sqrt(x * y)
        guesses.append((_CYLINDER, centre, R @ to_z, np.array([radius, radius, z])))
    return guesses


@dataclass(frozen=True)
class SampledSolid(Cloud):
    """A solid as shuffled sample points in the frame and units of its smallest bounding box.

    There a thin oblique solid is hit by as many points. Sparse ones weigh more; the mean is 1.
    """

    solid: Solid
    R_link_box: Array  # axes of the smallest bounding box in the link frame, shape (3, 3)
    centre: Array  # centre of the smallest bounding box in the link frame [m], shape (3,)

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
            geometries = (Box((2 * x, 2 * y, 2 * z)), Cylinder(x, 2 * z), Sphere(x))
            position = vec3(np.round(centre, DIGITS).tolist())
            pose = Pose(position, unit_quaternion(np.round(quaternion, DIGITS + 3).tolist()))
            shapes.append(canonical(Shape(geometries[kind], pose)))  # in the order of KINDS
        return tuple(shapes)


@dataclass(frozen=True)
class SearchResult:
    """The best primitives of a search."""

    shapes: tuple[Shape, ...]  # primitives in the link frame
    iou: float  # intersection over union on the sample points of the search
    candidate: Candidates  # the same primitives in the frame of the search, one row


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
    order = rng.permutation(len(points))  # so that the first n are a sample of all
    points, volumes = points[order], volumes[order]
    inside = solid.contains(points * solid.size @ R_link_box.T + centre)
    if inside[:COARSE_POINTS].sum() < 2 * MIN_POINTS:
        raise FitError(f"the solid is too thin: it fills {inside.mean():.2%} of its bounding box")
    return SampledSolid(points, inside, volumes / volumes.mean(), solid, R_link_box, centre)


def best_single(target: SampledSolid) -> SearchResult:
    """Return the single primitive of largest IoU."""
    cloud = target.points[target.inside]
    guesses = around(cloud, [np.eye(3), target.R_link_box.T], sphere=True)
    return _search(target, guesses, ROUNDS)


def best_several(target: SampledSolid, fewer: SearchResult, seed: int) -> SearchResult | None:
    """Return primitives of largest IoU, one more than in an earlier result; or None."""
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS)]
    cloud = target.take(slice(4 * COARSE_POINTS))
    starts = (
        by_pieces(cloud, len(fewer.shapes) + 1, seeds),
        by_growth(fewer.candidate, cloud, seeds[0]),
    )
    guesses = [start for start in starts if start is not None]
    return _search(target, Candidates.stack(guesses), SEVERAL_ROUNDS) if guesses else None


def best_spheres(target: SampledSolid, n: int, cover: float | None, seed: int) -> SearchResult:
    """Return the spheres of largest IoU, of those that cover a share of the solid if given."""
    seeds = np.random.SeedSequence(seed).generate_state(NUM_SPHERE_CLUSTERINGS + 1).tolist()
    emphases = (1.0,) if cover is None else EMPHASES
    # Spheres are chosen for points that did not shape them, or they would cover less of others.
    judge = target if cover is None else sample_solid(target.solid, seeds[-1])
    start, weights = _starts(target, n, seeds[:NUM_SPHERE_CLUSTERINGS], emphases)
    return _search(target, start, ROUNDS, weights, cover, judge)


def _search(
    target: SampledSolid,
    guesses: Candidates,
    rounds: tuple[Round, ...],
    weights: Array | None = None,
    cover: float | None = None,
    judge: SampledSolid | None = None,
) -> SearchResult:
    """Improve guesses in rounds, and return the best.

    ``weights`` of points may differ by guess; candidates are changed to ``cover`` a share of the
    solid; ``judge`` are points that the last round is counted on.
    """
    best = np.arange(len(guesses.kinds))
    for how in rounds:
        best = best[: how.candidates]
        some = target.take(slice(how.points))
        if weights is not None:
            weights = weights[best]
            some = replace(some, weights=weights[:, : how.points])
        guesses = ascend(guesses.take(best), some, how)
        counted = target.take(slice(NUM_COUNTED))
        if how is rounds[-1]:
            counted = judge or target
        final = _covering(counted, guesses, cover)
        ious = overlaps(final, counted)
        best = _distinct(guesses, ious)
    row = int(best[0])
    return SearchResult(target.shapes(final, row), float(ious[row]), final.take(best[:1]))


def _distinct(candidates: Candidates, ious: Array) -> NDArray[np.intp]:
    """Return the candidates from the best to the worst, of those that are alike only the best."""
    order = np.argsort(-ious, kind="stable")
    places = np.concatenate([candidates.centres, np.sort(candidates.halves, axis=2)], axis=2)
    kept: list[int] = []
    for i in order.tolist():
        alike = np.abs(places[kept] - places[i]).max(axis=(1, 2)) < _SAME
        if not (alike & (candidates.kinds[kept] == candidates.kinds[i]).all(axis=1)).any():
            kept.append(i)
    return np.array(kept)


def _starts(
    target: SampledSolid, n: int, seeds: list[int], emphases: tuple[float, ...]
) -> tuple[Candidates, Array]:
    """Return guesses from every clustering for every emphasis, and their weights of the points."""
    cloud = target.points[target.inside][: 2 * COARSE_POINTS]
    shape = (len(seeds), n)
    centres, radii = np.zeros((*shape, 3)), np.zeros(shape)
    for row, seed in enumerate(seeds):
        with warnings.catch_warnings():
            # A cluster without points is a guess as good as any.
            warnings.filterwarnings("ignore", "One of the clusters is empty")
            centres[row], label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        squares = np.square(cloud - centres[row][label]).sum(axis=1)
        counts = np.maximum(np.bincount(label, minlength=n), 1)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radii[row] = np.sqrt(5 / 3 * np.bincount(label, squares, minlength=n) / counts)
    candidates = Candidates(
        np.full(shape, _SPHERE),
        centres,
        np.broadcast_to(IDENTITY, (*shape, 4)).copy(),
        np.repeat(np.maximum(radii, _MIN_RADIUS)[..., None], 3, axis=2),
    )
    emphasis = np.repeat(emphases, len(seeds))[:, None]
    weights = np.where(target.inside, emphasis, 1.0) * target.weights
    return Candidates.stack([candidates] * len(emphases)), weights


def _covering(cloud: Cloud, candidates: Candidates, cover: float | None) -> Candidates:
    """Return candidates that cover a share of the solid: the radii change by one length each."""
    if cover is None:
        return candidates
    share = 1 - (1 - cover) * (1 - RESERVE)
    away = _distances(candidates, cloud.points[cloud.inside]).astype(np.float64)
    order = np.argsort(away, axis=1)
    weights = cloud.weights[cloud.inside]
    last = np.argmax(np.cumsum(weights[order], axis=1) / weights.sum() >= share, axis=1)
    change = np.take_along_axis(away, order, axis=1)[np.arange(len(away)), last]
    halves = np.maximum(candidates.halves + change[:, None, None], _MIN_RADIUS)
    return replace(candidates, halves=halves)
