"""Fit one or several primitives to the shapes of one link, and measure the fit.

An enclosing sphere, and the circle around a cylinder's cross section, are exact (Gaertner, "Fast
and robust smallest enclosing balls", 1999). The volume of a box or cylinder is a function of its
rotation with many kinks and local minima (O'Rourke, "Finding minimal enclosing boxes", 1985).
Rotations all over the sphere and along the faces of the hull are evaluated first; Nelder and Mead's
simplex, which needs no gradient, refines the best.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations

import numpy as np
import trimesh
from scipy.cluster.vq import kmeans2
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from morphgen.errors import FitError
from morphgen.fitting import search
from morphgen.fitting.canonical import KINDS, Kind, least_rotation, rounded
from morphgen.fitting.quality import Quality, quality, signed_distance
from morphgen.fitting.solid import Solid, solid_of, spiral
from morphgen.formats.fits import MAX_PRIMITIVES, are_primitives, shape_to_data
from morphgen.model import rotation
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere, volume
from morphgen.model.mesh import is_flat
from morphgen.typing import Array

_DECIMALS = 6  # decimals of dimensions and positions [m]
_SLACK = 1e-10  # shortfall of a dimension that is not rounded up [m]
_NUM_DIRECTIONS = 200  # number of axis directions over the half sphere that are evaluated
_NUM_NORMALS = 50  # number of normals of the hull's largest faces that are evaluated
_NUM_SPINS = 12  # number of rotations of a box about each of them, over a quarter turn
_NUM_STARTS = {"box": 12, "cylinder": 6}  # number of rotations that are refined
_SAME_MINIMUM = math.cos(math.radians(4))
"""Cosine of the angle between z axes below which two rotations lead to the same minimum."""
_FIRST_STEP = 0.05  # rotation of the first step of a refinement [rad]
_MAX_POINTS = 1000  # largest number of points with which rotations are searched
_LINK_AXES_EXCESS = 1e-5  # relative excess of volume up to which the link's own axes are preferred
_ON_BALL = 1e-10  # relative excess of a distance below which a point counts as on the ball
NUM_CLUSTERINGS = 3  # number of partitions of a solid that are tried for each number of primitives
_MAX_GROWTHS = 20
"""Largest number of times that primitives are enlarged to contain the points left outside."""


def enclose(points: Array, kinds: Collection[Kind] = KINDS) -> Shape:
    """Return the box, cylinder or sphere of least volume that contains all points (n, 3) [m].

    The pose is rounded before the dimensions are measured and rounded up to 1 um, so no point is
    more than 1e-9 m outside.
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
    low, high = points.min(axis=0), points.max(axis=0)
    hull = trimesh.convex.convex_hull((points - (low + high) / 2) / (high - low).max())
    enclosing = [_enclose(kind, hull, points) for kind in KINDS if kind in kinds]
    return Shape(*min(enclosing, key=lambda shape: volume(shape[0])))


def _enclose(
    kind: Kind, hull: trimesh.Trimesh, points: Array
) -> tuple[Box | Cylinder | Sphere, Pose]:
    """Return the primitive of one kind of least volume, measured after its pose is rounded."""
    quaternion = rotation.IDENTITY
    if kind != "sphere":
        quaternion = least_rotation(kind, _best_rotation(kind, hull))
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
        return smallest_ball(points)[0]
    centre: Array = (points.min(axis=0) + points.max(axis=0)) / 2
    if kind == "cylinder":
        centre[:2] = smallest_ball(points[:, :2])[0]
    return centre


def _round_up(length: float) -> float:
    return float(math.ceil((length - _SLACK) * 10**_DECIMALS) / 10**_DECIMALS)


def _best_rotation(kind: Kind, hull: trimesh.Trimesh) -> Array:
    points = np.asarray(hull.vertices)
    few = _outermost(points)
    measure, rough = (
        (_box_volume, _box_volume) if kind == "box" else (_cylinder_volume, _rough_cylinder_volume)
    )
    normals = np.concatenate([hull.facets_normal.reshape(-1, 3), hull.face_normals])
    areas = np.concatenate([hull.facets_area, hull.area_faces])
    largest = normals[np.argsort(-areas, kind="stable")[:_NUM_NORMALS]]
    principal_axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    directions = [np.eye(3), largest, principal_axes]
    starts = _frames(np.concatenate([*directions, _half_sphere(_NUM_DIRECTIONS)]))
    if kind == "box":
        angles = np.arange(_NUM_SPINS) * math.pi / 2 / _NUM_SPINS
        spins = Rotation.from_rotvec(np.outer(angles, (0, 0, 1))).as_matrix()
        starts = (starts[:, None] @ spins).reshape(-1, 3, 3)
    volumes = np.array([rough(few @ R) for R in starts])
    kept: list[Array] = []
    for i in np.argsort(volumes, kind="stable"):
        if all(abs(R[:, 2] @ starts[i][:, 2]) < _SAME_MINIMUM for R in kept):
            kept.append(starts[i])
        if len(kept) == _NUM_STARTS[kind]:
            break
    refined = [_refined(measure, few, R, dof=3 if kind == "box" else 2) for R in kept]
    rotations = [*_frames(np.eye(3)), *kept, *refined]
    volumes = np.array([measure(points @ R) for R in rotations])
    return np.asarray(rotations[np.argmax(volumes <= volumes.min() * (1 + _LINK_AXES_EXCESS))])


def _refined(measure: Callable[[Array], float], points: Array, R: Array, dof: int) -> Array:
    """Rotate about the first ``dof`` axes towards less volume."""

    def turned(vector: Array) -> Array:
        return np.asarray(R @ Rotation.from_rotvec([*vector, *[0.0] * (3 - dof)]).as_matrix())

    simplex = np.concatenate([np.zeros((1, dof)), _FIRST_STEP * np.eye(dof)])
    result = minimize(
        lambda vector: measure(points @ turned(vector)),
        np.zeros(dof),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 1e-6, "fatol": 1e-9},
    )
    return turned(result.x)


def _box_volume(points: Array) -> float:
    return float(np.ptp(points, axis=0).prod())


def _cylinder_volume(points: Array) -> float:
    return float(math.pi * smallest_ball(points[:, :2])[1] ** 2 * np.ptp(points[:, 2]))


def _rough_cylinder_volume(points: Array) -> float:
    """Return about the volume of the cylinder around points, with the centre of their box."""
    across = points[:, :2] - (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2
    return float(math.pi * np.square(across).sum(axis=1).max() * np.ptp(points[:, 2]))


def _outermost(points: Array) -> Array:
    """Return the points that are first or last in many directions, or all if they are few."""
    if len(points) <= _MAX_POINTS:
        return points
    along = _half_sphere(2 * _MAX_POINTS) @ points.T
    return np.asarray(points[np.unique([along.argmin(axis=1), along.argmax(axis=1)])])


def _half_sphere(n: int) -> Array:
    """Return directions spread evenly over half the sphere, shape (n, 3)."""
    return spiral((np.arange(n) + 0.5) / n)


def _frames(z: Array) -> Array:
    """Return rotations with given z axes, shape (n, 3, 3)."""
    aside = np.where(np.abs(z[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    x = np.cross(aside, z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=2)


def smallest_ball(points: Array) -> tuple[Array, float]:
    """Return the centre and radius of the smallest ball around points (n, 2) or (n, 3)."""
    centre, squared_radius, support = points[0], 0.0, points[:1]
    while True:
        squares = np.square(points - centre).sum(axis=1)
        pivot = points[squares.argmax()]
        balls = []
        if squares.max() > squared_radius * (1 + _ON_BALL):
            balls = [*_balls_through(pivot, support)]
        # A ball that does not grow has reached the precision of its numbers.
        best = min(balls, key=lambda ball: ball[0], default=(0.0, centre, support))
        if best[0] <= squared_radius:
            return centre, math.sqrt(squares.max())
        squared_radius, centre, support = best


def _balls_through(pivot: Array, support: Array) -> Iterator[tuple[float, Array, Array]]:
    """Yield squared radius, centre and support of balls around points, one of them on the ball."""
    for k in range(1, support.shape[1] + 1):
        for others in map(list, combinations(range(len(support)), k)):
            spokes = support[others] - pivot
            # The centre c solves 2 p . c = p . p for each spoke p, and lies among them.
            offset = np.linalg.lstsq(spokes, np.square(spokes).sum(axis=1) / 2, rcond=None)[0]
            square, away = offset @ offset, support - pivot - offset
            if np.square(away).sum(axis=1).max() <= square * (1 + 100 * _ON_BALL):
                yield square, pivot + offset, np.concatenate([support[others], pivot[None]])


def enclose_solid(
    target: search.SampledSolid, max_primitives: int, iou: float, seed: int
) -> tuple[Shape, ...]:
    """Return the fewest primitives that contain a solid with at least ``iou``, or the best.

    For several, the solid is cut along the bisecting planes between cluster centres, and each piece
    is enclosed; the best of ``NUM_CLUSTERINGS`` partitions is kept.
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


def _enclose_clusters(target: search.SampledSolid, k: int, seed: int) -> tuple[Shape, ...]:
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


def _iou(shapes: tuple[Shape, ...], target: search.SampledSolid) -> float:
    held, inside = signed_distance(shapes, target.link_points) <= 0, target.inside
    return float(target.weights[held & inside].sum() / target.weights[held | inside].sum())


MAX_COVER = 0.9999
"""Largest share that spheres can be required to cover: more cannot be counted on sample points."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    max_primitives: int = 1  # largest number of primitives per link
    iou: float = 0.9  # intersection over union at which no further primitive is added
    enclose: bool = False
    """Enclose every point of the solid, instead of maximising the intersection over union."""
    seed: int = 0  # seed of the sample points and of the clusterings
    spheres: int | None = None
    """Number of spheres per link, of a fit with spheres alone; None for a fit with primitives."""
    cover: float | None = None
    """Share of a link's volume that its spheres must cover; None for the largest IoU."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.spheres is not None:
            if not 1 <= self.spheres <= MAX_PRIMITIVES:
                raise FitError(f"{self.spheres} spheres: expected 1 to {MAX_PRIMITIVES} per link")
            if self.max_primitives != 1 or self.enclose:
                raise FitError("a fit of spheres takes neither max_primitives nor enclose")
        if self.cover is not None:
            if self.spheres is None:
                raise FitError(f"cover {self.cover:g}: expected a number of spheres, too")
            if not 0 < self.cover <= MAX_COVER:
                raise FitError(f"cover {self.cover:g}: expected more than 0, at most {MAX_COVER}")
        if not 1 <= self.max_primitives <= MAX_PRIMITIVES:
            raise FitError(f"{self.max_primitives} primitives: expected 1 to {MAX_PRIMITIVES}")
        if not 0 < self.iou <= 1:
            raise FitError(f"IoU {self.iou}: expected more than 0, at most 1")
        if self.seed < 0:
            raise FitError(f"seed {self.seed}: expected 0 or more")


@dataclass(frozen=True)
class LinkFit:
    """Primitives that replace the shapes of a link, with their measured quality."""

    primitives: tuple[Shape, ...]  # boxes, cylinders and spheres in the link frame
    single: Shape | None  # the single primitive of largest overlap; None if it was not searched for
    solid: str  # how the solid was made, see `solid.Method`; `primitives` if the shapes were kept
    quality: Quality
    seconds: float  # duration of the fit [s]; 0 for a link that shares the fit of a congruent one
    decimated_from: int | None = None
    """Number of triangles before decimation; None if the mesh was not decimated."""

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON: metres, (x, y, z) and (w, x, y, z)."""
        return {
            "primitives": [shape_to_data(shape) for shape in self.primitives],
            "solid": self.solid,
            "decimated_from": self.decimated_from,
            "quality": {name: float(f"{v:.6g}") for name, v in asdict(self.quality).items()},
            "seconds": round(self.seconds, 2),
        }


def fit_shapes(
    shapes: Sequence[Shape], options: FitOptions, *, solid: Solid | None = None
) -> LinkFit:
    """Fit the shapes of one link in its frame, or keep few primitives of the wanted kinds."""
    start = time.perf_counter()
    solid = solid or solid_of(shapes)
    is_kept = are_primitives(shapes) and len(shapes) <= options.max_primitives
    if options.spheres is not None:
        is_kept = all(isinstance(shape.geometry, Sphere) for shape in shapes)
    if is_kept:
        kept = tuple(replace(shape, rgba=None) for shape in shapes)
        single = kept[0] if len(kept) == 1 else None
        return replace(_measure(kept, single, solid, start), solid="primitives")
    return fit_solid(solid, options)


def fit_solid(solid: Solid, options: FitOptions) -> LinkFit:
    """Fit a solid; see ``fit_shapes``."""
    start = time.perf_counter()
    target = search.sample_solid(solid, options.seed)
    if options.spheres is not None:
        found = search.best_spheres(target, options.spheres, options.cover, options.seed)
        return _measure(found.shapes, None, solid, start)
    if options.enclose:
        shapes = enclose_solid(target, options.max_primitives, options.iou, options.seed)
        return _measure(shapes, None, solid, start)
    best = latest = search.best_single(target)
    (single,) = best.shapes
    for _ in range(1, options.max_primitives):
        if best.iou >= options.iou:
            break
        more = search.best_several(target, latest, options.seed)
        if more is None:
            break
        latest = more
        best = max(best, latest, key=lambda result: result.iou)
    return _measure(best.shapes, single, solid, start)


def _measure(
    primitives: tuple[Shape, ...], single: Shape | None, solid: Solid, start: float
) -> LinkFit:
    seconds = time.perf_counter() - start  # of the fit, without the measurement
    measured = quality(solid, primitives)
    return LinkFit(primitives, single, solid.method, measured, seconds, solid.decimated_from)
