"""Measure how well primitives approximate a solid: volume ratios and surface distances.

The measurement is independent of the search for primitives: it draws its own samples and computes
exact distances. All volumes are counted on the same scrambled Sobol points, so that errors cancel
in ratios.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Shape, Sphere, volume
from morphgen.typing import Array

SolidPrimitive = Box | Cylinder | Capsule
"""A primitive; a sphere is a capsule of length 0."""
SurfacePoints = tuple[Array, Array]
"""Points and their outward normals, both of shape (n, 3)."""
Patch = tuple[float, Callable[[Array], SurfacePoints]]
"""Area of a patch of a surface, and its area-preserving map from the unit square (n, 2)."""

_ON_SURFACE = 1e-6
"""Distance up to which a point counts as on the surface of the solid, not outside [m]."""


@dataclass(frozen=True)
class Quality:
    """Measured agreement of a union of primitives with a solid."""

    iou: float
    """Volume of the intersection over the volume of the union."""
    coverage: float
    """Share of the solid's volume that is inside the primitives."""
    volume_ratio: float
    """Volume of the union of the primitives over the volume of the solid."""
    protrusion_share: float
    """Share of the primitives' outer surface that is outside of the solid."""
    protrusion_mean: float
    """Mean distance of the primitives' outer surface from the solid, 0 where inside [m]."""
    protrusion_p95: float
    """95th percentile of that distance over the surface [m]."""
    gap_mean: float
    """Mean distance of the solid's surface from the primitives, 0 where inside [m]."""
    gap_p95: float
    """95th percentile of that distance over the surface [m]."""
    hausdorff: float
    """Largest distance of a point of either surface to the other surface [m]."""


def quality(
    solid: Solid,
    primitives: Sequence[Shape],
    *,
    seed: int = 1,
    volume_points: int = 32768,
    surface_points: int = 8192,
) -> Quality:
    """Measure how well primitives approximate a solid.

    The surface of a solid with holes consists of the triangles that exist. Triangles inside of the
    solid count only for distances from points inside of it.

    solid: The solid in the link frame.
    primitives: Boxes, cylinders, spheres and capsules in the link frame, at least one.
    """
    vertices = np.asarray(solid.mesh.vertices)[solid.mesh.referenced_vertices]
    at_vertices = signed_distance(primitives, vertices)
    rng = np.random.default_rng(seed)
    R, low, high = _bounding_box(primitives, vertices)
    # In the smallest box, most points are near a surface and tell the volumes apart.
    points = (low + (high - low) * _sobol(volume_points, rng)) @ R.T
    in_primitives, in_solid = signed_distance(primitives, points) <= 0, solid.contains(points)
    if not in_solid.any():
        raise FitError(f"none of {len(points)} sample points lies in the solid")
    intersection = np.count_nonzero(in_primitives & in_solid)

    outer = _outer_surface(primitives, surface_points, rng)
    corners = [_outer(primitives, i, *_corners(shape)) for i, shape in enumerate(primitives)]
    to_solid = solid.distance(np.concatenate([outer, *corners]))
    protrusion = np.where(solid.contains(outer), 0.0, to_solid[: len(outer)])

    surface = solid.surface(surface_points, rng)
    signed = signed_distance(primitives, surface)
    gap = np.maximum(signed, 0.0)
    # The distance of a triangle to a convex primitive is largest at a vertex. Vertices inside of
    # the solid do no harm: a surface point near them is at least as far from all primitives.
    farthest = [to_solid.max(), gap.max(), at_vertices.max()]
    if (signed < 0).any():
        farthest.append(_depth(primitives, surface[signed < 0], surface_points, rng).max())
    return Quality(
        iou=float(intersection / np.count_nonzero(in_primitives | in_solid)),
        coverage=float(intersection / np.count_nonzero(in_solid)),
        volume_ratio=float(np.count_nonzero(in_primitives) / np.count_nonzero(in_solid)),
        protrusion_share=float((protrusion > _ON_SURFACE).mean()),
        protrusion_mean=float(protrusion.mean()),
        protrusion_p95=float(np.percentile(protrusion, 95)),
        gap_mean=float(gap.mean()),
        gap_p95=float(np.percentile(gap, 95)),
        hausdorff=float(max(farthest)),
    )


def signed_distance(primitives: Sequence[Shape], points: Array) -> Array:
    """Return the signed distances (n,) of points (n, 3) to a union of primitives [m].

    They are negative inside, and exact outside and inside of one primitive; inside of several
    overlapping primitives the surface may be farther away.
    """
    if not primitives:
        raise ValueError("there are no primitives")
    return np.asarray(np.min([_distance(shape, points) for shape in primitives], axis=0))


def _solid_primitive(shape: Shape) -> SolidPrimitive:
    """Return the geometry of a shape, a sphere as a capsule of length 0."""
    geometry = shape.geometry
    if isinstance(geometry, Mesh) or not volume(geometry) > 0:
        raise ValueError(f"{geometry} is not a primitive with a volume")
    return Capsule(geometry.radius, 0.0) if isinstance(geometry, Sphere) else geometry


def _distance(shape: Shape, points: Array) -> Array:
    T = shape.T_link_shape.matrix
    x, y, z = T[:3, :3].T @ (points - T[:3, 3]).T
    match _solid_primitive(shape):
        case Box((a, b, c)):
            return _rounded(abs(x) - a / 2, abs(y) - b / 2, abs(z) - c / 2)
        case Cylinder(radius, length):
            return _rounded(np.hypot(x, y) - radius, abs(z) - length / 2)
        case Capsule(radius, length):
            z = z - np.clip(z, -length / 2, length / 2)
            return np.asarray(np.sqrt(x * x + y * y + z * z) - radius)


def _rounded(*beyond: Array) -> Array:
    """Return signed distances from the distances beyond each pair of orthogonal faces."""
    squared = sum(np.maximum(part, 0.0) ** 2 for part in beyond)
    return np.asarray(np.sqrt(squared) + np.minimum(np.max(beyond, axis=0), 0.0))


def _bounding_box(primitives: Sequence[Shape], points: Array) -> tuple[Array, Array, Array]:
    """Return the smallest box around all, along the axes of the link or of a primitive.

    The axes are the columns of the first array; the others are the bounds along them.
    """
    boxes = []
    for R in (np.eye(3), *(shape.T_link_shape.matrix[:3, :3] for shape in primitives)):
        centres = np.array([shape.T_link_shape.position for shape in primitives]) @ R
        halves = np.array([_half_extents(shape, R) for shape in primitives])
        ends = np.concatenate([points @ R, centres - halves, centres + halves])
        boxes.append((R, ends.min(axis=0), ends.max(axis=0)))
    return min(boxes, key=lambda box: float(np.prod(box[2] - box[1])))


def _half_extents(shape: Shape, R: Array) -> Array:
    """Return the half extents of a primitive along the columns of a rotation, shape (3,)."""
    axes = abs(R.T @ shape.T_link_shape.matrix[:3, :3])  # cosines
    match _solid_primitive(shape):
        case Box(size):
            return np.asarray(axes @ size / 2)
        case Cylinder(radius, length):
            across = np.sqrt(np.maximum(1 - axes[:, 2] ** 2, 0.0))
            return np.asarray(radius * across + axes[:, 2] * length / 2)
        case Capsule(radius, length):
            return np.asarray(radius + axes[:, 2] * length / 2)


def _sobol(n: int, rng: np.random.Generator) -> Array:
    """Return at least ``n`` scrambled Sobol points in the unit cube, a power of two."""
    sampler = qmc.Sobol(3, scramble=True, seed=rng)  # errors of two volumes cancel on one sample
    return np.asarray(sampler.random_base2(max(n - 1, 1).bit_length()))


def _outer_surface(primitives: Sequence[Shape], n: int, rng: np.random.Generator) -> Array:
    """Sample the outer surface of the union of primitives evenly."""
    geometries = enumerate(map(_solid_primitive, primitives))
    patches = [(owner, *patch) for owner, geometry in geometries for patch in _patches(geometry)]
    ends = np.cumsum([area for _, area, _ in patches])
    unit = _sobol(n, rng)
    chosen = np.searchsorted(ends[:-1] / ends[-1], unit[:, 0], side="right")
    parts = ((owner, at(unit[chosen == i, 1:])) for i, (owner, _, at) in enumerate(patches))
    return np.concatenate([_outer(primitives, owner, *part) for owner, part in parts])


def _outer(primitives: Sequence[Shape], owner: int, points: Array, normals: Array) -> Array:
    """Return the surface points of a primitive that are outside of all others, in the link frame.

    Of faces that coincide those of the first primitive are kept; of faces in contact, none.
    """
    T = primitives[owner].T_link_shape.matrix
    points, normals = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
    step = _test_offset(primitives) * normals
    covered = np.zeros(len(points), dtype=bool)
    for index, other in enumerate(primitives):
        if index != owner:
            covered |= _distance(other, points + step) < 0
        if index < owner:
            covered |= _distance(other, points - step) < 0
    return points[~covered]


def _test_offset(primitives: Sequence[Shape]) -> float:
    """Return the offset from a surface at which other primitives are tested for [m]."""
    return 1e-6 * math.pow(min(volume(_solid_primitive(shape)) for shape in primitives), 1 / 3)


def _patches(geometry: SolidPrimitive) -> list[Patch]:
    """Return the patches of a primitive's surface."""
    match geometry:
        case Box((a, b, c)):
            sides = itertools.product(enumerate((b * c, c * a, a * b)), (-1, 1))
            return [(area, partial(_on_face, geometry, axis, sign)) for (axis, area), sign in sides]
        case Cylinder(radius):
            ends = (math.tau * radius**2, partial(_on_caps, geometry))
        case Capsule(radius):
            ends = (4 * math.pi * radius**2, partial(_on_ball, geometry))
    return [(math.tau * radius * geometry.length, partial(_on_tube, geometry)), ends]


def _on_face(box: Box, axis: int, sign: int, unit: Array) -> SurfacePoints:
    normals = np.zeros((len(unit), 3))
    normals[:, axis] = sign
    return np.insert(2 * unit - 1, axis, sign, axis=1) * box.size / 2, normals


def _on_tube(tube: Cylinder | Capsule, unit: Array) -> SurfacePoints:
    normals = _spun(np.ones(len(unit)), unit[:, 0], np.zeros(len(unit)))
    return normals * tube.radius + np.outer(unit[:, 1] - 0.5, (0, 0, tube.length)), normals


def _on_caps(cylinder: Cylinder, unit: Array) -> SurfacePoints:
    side, distance = np.copysign(1.0, unit[:, 1] - 0.5), np.sqrt(abs(2 * unit[:, 1] - 1))
    points = _spun(cylinder.radius * distance, unit[:, 0], side * cylinder.length / 2)
    return points, np.outer(side, (0.0, 0.0, 1.0))


def _on_ball(capsule: Capsule, unit: Array) -> SurfacePoints:
    """Sample both caps: uniform along the axis is uniform over a sphere (Archimedes)."""
    z = 2 * unit[:, 1] - 1
    normals = _spun(np.sqrt(1 - z * z), unit[:, 0], z)
    return normals * capsule.radius + np.outer(np.sign(z), (0, 0, capsule.length / 2)), normals


def _spun(radius: Array, turns: Array, z: Array) -> Array:
    """Return points from cylindrical coordinates, shape (n, 3)."""
    angle = math.tau * turns
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _corners(shape: Shape) -> SurfacePoints:
    """Return a box's corners, 64 points on each rim of a cylinder, nothing of a capsule."""
    points = np.zeros((0, 3))
    match _solid_primitive(shape):
        case Box(size):
            points = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
        case Cylinder(radius, length):
            turns = np.arange(128) / 64
            z = np.where(turns < 1, -length / 2, length / 2)
            points = _spun(np.full(len(z), radius), turns, z)
    return points, points / np.linalg.norm(points, axis=1, keepdims=True)


def _depth(primitives: Sequence[Shape], points: Array, n: int, rng: np.random.Generator) -> Array:
    """Return the distances of points inside of the primitives to the outer surface, shape (m,).

    The signed distance is a lower bound. It is exact where the path along its gradient leaves all
    primitives at once; elsewhere the distance to a dense sample of the surface is used.
    """
    depth = -signed_distance(primitives, points)
    if len(primitives) == 1:
        return depth
    step = _test_offset(primitives)
    ahead = [signed_distance(primitives, points + step * axis) for axis in np.eye(3)]
    gradient = (np.stack(ahead, axis=1) + depth[:, None]) / step
    beyond = signed_distance(primitives, points + (depth + 10 * step)[:, None] * gradient)
    unsure = beyond < 5 * step
    if unsure.any():
        surface = _outer_surface(primitives, 4 * n, rng)
        depth[unsure] = np.maximum(cKDTree(surface).query(points[unsure])[0], depth[unsure])
    return depth
