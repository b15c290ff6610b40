"""How well primitives stand for a solid: shares of volume and distances of surfaces.

Nothing here is shared with the search for primitives: fresh samples, exact distances, NumPy only.
Volumes are counted on one set of scrambled Sobol points, so that their errors cancel in ratios.
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

Body = Box | Cylinder | Capsule
"""A sphere is a capsule of no length."""
Placed = tuple[Array, Array]
"""Points and the outward normals there, both of shape (n, 3)."""
Patch = tuple[float, Callable[[Array], Placed]]
"""Area of a piece of surface, and its map of the unit square, (n, 2), that keeps areas."""


@dataclass(frozen=True)
class Quality:
    """How well primitives stand for a solid; where primitives overlap counts once."""

    iou: float
    """Volume of the intersection over that of the union."""
    coverage: float
    """Share of the solid's volume inside the primitives."""
    volume_ratio: float
    """Volume of the union of the primitives over the solid's."""
    protrusion_mean: float
    """How far the primitives' outer surface lies outside of the solid, 0 where inside, metres."""
    protrusion_p95: float
    """95th percentile of the same over the area."""
    gap_mean: float
    """How far the solid's surface lies outside of the primitives, 0 where inside, metres."""
    gap_p95: float
    """95th percentile of the same over the area."""
    hausdorff: float
    """Largest distance from a point of either surface to the other surface, metres."""


def quality(
    solid: Solid,
    primitives: Sequence[Shape],
    *,
    seed: int = 1,
    volume_points: int = 32768,
    surface_points: int = 8192,
) -> Quality:
    """Measure primitives against the solid that they stand for.

    Where the solid's mesh has holes its surface is what triangles there are; triangles within it
    count as its surface only for the distance to points inside of it.

    Args:
        solid: What is to be stood for, in the link frame.
        primitives: Boxes, cylinders, spheres and capsules on the link, at least one.
        seed: Of the sample points.
        volume_points: How many in the bounding box of both, rounded up to a power of two.
        surface_points: How many on each surface, on the primitives rounded up likewise.

    Raises:
        FitError: If no sample point lies in the solid: it is far too thin, or too far off.
        ValueError: If there are no primitives, one has no volume, or one is a mesh.
    """
    vertices = np.asarray(solid.mesh.vertices)[solid.mesh.referenced_vertices]
    at_vertices = signed_distance(primitives, vertices)
    rng = np.random.default_rng(seed)
    R, low, high = _bounding_box(primitives, vertices)
    points = (low + (high - low) * _sobol(volume_points, rng)) @ R.T
    ours, theirs = signed_distance(primitives, points) <= 0, solid.contains(points)
    if not theirs.any():
        raise FitError(f"none of {len(points)} sample points lies in the solid")
    both = np.count_nonzero(ours & theirs)

    outer = _outer_surface(primitives, surface_points, rng)
    corners = [_outer(primitives, owner, *_corners(each)) for owner, each in enumerate(primitives)]
    to_solid = solid.distance(np.concatenate([outer, *corners]))
    protrusion = np.where(solid.contains(outer), 0.0, to_solid[: len(outer)])

    surface = solid.surface(surface_points, rng)
    signed = signed_distance(primitives, surface)
    gap = np.maximum(signed, 0.0)
    # The distance to a convex body is largest in a corner of a triangle. Corners within the solid
    # do no harm: from there some way out leads away from all primitives.
    farthest = [to_solid.max(), gap.max(), at_vertices.max()]
    if (signed < 0).any():
        farthest.append(_depth(primitives, surface[signed < 0], surface_points, rng).max())
    return Quality(
        iou=float(both / np.count_nonzero(ours | theirs)),
        coverage=float(both / np.count_nonzero(theirs)),
        volume_ratio=float(np.count_nonzero(ours) / np.count_nonzero(theirs)),
        protrusion_mean=float(protrusion.mean()),
        protrusion_p95=float(np.percentile(protrusion, 95)),
        gap_mean=float(gap.mean()),
        gap_p95=float(np.percentile(gap, 95)),
        hausdorff=float(max(farthest)),
    )


def signed_distance(primitives: Sequence[Shape], points: Array) -> Array:
    """Signed distance of points to the union of primitives, negative inside.

    It is exact outside, and inside of a single one; inside of several the surface may be farther.

    Args:
        primitives: At least one, none of them a mesh.
        points: Shape (n, 3), metres, in the link frame.

    Returns:
        Distances, shape (n,), metres.

    Raises:
        ValueError: If there are no primitives, one has no volume, or one is a mesh.
    """
    if not primitives:
        raise ValueError("there are no primitives")
    return np.asarray(np.min([_distance(shape, points) for shape in primitives], axis=0))


def _body(shape: Shape) -> Body:
    geometry = shape.geometry
    if isinstance(geometry, Mesh) or not volume(geometry) > 0:
        raise ValueError(f"{geometry} is no primitive with a volume")
    return Capsule(geometry.radius, 0.0) if isinstance(geometry, Sphere) else geometry


def _distance(shape: Shape, points: Array) -> Array:
    T = shape.T_link_shape.matrix
    x, y, z = T[:3, :3].T @ (points - T[:3, 3]).T
    match _body(shape):
        case Box((a, b, c)):
            return _rounded(abs(x) - a / 2, abs(y) - b / 2, abs(z) - c / 2)
        case Cylinder(radius, length):
            return _rounded(np.hypot(x, y) - radius, abs(z) - length / 2)
        case Capsule(radius, length):
            z = z - np.clip(z, -length / 2, length / 2)
            return np.asarray(np.sqrt(x * x + y * y + z * z) - radius)


def _rounded(*beyond: Array) -> Array:
    """Signed distance from how far points are beyond each pair of orthogonal faces."""
    squared = sum(np.maximum(part, 0.0) ** 2 for part in beyond)
    return np.asarray(np.sqrt(squared) + np.minimum(np.max(beyond, axis=0), 0.0))


def _bounding_box(primitives: Sequence[Shape], points: Array) -> tuple[Array, Array, Array]:
    """Axes of the link or of a primitive, as columns, and the bounds of all along them."""
    boxes = []
    for R in (np.eye(3), *(shape.T_link_shape.matrix[:3, :3] for shape in primitives)):
        middles = np.array([shape.T_link_shape.position for shape in primitives]) @ R
        reaches = np.array([_reach(shape, R) for shape in primitives])
        ends = np.concatenate([points @ R, middles - reaches, middles + reaches])
        boxes.append((R, ends.min(axis=0), ends.max(axis=0)))
    return min(boxes, key=lambda box: float(np.prod(box[2] - box[1])))


def _reach(shape: Shape, R: Array) -> Array:
    """Half the extents along the columns of a rotation, shape (3,)."""
    axes = abs(R.T @ shape.T_link_shape.matrix[:3, :3])
    match _body(shape):
        case Box(size):
            return np.asarray(axes @ size / 2)
        case Cylinder(radius, length):
            across = np.sqrt(np.maximum(1 - axes[:, 2] ** 2, 0.0))
            return np.asarray(radius * across + axes[:, 2] * length / 2)
        case Capsule(radius, length):
            return np.asarray(radius + axes[:, 2] * length / 2)


def _sobol(n: int, rng: np.random.Generator) -> Array:
    """Scrambled Sobol points in the unit cube, at least ``n``: a power of two."""
    sampler = qmc.Sobol(3, scramble=True, seed=rng)
    return np.asarray(sampler.random_base2(max(n - 1, 1).bit_length()))


def _outer_surface(primitives: Sequence[Shape], n: int, rng: np.random.Generator) -> Array:
    """Points spread evenly over the primitives, without those that lie within another one."""
    bodies = enumerate(map(_body, primitives))
    patches = [(owner, *patch) for owner, body in bodies for patch in _patches(body)]
    ends = np.cumsum([area for _, area, _ in patches])
    unit = _sobol(n, rng)
    chosen = np.searchsorted(ends[:-1] / ends[-1], unit[:, 0], side="right")
    parts = ((owner, at(unit[chosen == i, 1:])) for i, (owner, _, at) in enumerate(patches))
    return np.concatenate([_outer(primitives, owner, *part) for owner, part in parts])


def _outer(primitives: Sequence[Shape], owner: int, points: Array, normals: Array) -> Array:
    """Points of a primitive, given in its frame, without those that lie within another one.

    Of faces that coincide those of the first stay; of faces that face each other, none.
    """
    T = primitives[owner].T_link_shape.matrix
    points, normals = points @ T[:3, :3].T + T[:3, 3], normals @ T[:3, :3].T
    step = _step(primitives) * normals
    covered = np.zeros(len(points), dtype=bool)
    for index, other in enumerate(primitives):
        if index != owner:
            covered |= _distance(other, points + step) < 0
        if index < owner:
            covered |= _distance(other, points - step) < 0
    return points[~covered]


def _step(primitives: Sequence[Shape]) -> float:
    """How far beside a surface to look for another primitive, metres."""
    return 1e-6 * math.pow(min(volume(_body(shape)) for shape in primitives), 1 / 3)


def _patches(body: Body) -> list[Patch]:
    """The surface of a primitive, in pieces."""
    match body:
        case Box((a, b, c)):
            sides = itertools.product(enumerate((b * c, c * a, a * b)), (-1, 1))
            return [(area, partial(_on_face, body, axis, sign)) for (axis, area), sign in sides]
        case Cylinder(radius, length):
            ends = (math.tau * radius**2, partial(_on_caps, body))
            return [(math.tau * radius * length, partial(_on_tube, body)), ends]
        case Capsule(radius, length):
            ends = (4 * math.pi * radius**2, partial(_on_ball, body))
            return [(math.tau * radius * length, partial(_on_tube, body)), ends]


def _on_face(box: Box, axis: int, sign: int, unit: Array) -> Placed:
    normals = np.zeros((len(unit), 3))
    normals[:, axis] = sign
    return np.insert(2 * unit - 1, axis, sign, axis=1) * box.size / 2, normals


def _on_tube(body: Cylinder | Capsule, unit: Array) -> Placed:
    normals = _spun(np.ones(len(unit)), unit[:, 0], np.zeros(len(unit)))
    return normals * body.radius + np.outer(unit[:, 1] - 0.5, (0, 0, body.length)), normals


def _on_caps(cylinder: Cylinder, unit: Array) -> Placed:
    side, away = np.copysign(1.0, unit[:, 1] - 0.5), np.sqrt(abs(2 * unit[:, 1] - 1))
    points = _spun(cylinder.radius * away, unit[:, 0], side * cylinder.length / 2)
    return points, np.outer(side, (0.0, 0.0, 1.0))


def _on_ball(capsule: Capsule, unit: Array) -> Placed:
    """On both caps; evenly along the axis, which is evenly over a sphere (Archimedes)."""
    z = 2 * unit[:, 1] - 1
    normals = _spun(np.sqrt(1 - z * z), unit[:, 0], z)
    return normals * capsule.radius + np.outer(np.sign(z), (0, 0, capsule.length / 2)), normals


def _spun(radius: Array, turns: Array, z: Array) -> Array:
    """Points from cylindrical coordinates, shape (n, 3)."""
    angle = math.tau * turns
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _corners(shape: Shape) -> Placed:
    """A box's corners, 64 points on each rim of a cylinder, none of a capsule."""
    points = np.zeros((0, 3))
    match _body(shape):
        case Box(size):
            points = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
        case Cylinder(radius, length):
            turns = np.arange(128) / 64
            z = np.where(turns < 1, -length / 2, length / 2)
            points = _spun(np.full(len(z), radius), turns, z)
    return points, points / np.linalg.norm(points, axis=1, keepdims=True)


def _depth(primitives: Sequence[Shape], points: Array, n: int, rng: np.random.Generator) -> Array:
    """Distance of points inside of the primitives to the outer surface, shape (m,).

    The signed distance says how far it is at least. That is exact where the way to the surface of
    the primitive, up the gradient, leads out of all others too; elsewhere a dense sample decides.
    """
    depth = -signed_distance(primitives, points)
    if len(primitives) == 1:
        return depth
    step = _step(primitives)
    ahead = [signed_distance(primitives, points + step * axis) for axis in np.eye(3)]
    up = (np.stack(ahead, axis=1) + depth[:, None]) / step
    beyond = signed_distance(primitives, points + (depth + 10 * step)[:, None] * up)
    unsure = beyond < 5 * step
    if unsure.any():
        surface = _outer_surface(primitives, 4 * n, rng)
        depth[unsure] = np.maximum(cKDTree(surface).query(points[unsure])[0], depth[unsure])
    return depth
