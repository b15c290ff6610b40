"""Enclose points in the box, cylinder or sphere of least volume, and a solid in several of them.

Only the vertices of the convex hull matter. The sphere, and the circle around a cylinder's cross
section, are exact (Gaertner, "Fast and robust smallest enclosing balls", 1999). The volume
of a box or cylinder is a function of its rotation with many kinks and local minima (O'Rourke,
"Finding minimal enclosing boxes", 1985). Rotations all over the sphere and along the faces of the
hull are evaluated first. The best are refined by a pattern search, which also rotates about one
axis at a time to keep a side flush with a face of the hull.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, Kind, least_rotation, rounded
from morphgen.fitting.quality import signed_distance
from morphgen.fitting.search import SampledSolid
from morphgen.model import rotation
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere, volume
from morphgen.model.mesh import is_flat
from morphgen.typing import Array

_DECIMALS = 6  # decimals of dimensions and positions [m]
_SLACK = 1e-10  # shortfall of a dimension that is not rounded up [m]
_NUM_DIRECTIONS = 400  # number of axis directions over the half sphere that are evaluated
_NUM_FEATURES = 200
"""Number of normals of the hull's largest faces, and of its longest edges, that are evaluated."""
_SAME_MINIMUM = math.cos(math.radians(4))
"""Cosine of the angle between axes below which two rotations lead to the same minimum."""
_FIRST_STEP, _SHRINK = 0.05, 0.6
"""Largest rotation of the first step [rad], and its factor after a step without improvement."""
_MIN_GAIN = 1e-9  # smallest relative improvement of the volume that counts
_LINK_AXES_EXCESS = 1e-5  # relative excess of volume up to which the link's own axes are preferred
_MAX_PRODUCTS = 100_000
"""Number of points times rotations that are evaluated together; bounds memory."""
_ON_BALL = 1e-12
"""Relative excess of the squared distance below which a point counts as on the ball."""
_MAX_PIVOTS = 100  # largest number of points that are added to the support of a ball
NUM_CLUSTERINGS = 3
"""Number of partitions of a solid that are tried for each number of primitives."""
_MAX_GROWTHS = 20
"""Largest number of times that primitives are enlarged to contain the points left outside."""


def enclose(points: Array, kinds: Collection[Kind] = KINDS) -> Shape:
    """Return the box, cylinder or sphere of least volume that contains all points.

    The pose is rounded (1 um, 9 decimals of the quaternion) before the dimensions are measured and
    rounded up to 1 um, so no point is more than 1e-9 m outside.

    points: Points in the link frame [m], shape (n, 3).
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have the shape {points.shape}; expected (n, 3)")
    points = np.asarray(points, dtype=np.float64)
    if not np.isfinite(points).all():
        raise FitError("the points are not finite")
    if is_flat(points):
        distinct = len(np.unique(points, axis=0))
        if distinct < 4:
            raise FitError(f"only {distinct} points are distinct: nothing to enclose")
        raise FitError("the points are flat: they have no volume")
    hull = _hull(points)
    enclosing = [_enclose(kind, hull, points) for kind in KINDS if kind in kinds]
    return Shape(*min(enclosing, key=lambda shape: volume(shape[0])))


@dataclass(frozen=True)
class _Hull:
    """Vertices of a convex hull along the link's axes, centred and scaled to a box of size 1."""

    all_points: Array  # all vertices, shape (n, 3)
    many_points: Array
    """Vertices that are outermost in 2000 directions: enough for the end of the search."""
    few_points: Array
    """Vertices that are outermost in 400 directions: enough for the beginning of the search."""
    directions: Array
    """Normals of the largest faces, the longest edges and the principal axes, shape (k, 3)."""


def _hull(points: Array) -> _Hull:
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - (low + high) / 2) / (high - low).max()
    hull = ConvexHull(unit)
    triangles = unit[hull.simplices]
    edges = triangles[:, [1, 2, 0]] - triangles
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    edges = edges.reshape(-1, 3)
    lengths = np.linalg.norm(edges, axis=1)
    all_points = unit[hull.vertices]
    directions = [
        _heaviest(hull.equations[:, :3], areas),
        _heaviest(edges / lengths[:, None], lengths),
        np.linalg.svd(all_points - all_points.mean(axis=0), full_matrices=False)[2],
    ]
    many_points = _outermost(all_points, 5 * _NUM_DIRECTIONS)
    few_points = _outermost(many_points, _NUM_DIRECTIONS)
    return _Hull(all_points, many_points, few_points, np.concatenate(directions))


def _heaviest(directions: Array, weights: Array) -> Array:
    """Return the directions of largest weight; directions that are nearly equal count as one."""
    # A direction and its opposite are the same axis.
    directions = np.where(directions @ [1, 1e-3, 1e-6] < 0, -directions.T, directions.T).T
    _, first, group = np.unique(directions.round(3), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(-np.bincount(group.ravel(), weights), kind="stable")
    return np.asarray(directions[first[order[:_NUM_FEATURES]]])


def _outermost(points: Array, n: int) -> Array:
    """Return the points that are first or last in any of ``n`` directions, or all if few."""
    if len(points) <= n:
        return points
    outermost = np.zeros(len(points), dtype=bool)
    for batch in np.array_split(_half_sphere(n), n * len(points) // (10 * _MAX_PRODUCTS) + 1):
        along = batch @ points.T
        outermost[along.argmin(axis=1)] = outermost[along.argmax(axis=1)] = True
    return points[outermost]


def _half_sphere(n: int) -> Array:
    """Return directions spread evenly over half the sphere (Fibonacci lattice), shape (n, 3)."""
    z = (np.arange(n) + 0.5) / n
    angle = math.pi * (1 + math.sqrt(5)) * np.arange(n)  # multiples of the golden angle
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _enclose(kind: Kind, hull: _Hull, points: Array) -> tuple[Box | Cylinder | Sphere, Pose]:
    """Return the primitive of one kind of least volume, measured after its pose is rounded."""
    quaternion = rotation.IDENTITY
    if kind != "sphere":
        quaternion = least_rotation(kind, _best_rotation(_SEARCHES[kind], hull))
    quaternion = rounded(quaternion)
    R = Pose(quaternion=quaternion).matrix[:3, :3]
    x, y, z = (R @ _centre(kind, points @ R)).round(_DECIMALS).tolist()
    pose = Pose((x + 0.0, y + 0.0, z + 0.0), quaternion)  # adding zero turns -0.0 into 0.0
    local = (points - pose.position) @ R
    if kind == "sphere":
        return Sphere(_round_up(np.linalg.norm(local, axis=1).max())), pose
    x, y, z = (_round_up(2 * half) for half in np.abs(local).max(axis=0).tolist())
    if kind == "box":
        return Box((x, y, z)), pose
    return Cylinder(_round_up(np.linalg.norm(local[:, :2], axis=1).max()), z), pose


def _centre(kind: Kind, points: Array) -> Array:
    """Return the centre of the least primitive along the axes of the points, shape (3,)."""
    if kind == "sphere":
        return np.asarray(smallest_balls(points.T[None])[0][0])
    centre: Array = (points.min(axis=0) + points.max(axis=0)) / 2
    if kind == "cylinder":
        centre[:2] = smallest_balls(points.T[None, :2])[0][0]
    return centre


def _round_up(length: float) -> float:
    return float(math.ceil((length - _SLACK) * 10**_DECIMALS) / 10**_DECIMALS)


def _box_volumes(points: Array) -> Array:
    """Return the volumes of boxes along the axes of points, shape (n, 3, m)."""
    return np.asarray(np.ptp(points, axis=2).prod(axis=1))


def _cylinder_volumes(points: Array) -> Array:
    """Return the volumes of cylinders along the z axis of points, shape (n, 3, m)."""
    _, radii = smallest_balls(points[:, :2])
    return np.asarray(math.pi * radii**2 * np.ptp(points[:, 2], axis=1))


@dataclass(frozen=True)
class _Search:
    """How the rotation of least volume is searched for."""

    volumes: Callable[[Array], Array]
    """Volumes around points given along the axes of ``n`` rotations, shape (n, 3, m)."""
    axes: slice  # columns of a rotation that change the volume
    dof: int  # number of axes that a rotation is varied about, the first ones
    spins: Array  # rotations about z that are evaluated with every direction, shape (s, 3, 3)
    num_starts: int  # number of rotations that are refined
    num_moves: int  # number of small rotations that are tried per step and start
    num_steps: int  # number of steps of the pattern search

    def measure(self, rotations: Array, points: Array) -> Array:
        """Return the volumes of rotations, shape (n,), in batches."""
        axes = rotations.swapaxes(1, 2)
        batches = np.array_split(axes, len(axes) * len(points) // _MAX_PRODUCTS + 1)
        return np.concatenate([self.volumes(batch @ points.T) for batch in batches])


def _spins(n: int) -> Array:
    """Return ``n`` rotations about z, evenly over a quarter turn, shape (n, 3, 3)."""
    rotation_vectors = np.zeros((n, 3))
    rotation_vectors[:, 2] = np.arange(n) * math.pi / 2 / n
    return np.asarray(Rotation.from_rotvec(rotation_vectors).as_matrix())


_SEARCHES: dict[Kind, _Search] = {
    "box": _Search(
        _box_volumes,
        slice(0, 3),
        dof=3,
        spins=_spins(30),
        num_starts=24,
        num_moves=30,
        num_steps=40,
    ),
    "cylinder": _Search(
        _cylinder_volumes,
        slice(2, 3),
        dof=2,
        spins=_spins(1),
        num_starts=12,
        num_moves=16,
        num_steps=24,
    ),
}


def _best_rotation(search: _Search, hull: _Hull) -> Array:
    """Return the rotation of least volume, shape (3, 3); near ties go to the link's axes."""
    directions = np.concatenate([np.eye(3), hull.directions, _half_sphere(_NUM_DIRECTIONS)])
    starts = (_frames(directions)[:, None] @ search.spins).reshape(-1, 3, 3)
    best = _distinct(starts, search.measure(starts, hull.few_points), search)
    coarse, volumes = _descend(starts[best], hull.few_points, search, search.num_steps)
    coarse = coarse[np.argsort(volumes, kind="stable")[: search.num_starts // 3]]
    fine, _ = _descend(coarse, hull.many_points, search, search.num_steps // 2)
    rotations = np.concatenate([_frames(np.eye(3)), fine])
    volumes = search.measure(rotations, hull.all_points)
    return np.asarray(rotations[np.argmax(volumes <= volumes.min() * (1 + _LINK_AXES_EXCESS))])


def _frames(z: Array) -> Array:
    """Return rotations with given z axes, shape (n, 3, 3)."""
    aside = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(aside, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _distinct(rotations: Array, volumes: Array, search: _Search) -> NDArray[np.intp]:
    """Return the indices of the best rotations whose axes differ, best first."""
    kept: list[int] = []
    for i in np.argsort(volumes, kind="stable").tolist():
        axes = rotations[i][:, search.axes]
        alike = np.abs(axes.T @ rotations[kept][:, :, search.axes]).max(axis=2)
        if not (alike.min(axis=1) > _SAME_MINIMUM).any():
            kept.append(i)
        if len(kept) == search.num_starts:
            break
    return np.array(kept)


def _descend(
    rotations: Array, points: Array, search: _Search, num_steps: int
) -> tuple[Array, Array]:
    """Rotate towards less volume (pattern search); return the rotations and their volumes."""
    rng = np.random.default_rng(0)
    volumes = search.measure(rotations, points)
    step = np.full(len(rotations), _FIRST_STEP)
    rows = np.arange(len(rotations))
    for _ in range(num_steps):
        vectors = np.zeros((search.num_moves, 3))
        vectors[:, : search.dof] = rng.uniform(-1, 1, (search.num_moves, search.dof))
        # Half of the moves are about one axis, which keeps a side flush with a face of the hull.
        half = np.arange(search.num_moves // 2)
        vectors[half] *= np.eye(3)[half % search.dof]
        moves = Rotation.from_rotvec((step[:, None, None] * vectors).reshape(-1, 3)).as_matrix()
        moved = rotations[:, None] @ moves.reshape(-1, search.num_moves, 3, 3)
        candidates = search.measure(moved.reshape(-1, 3, 3), points).reshape(-1, search.num_moves)
        best = candidates.argmin(axis=1)
        better = candidates[rows, best] < volumes * (1 - _MIN_GAIN)
        rotations = np.where(better[:, None, None], moved[rows, best], rotations)
        volumes = np.where(better, candidates[rows, best], volumes)
        step = np.where(better, step, step * _SHRINK)
    return rotations, volumes


def smallest_balls(points: Array) -> tuple[Array, Array]:
    """Return centres (n, d) and radii (n,) of the smallest balls around sets of points (n, d, m).

    The farthest point outside is added to the support of a ball until no point is outside.
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
    """Return the smallest balls around points (n, d, d + 1) with the origin on their boundary.

    These are centres (n, d), squared radii (n,), infinite where there is no such ball, and indices
    of the points on the boundary (n, d), some repeated.
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


def enclose_solid(
    target: SampledSolid, max_primitives: int, iou: float, seed: int
) -> tuple[Shape, ...]:
    """Return primitives that contain a solid with little excess volume.

    One primitive is the one of least volume. For several, the solid is cut along the bisecting
    planes between cluster centres, and each piece is enclosed; the best of ``NUM_CLUSTERINGS``
    partitions is kept. The number of primitives is the smallest that reaches ``iou``, or the best.
    """
    best: tuple[Shape, ...] = (enclose(np.asarray(target.solid.mesh.vertices)),)
    best_iou = _iou(best, target)
    for k in range(2, max_primitives + 1):
        if best_iou >= iou:
            break
        # Seeds depend on k, so that a search for more primitives begins with the same ones.
        for child in np.random.SeedSequence([seed, k]).generate_state(NUM_CLUSTERINGS):
            shapes = _enclose_clusters(target, k, int(child))
            if shapes and (shapes_iou := _iou(shapes, target)) > best_iou:
                best, best_iou = shapes, shapes_iou
    return best


def _enclose_clusters(target: SampledSolid, k: int, seed: int) -> tuple[Shape, ...]:
    """Return a primitive around each of ``k`` pieces; empty if a piece is flat or empty."""
    inside = target.link_points[target.inside]
    centres, _ = kmeans2(inside, k, minit="++", seed=seed, iter=10)
    pieces = [_cut(target.solid.mesh, centres, i) for i in range(k)]
    try:
        shapes = [enclose(piece) for piece in pieces]
        for _ in range(_MAX_GROWTHS):
            # The surface of each piece is enclosed, but its interior may reach beyond the cuts.
            missed = inside[signed_distance(shapes, inside) > 0]
            if not len(missed):
                return tuple(shapes)
            nearest = np.argmin(np.linalg.norm(missed[:, None] - centres, axis=2), axis=1)
            for i in np.unique(nearest).tolist():
                pieces[i] = np.concatenate([pieces[i], missed[nearest == i]])
                shapes[i] = enclose(pieces[i])
    except FitError:
        return ()
    return ()


def _cut(mesh: trimesh.Trimesh, centres: Array, i: int) -> Array:
    """Return the vertices of the part of a mesh that is nearest to centre ``i``."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for j in range(len(centres)):
        if j == i or not len(faces):
            continue
        vertices, faces, _ = trimesh.intersections.slice_faces_plane(
            vertices,
            faces,
            plane_normal=centres[i] - centres[j],
            plane_origin=(centres[i] + centres[j]) / 2,
        )
    return np.asarray(vertices[np.unique(faces)]) if len(faces) else np.zeros((0, 3))


def _iou(shapes: tuple[Shape, ...], target: SampledSolid) -> float:
    held, inside = signed_distance(shapes, target.link_points) <= 0, target.inside
    return float(target.weights[held & inside].sum() / target.weights[held | inside].sum())
