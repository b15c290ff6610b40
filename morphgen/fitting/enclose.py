"""The least box, cylinder or sphere around points.

Only the corners of the convex hull count. The sphere and the circle around a cylinder's section are
exact (pivoting on the farthest point, as in Gaertner, "Fast and robust smallest enclosing balls",
1999). The volume of a box or cylinder is a function of its rotation with many kinks and local
minima (O'Rourke, "Finding minimal enclosing boxes", 1985), so rotations all over the sphere and
along the faces of the hull are tried at once and the best are refined by a pattern search that
also turns about one axis at a time, which keeps a side flush with a face.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from morphgen.errors import FitError
from morphgen.fitting.bounding_balls import smallest_balls
from morphgen.fitting.canonical import KINDS, Kind, least_rotation, rounded
from morphgen.model import rotation
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere, volume
from morphgen.model.mesh import is_flat
from morphgen.model.rotation import Quat
from morphgen.typing import Array

_DECIMALS = 6
"""Of dimensions and positions in metres."""
_SLACK = 1e-10
"""How far a dimension may fall short before it is rounded up, metres."""
_DIRECTIONS = 400
"""Directions all over the half sphere that are tried."""
_FEATURES = 200
"""Normals of the hull's largest faces that are tried, and as many of its longest edges."""
_APART = math.cos(math.radians(4))
"""Cosine of the angle between axes below which two rotations lead to the same minimum."""
_REACH, _SHRINK = 0.05, 0.6
"""Largest turn of the first step, radians, and its factor after a step that found nothing."""
_GAIN = 1e-9
"""Relative improvement below which a step has found nothing."""
_SIMPLER = 1e-5
"""Relative excess of volume at which the link's own axes are preferred."""
_BUNCH = 100_000
"""Points times rotations that are evaluated together; bounds memory."""


def enclose(points: Array, kinds: Collection[Kind] = KINDS) -> Shape:
    """The box, cylinder or sphere of least volume that holds all points.

    Dimensions are rounded up to 1 um and the pose is rounded (1 um, 9 decimals of the quaternion)
    before they are measured, so no point is more than 1e-9 m outside.

    Args:
        points: Shape (n, 3), link frame, metres.
        kinds: What to choose from; of equal volumes the first of ``KINDS`` is taken.

    Returns:
        The primitive and its pose on the link; the axes of a box are the nearest to the link's.

    Raises:
        FitError: If points are not finite, flat, or fewer than four are distinct.
        ValueError: If ``points`` is not (n, 3), or ``kinds`` is empty or unknown.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points are {points.shape}, not (n, 3)")
    if not kinds or not set(kinds) <= set(KINDS):
        raise ValueError(f"kinds are {tuple(kinds)}; valid: some of {', '.join(KINDS)}")
    points = np.asarray(points, dtype=np.float64)
    _check_solid(points)
    corners = _corners(points)
    least = [_around(kind, corners, points) for kind in KINDS if kind in kinds]
    return Shape(*min(least, key=lambda found: volume(found[0])))


def _check_solid(points: Array) -> None:
    if not np.isfinite(points).all():
        raise FitError("the points are not finite")
    if not is_flat(points):
        return
    distinct = len(np.unique(points, axis=0))
    if distinct < 4:
        raise FitError(f"only {distinct} points are distinct: nothing to enclose")
    raise FitError("the points are flat: they have no volume")


@dataclass(frozen=True)
class _Corners:
    """Corners of a convex hull, centred and scaled to a box of size one; link axes."""

    every: Array
    """Shape (n, 3)."""
    many: Array
    """Those outermost in some thousand directions: enough for the end of the search."""
    few: Array
    """Those outermost in some hundred directions: enough for its beginning."""
    directions: Array
    """Normals of the largest faces, the longest edges and the principal axes, shape (k, 3)."""


def _corners(points: Array) -> _Corners:
    low, high = points.min(axis=0), points.max(axis=0)
    unit = (points - (low + high) / 2) / (high - low).max()
    hull = ConvexHull(unit)
    triangles = unit[hull.simplices]
    edges = triangles[:, [1, 2, 0]] - triangles
    areas = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    edges = edges.reshape(-1, 3)
    lengths = np.linalg.norm(edges, axis=1)
    every = unit[hull.vertices]
    directions = [
        _heaviest(hull.equations[:, :3], areas),
        _heaviest(edges / lengths[:, None], lengths),
        np.linalg.svd(every - every.mean(axis=0), full_matrices=False)[2],
    ]
    many = _outermost(every, 5 * _DIRECTIONS)
    return _Corners(every, many, _outermost(many, _DIRECTIONS), np.concatenate(directions))


def _heaviest(directions: Array, weights: Array) -> Array:
    """The directions of most weight, where all that are nearly alike count as one."""
    directions = np.where(directions @ [1, 1e-3, 1e-6] < 0, -directions.T, directions.T).T
    _, first, alike = np.unique(directions.round(3), axis=0, return_index=True, return_inverse=True)
    order = np.argsort(-np.bincount(alike.ravel(), weights), kind="stable")
    return np.asarray(directions[first[order[:_FEATURES]]])


def _outermost(points: Array, n: int) -> Array:
    """The points that are first or last in any of ``n`` directions, or all if they are few."""
    if len(points) <= n:
        return points
    found = np.zeros(len(points), dtype=bool)
    for some in np.array_split(_half_sphere(n), n * len(points) // (10 * _BUNCH) + 1):
        along = some @ points.T
        found[along.argmin(axis=1)] = found[along.argmax(axis=1)] = True
    return points[found]


def _half_sphere(n: int) -> Array:
    """Directions spread evenly over half the sphere (Fibonacci lattice), shape (n, 3)."""
    z = (np.arange(n) + 0.5) / n
    angle = math.pi * (1 + math.sqrt(5)) * np.arange(n)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _around(kind: Kind, corners: _Corners, points: Array) -> tuple[Box | Cylinder | Sphere, Pose]:
    """The least primitive of one kind, measured after its pose is rounded."""
    quaternion = rounded(_quaternion(kind, corners))
    R = Pose(quaternion=quaternion).matrix[:3, :3]
    middle = R @ _middle(kind, points @ R)
    x, y, z = middle.round(_DECIMALS).tolist()
    pose = Pose((x + 0.0, y + 0.0, z + 0.0), quaternion)
    return _holding(kind, (points - pose.position) @ R), pose


def _quaternion(kind: Kind, corners: _Corners) -> Quat:
    """Rotation of the least primitive on its link."""
    if kind == "sphere":
        return rotation.IDENTITY
    return least_rotation(kind, _least(_SEARCHES[kind], corners))


def _middle(kind: Kind, points: Array) -> Array:
    """Centre of the least primitive along the axes of points, shape (3,)."""
    if kind == "sphere":
        return np.asarray(smallest_balls(points.T[None])[0][0])
    middle: Array = (points.min(axis=0) + points.max(axis=0)) / 2
    if kind == "cylinder":
        middle[:2] = smallest_balls(points.T[None, :2])[0][0]
    return middle


def _holding(kind: Kind, points: Array) -> Box | Cylinder | Sphere:
    """The least primitive at the origin, along the axes, that holds points."""
    if kind == "sphere":
        return Sphere(_up(np.linalg.norm(points, axis=1).max()))
    x, y, z = (_up(2 * half) for half in np.abs(points).max(axis=0).tolist())
    if kind == "box":
        return Box((x, y, z))
    return Cylinder(_up(np.linalg.norm(points[:, :2], axis=1).max()), z)


def _up(length: float) -> float:
    return float(math.ceil((length - _SLACK) * 10**_DECIMALS) / 10**_DECIMALS)


def _box_volumes(along: Array) -> Array:
    """Volumes of boxes along the axes around points, shape (n, 3, m)."""
    return np.asarray(np.ptp(along, axis=2).prod(axis=1))


def _cylinder_volumes(along: Array) -> Array:
    """Volumes of cylinders along z around points, shape (n, 3, m)."""
    _, radii = smallest_balls(along[:, :2])
    return np.asarray(math.pi * radii**2 * np.ptp(along[:, 2], axis=1))


@dataclass(frozen=True)
class _Search:
    """How the least volume over rotations is found."""

    volumes: Callable[[Array], Array]
    """Around points in the axes of ``n`` rotations, shape (n, 3, m)."""
    axes: slice
    """The columns of a rotation that matter."""
    freedom: int
    """How many of the first axes it is turned about."""
    spins: Array
    """Turns about z that every direction is tried with, shape (s, 3, 3)."""
    starts: int
    """How many rotations are refined."""
    moves: int
    """How many turns are tried from each in each step."""
    steps: int

    def measure(self, rotations: Array, points: Array) -> Array:
        """Volumes of rotations, in bunches."""
        axes = rotations.swapaxes(1, 2)
        bunches = np.array_split(axes, len(axes) * len(points) // _BUNCH + 1)
        return np.concatenate([self.volumes(some @ points.T) for some in bunches])


def _spins(n: int) -> Array:
    turns = np.zeros((n, 3))
    turns[:, 2] = np.arange(n) * math.pi / 2 / n
    return np.asarray(Rotation.from_rotvec(turns).as_matrix())


_SEARCHES: dict[Kind, _Search] = {
    "box": _Search(
        _box_volumes, slice(0, 3), freedom=3, spins=_spins(30), starts=24, moves=30, steps=40
    ),
    "cylinder": _Search(
        _cylinder_volumes, slice(2, 3), freedom=2, spins=_spins(1), starts=12, moves=16, steps=24
    ),
}


def _least(search: _Search, corners: _Corners) -> Array:
    """The rotation of least volume, shape (3, 3); of nearly equal ones that of the link."""
    directions = np.concatenate([np.eye(3), corners.directions, _half_sphere(_DIRECTIONS)])
    tried = (_frames(directions)[:, None] @ search.spins).reshape(-1, 3, 3)
    best = _distinct(tried, search.measure(tried, corners.few), search)
    rough, volumes = _descend(tried[best], corners.few, search, search.steps)
    rough = rough[np.argsort(volumes, kind="stable")[: search.starts // 3]]
    fine, _ = _descend(rough, corners.many, search, search.steps // 2)
    found = np.concatenate([_frames(np.eye(3)), fine])
    volumes = search.measure(found, corners.every)
    return np.asarray(found[np.argmax(volumes <= volumes.min() * (1 + _SIMPLER))])


def _frames(z: Array) -> Array:
    """Rotations with given z axes, shape (n, 3, 3)."""
    aside = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(aside, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def _distinct(rotations: Array, volumes: Array, search: _Search) -> NDArray[np.intp]:
    """The best rotations whose axes differ, best first."""
    kept: list[int] = []
    for i in np.argsort(volumes, kind="stable").tolist():
        axes = rotations[i][:, search.axes]
        alike = np.abs(axes.T @ rotations[kept][:, :, search.axes]).max(axis=2)
        if not (alike.min(axis=1) > _APART).any():
            kept.append(i)
        if len(kept) == search.starts:
            break
    return np.array(kept)


def _descend(rotations: Array, points: Array, search: _Search, steps: int) -> tuple[Array, Array]:
    """Turn each rotation towards less volume; returns rotations and volumes."""
    rng = np.random.default_rng(0)
    volumes = search.measure(rotations, points)
    reach = np.full(len(rotations), _REACH)
    rows = np.arange(len(rotations))
    for _ in range(steps):
        turns = np.zeros((search.moves, 3))
        turns[:, : search.freedom] = rng.uniform(-1, 1, (search.moves, search.freedom))
        half = np.arange(search.moves // 2)
        turns[half] *= np.eye(3)[half % search.freedom]
        turned = Rotation.from_rotvec((reach[:, None, None] * turns).reshape(-1, 3)).as_matrix()
        moved = rotations[:, None] @ turned.reshape(-1, search.moves, 3, 3)
        found = search.measure(moved.reshape(-1, 3, 3), points).reshape(-1, search.moves)
        best = found.argmin(axis=1)
        better = found[rows, best] < volumes * (1 - _GAIN)
        rotations = np.where(better[:, None, None], moved[rows, best], rotations)
        volumes = np.where(better, found[rows, best], volumes)
        reach = np.where(better, reach, reach * _SHRINK)
    return rotations, volumes
