"""Mass properties from geometry and density."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import manifold3d
import numpy as np
import trimesh

from morphgen.errors import RobotError
from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Shape,
    Sphere,
    volume,
)
from morphgen.model.mesh import convex_hull, load_mesh
from morphgen.model.robot import Inertial, Link
from morphgen.typing import Array

_SEGMENTS = 48


@dataclass(frozen=True)
class VolumeIntegrals:
    """Volume integrals of a solid about the link's origin, in link axes."""

    volume: float
    """Integral of 1, m^3."""
    first: Array
    """Integral of x, shape (3,), m^4."""
    second: Array
    """Integral of x x^T, shape (3, 3), m^5."""

    def __add__(self, other: VolumeIntegrals) -> VolumeIntegrals:
        return VolumeIntegrals(
            self.volume + other.volume, self.first + other.first, self.second + other.second
        )

    def __sub__(self, other: VolumeIntegrals) -> VolumeIntegrals:
        return VolumeIntegrals(
            self.volume - other.volume, self.first - other.first, self.second - other.second
        )


def inertial_from_density(shapes: Sequence[Shape], density: float) -> Inertial:
    """Mass properties of solid shapes of one density, where they overlap counted once.

    Closed forms for primitives; a closed mesh counts as its volume, an open one as its convex
    hull. The overlap of shapes is measured on their tessellations by exact booleans.

    Args:
        shapes: The solids, placed on their link.
        density: kg/m^3.

    Returns:
        Mass, centre of mass and inertia; zero mass for no shapes.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    moments = union_integrals(shapes)
    if moments.volume <= 0:
        return Inertial(0.0)
    com = moments.first / moments.volume
    central = moments.second - moments.volume * np.outer(com, com)
    inertia = density * (np.trace(central) * np.eye(3) - central)
    x, y, z = com.tolist()
    return Inertial.from_matrix(density * moments.volume, (x, y, z), inertia)


def with_inertia(link: Link, density: float) -> Link:
    """The link with mass properties of its collision shapes (its visuals if it has none)."""
    shapes = link.collisions or link.visuals
    return replace(link, inertial=inertial_from_density(shapes, density)) if shapes else link


def inertial_from_mass(link: Link, mass: float) -> Inertial:
    """Mass properties of a link's shapes, scaled to a mass.

    Raises:
        RobotError: If the link has no shapes to take the inertia from.
    """
    unit = inertial_from_density(link.collisions or link.visuals, 1.0)
    if unit.mass <= 0:
        raise RobotError(f"link {link.name!r} has no volume to give {mass:g} kg an inertia")
    return Inertial.from_matrix(mass, unit.com, unit.matrix * (mass / unit.mass))


def union_integrals(shapes: Sequence[Shape]) -> VolumeIntegrals:
    """Volume integrals of the union of shapes about the link's origin; memoised."""
    return _union_moments(_uncoloured(shapes), _stamps(shapes))


@lru_cache(maxsize=4096)
def _union_moments(shapes: tuple[Shape, ...], stamps: tuple[int, ...]) -> VolumeIntegrals:
    """The integrals while mesh files are as at their stamps."""
    del stamps
    total = VolumeIntegrals(0.0, np.zeros(3), np.zeros((3, 3)))
    for shape in shapes:
        total += _moments(shape)
    if not _may_overlap(shapes):
        return total
    solids = [_manifold(shape) for shape in shapes]
    apart = VolumeIntegrals(0.0, np.zeros(3), np.zeros((3, 3)))
    for solid in solids:
        apart += _mesh_moments(_as_trimesh(solid))
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    return total - (apart - _mesh_moments(_as_trimesh(union)))


def solid_mesh(geometry: Geometry) -> trimesh.Trimesh:
    """A closed triangle mesh of a geometry, in its own frame; open meshes become hulls."""
    mesh: trimesh.Trimesh
    match geometry:
        case Box(size):
            mesh = trimesh.creation.box(extents=size)
        case Sphere(radius):
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        case Cylinder(radius, length):
            mesh = trimesh.creation.cylinder(radius=radius, height=length, sections=_SEGMENTS)
        case Capsule(radius, length):
            mesh = trimesh.creation.capsule(radius=radius, height=length)
            mesh.apply_translation(-np.asarray(mesh.bounds).mean(axis=0))
        case Mesh():
            mesh = load_mesh(geometry)
            mesh = mesh if mesh.is_volume else convex_hull(geometry)
    return mesh


def bounding_box(shapes: Sequence[Shape]) -> Array:
    """Axis-aligned bounds of shapes in the link frame, shape (2, 3), metres; memoised."""
    return _bounding_box(_uncoloured(shapes), _stamps(shapes))


@lru_cache(maxsize=4096)
def _bounding_box(shapes: tuple[Shape, ...], stamps: tuple[int, ...]) -> Array:
    """The bounds while mesh files are as at their stamps."""
    del stamps
    corners = np.concatenate([_corners(shape) for shape in shapes])
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    bounds.setflags(write=False)
    return bounds


def _uncoloured(shapes: Sequence[Shape]) -> tuple[Shape, ...]:
    """Shapes without what does not matter to their volume."""
    return tuple(
        shape if shape.rgba is None else Shape(shape.geometry, shape.T_link_shape)
        for shape in shapes
    )


def _stamps(shapes: Sequence[Shape]) -> tuple[int, ...]:
    """When the mesh files of shapes were changed."""
    paths = [shape.geometry.path for shape in shapes if isinstance(shape.geometry, Mesh)]
    return tuple(path.stat().st_mtime_ns if path.is_file() else 0 for path in paths)


def _corners(shape: Shape) -> Array:
    match shape.geometry:
        case Box(size):
            low = -np.array(size) / 2
        case Sphere(radius):
            low = np.full(3, -radius)
        case Cylinder(radius, length):
            low = np.array([-radius, -radius, -length / 2])
        case Capsule(radius, length):
            low = np.array([-radius, -radius, -length / 2 - radius])
        case Mesh():
            corners = np.asarray(load_mesh(shape.geometry).vertices)
            T = shape.T_link_shape.matrix
            return np.asarray(corners @ T[:3, :3].T + T[:3, 3])
    corners = np.array(list(itertools.product(*zip(low, -low, strict=True))))
    T = shape.T_link_shape.matrix
    return np.asarray(corners @ T[:3, :3].T + T[:3, 3])


def _may_overlap(shapes: Sequence[Shape]) -> bool:
    boxes = [bounding_box([shape]) for shape in shapes]
    return any(
        bool(np.all(a[0] < b[1]) and np.all(b[0] < a[1]))
        for a, b in itertools.combinations(boxes, 2)
    )


def _moments(shape: Shape) -> VolumeIntegrals:
    geometry, T = shape.geometry, shape.T_link_shape.matrix
    if isinstance(geometry, Mesh):
        return _mesh_moments(_placed(shape))
    v = volume(geometry)
    R, p = T[:3, :3], T[:3, 3]
    local = np.diag(_central_second(geometry))
    return VolumeIntegrals(v, v * p, R @ local @ R.T + v * np.outer(p, p))


def _central_second(geometry: Box | Sphere | Cylinder | Capsule) -> tuple[float, float, float]:
    """Integrals of x^2, y^2, z^2 over a primitive about its centre, m^5."""
    v = volume(geometry)
    match geometry:
        case Box(size):
            return (v * size[0] ** 2 / 12, v * size[1] ** 2 / 12, v * size[2] ** 2 / 12)
        case Sphere(radius):
            return (v * radius**2 / 5,) * 3
        case Cylinder(radius, length):
            return (v * radius**2 / 4, v * radius**2 / 4, v * length**2 / 12)
        case Capsule(r, length):
            tube, caps = math.pi * r**2 * length, 4 / 3 * math.pi * r**3
            side = tube * r**2 / 4 + caps * r**2 / 5
            along = tube * length**2 / 12 + caps * (r**2 / 5 + length**2 / 4 + 3 / 8 * length * r)
            return (side, side, along)


def _mesh_moments(mesh: trimesh.Trimesh) -> VolumeIntegrals:
    v = float(mesh.volume)
    if v <= 0:
        return VolumeIntegrals(0.0, np.zeros(3), np.zeros((3, 3)))
    com = np.asarray(mesh.center_mass)
    inertia = np.asarray(mesh.moment_inertia) / mesh.density
    central = np.trace(inertia) / 2 * np.eye(3) - inertia
    return VolumeIntegrals(v, v * com, central + v * np.outer(com, com))


def _placed(shape: Shape) -> trimesh.Trimesh:
    mesh = solid_mesh(shape.geometry).copy()
    mesh.apply_transform(shape.T_link_shape.matrix)
    if mesh.volume < 0:
        mesh.invert()
    return mesh


def _manifold(shape: Shape) -> manifold3d.Manifold:
    mesh = _placed(shape)
    solid = _to_manifold(mesh)
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        solid = _to_manifold(mesh.convex_hull)
    return solid


def _to_manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    return manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.asarray(mesh.vertices, dtype=np.float64),
            tri_verts=np.asarray(mesh.faces, dtype=np.uint64),
        )
    )


def _as_trimesh(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False
    )
