"""Mass properties, solid meshes and bounding boxes of shapes, and cameras that see them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from morphgen.errors import RobotError
from morphgen.files import kept
from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Primitive,
    Shape,
    Sphere,
    dimensions,
    half_extents,
    volume,
)
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.mesh import Triangles, convex_hull, load_mesh, mesh_key, mesh_triangles
from morphgen.model.robot import Inertial, Link, Robot
from morphgen.model.rotation import vec3
from morphgen.typing import Array

if TYPE_CHECKING:
    import manifold3d
    import trimesh

_CYLINDER_SECTIONS = 48  # number of sides of a tessellated cylinder
_CORNER_SIGNS = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
"""Signs of the eight corners of a box, shape (8, 3)."""


def inertial_from_density(shapes: Sequence[Shape], density: float) -> Inertial:
    """Return the mass properties of solid shapes of one density [kg/m^3], overlaps counted once.

    Primitives use closed forms; an open mesh counts as its convex hull. The overlap of shapes is
    measured on their tessellations by exact booleans.
    """
    moments = _union_moments(*_cache_key(shapes))
    volume = float(moments[3, 3])
    if volume <= 0:
        return Inertial(0.0)
    com = moments[:3, 3] / volume
    central = moments[:3, :3] - volume * np.outer(com, com)
    inertia = density * (np.trace(central) * np.eye(3) - central)
    return Inertial.from_matrix(density * volume, vec3(com.tolist()), inertia)


def with_inertia(link: Link, density: float) -> Link:
    """Return the link with the mass properties of its collision shapes, else visuals, if any."""
    shapes = link.solid_shapes
    return replace(link, inertial=inertial_from_density(shapes, density)) if shapes else link


def inertial_from_mass(link: Link, mass: float) -> Inertial:
    """Return the mass properties of a link's shapes with uniform density and a given mass [kg]."""
    unit = inertial_from_density(link.solid_shapes, 1.0)
    if unit.mass <= 0:
        raise RobotError(f"link {link.name!r} has no volume to give {mass:g} kg an inertia")
    return Inertial.from_matrix(mass, unit.com, unit.matrix * (mass / unit.mass))


def union_volume(shapes: Sequence[Shape]) -> float:
    """Return the volume of the union of shapes [m^3]; cached until a mesh file changes."""
    return float(_union_moments(*_cache_key(shapes))[3, 3])


@lru_cache(maxsize=4096)
def _union_moments(shapes: tuple[Shape, ...], _stamps: tuple[int, ...]) -> Array:
    """Return the integral of (x, 1) (x, 1)^T over a union, about the link's origin, (4, 4).

    It holds the second moments [m^5], the first ones [m^4] and the volume [m^3].
    """
    key = [
        (_geometry_key(shape.geometry), shape.T_link_shape.position, shape.T_link_shape.quaternion)
        for shape in shapes
    ]
    is_known = all(geometry is not None for geometry, _, _ in key)
    if not is_known or not any(isinstance(shape.geometry, Mesh) for shape in shapes):
        return _make_moments(shapes)
    return kept("moments", key, lambda: _make_moments(shapes))


def _geometry_key(geometry: Geometry) -> tuple[object, ...] | None:
    """Return what identifies a geometry; None for a mesh of which nothing is kept."""
    if isinstance(geometry, Mesh):
        return mesh_key(geometry)
    return (type(geometry).__name__, *dimensions(geometry))


def _make_moments(shapes: tuple[Shape, ...]) -> Array:
    total = sum(map(_moments, shapes), np.zeros((4, 4)))
    boxes = [bounding_box([shape]) for shape in shapes]
    if not any(
        np.all(a[0] < b[1]) and np.all(b[0] < a[1]) for a, b in itertools.combinations(boxes, 2)
    ):
        return total  # boxes apart: nothing counts twice, and closed forms are exact
    import manifold3d  # here, because it is seldom needed and takes time to load

    # Closed forms are exact, but booleans are not defined on them: subtract only the overlap,
    # which is the difference between the separate tessellations and their union.
    solids = [_manifold(shape) for shape in shapes]
    separate = sum((_mesh_moments(_from_manifold(s)) for s in solids), np.zeros((4, 4)))
    union = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    return np.asarray(total - (separate - _mesh_moments(_from_manifold(union))))


def solid_mesh(geometry: Geometry) -> trimesh.Trimesh:
    """Return a closed triangle mesh of a geometry, in its own frame; open meshes become hulls."""
    import trimesh  # here, because commands that read no mesh should start quickly

    mesh: trimesh.Trimesh
    match geometry:
        case Box(size):
            mesh = trimesh.creation.box(extents=size)
        case Sphere(radius):
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        case Cylinder(radius, length):
            mesh = trimesh.creation.cylinder(
                radius=radius, height=length, sections=_CYLINDER_SECTIONS
            )
        case Capsule(radius, length):
            mesh = trimesh.creation.capsule(radius=radius, height=length)
            # trimesh has one end of the axis at the origin.
            mesh.apply_translation(-np.asarray(mesh.bounds).mean(axis=0))
        case Mesh():
            mesh = load_mesh(geometry)
            mesh = mesh if mesh.is_volume else convex_hull(geometry)
    return mesh


def solid_triangles(geometry: Geometry) -> Triangles:
    """Return triangles of a mesh file or of a primitive; spheres differ from ``solid_mesh``."""
    if isinstance(geometry, Mesh):
        return mesh_triangles(geometry)
    if isinstance(geometry, Capsule):
        mesh = solid_mesh(geometry)
        return Triangles(np.array(mesh.vertices), np.array(mesh.faces))
    vertices, faces = _unit_solid(type(geometry).__name__)
    sizes = dimensions(geometry)
    scale = {1: sizes * 3, 2: (sizes[0], *sizes)}.get(len(sizes), sizes)
    return Triangles(vertices * scale, faces)


@lru_cache(maxsize=3)
def _unit_solid(kind: str) -> Triangles:
    """Return the triangles of a primitive whose dimensions are all 1, from the user's cache."""

    def make() -> Triangles:
        units = (Box((1.0, 1.0, 1.0)), Sphere(1.0), Cylinder(1.0, 1.0))
        mesh = solid_mesh(next(unit for unit in units if type(unit).__name__ == kind))
        return Triangles(np.array(mesh.vertices), np.array(mesh.faces))

    return kept("solid", (kind,), make, (Triangles,))


def link_frame_mesh(shape: Shape) -> trimesh.Trimesh:
    """Return a copy of a shape's triangles in the link frame; open meshes stay open."""
    geometry = shape.geometry
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    return mesh.copy().apply_transform(shape.T_link_shape.matrix)


def bounding_box(shapes: Sequence[Shape]) -> Array:
    """Return kept, read-only bounds of shapes in the link frame, shape (2, 3) [m]."""
    return _bounding_box(*_cache_key(shapes))


def box_corners(low: ArrayLike, high: ArrayLike) -> Array:
    """Return the corners (8, 3) of an axis-aligned box, from the lowest and the highest [m]."""
    sides = np.stack([np.asarray(low), np.asarray(high)], axis=1)
    return np.array(np.meshgrid(*sides)).reshape(3, -1).T


def robot_corners(robot: Robot, q: ArrayLike) -> Array:
    """Return corners of boxes around links, as they look, in the root frame: (..., n, 3) [m].

    The joint positions q have the shape (..., dof) [rad or m].
    """
    T_root_link = forward_kinematics(robot, q)
    corners = [np.zeros((*T_root_link.shape[:-3], 0, 3))]
    for i, link in enumerate(robot.links):
        if shapes := link.visuals or link.collisions:
            R, p = T_root_link[..., i, :3, :3], T_root_link[..., i, None, :3, 3]
            corners.append(box_corners(*bounding_box(shapes)) @ R.swapaxes(-1, -2) + p)
    return np.concatenate(corners, axis=-2)


def fit_camera(points: Array, tangents: Array) -> Array:
    """Return the foremost camera, centred on points (n, 3), that has all of them in its picture.

    All are in the camera's axes: right, up, forward [m]. A point is in the picture if its offset
    from the camera to the right and up is at most its distance times the tangents (2,).
    """
    # Each axis has two such bounds, on the farthest points to both sides. The camera's offset is
    # between them, and the stricter axis decides its distance.
    after = (points[:, :2] - tangents * points[:, 2:]).max(axis=0)
    before = (-points[:, :2] - tangents * points[:, 2:]).max(axis=0)
    forward = float((-(after + before) / (2 * tangents)).min())
    return np.array([*((after - before) / 2), forward])


@lru_cache(maxsize=4096)
def _bounding_box(shapes: tuple[Shape, ...], _stamps: tuple[int, ...]) -> Array:
    corners = np.concatenate([_corners(shape) for shape in shapes])
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    box.setflags(write=False)
    return box


def _cache_key(shapes: Sequence[Shape]) -> tuple[tuple[Shape, ...], tuple[int, ...]]:
    """Return the shapes without their colours, and the modification times of their meshes."""
    paths = [shape.geometry.path for shape in shapes if isinstance(shape.geometry, Mesh)]
    return (
        tuple(
            shape if shape.rgba is None else Shape(shape.geometry, shape.T_link_shape)
            for shape in shapes
        ),
        tuple(path.stat().st_mtime_ns if path.is_file() else 0 for path in paths),
    )


def _corners(shape: Shape) -> Array:
    """Return the corners of a primitive's bounding box, or a mesh's vertices, in the link frame."""
    if isinstance(shape.geometry, Mesh):
        corners = mesh_triangles(shape.geometry).vertices
    else:
        corners = _CORNER_SIGNS * half_extents(shape.geometry)
    T = shape.T_link_shape.matrix
    return np.asarray(corners @ T[:3, :3].T + T[:3, 3])


def _moments(shape: Shape) -> Array:
    geometry, T = shape.geometry, shape.T_link_shape.matrix
    if isinstance(geometry, Mesh):
        return _mesh_moments(_mesh_in_link(shape))
    v = volume(geometry)
    R, p = T[:3, :3], T[:3, 3]
    central = np.diag(_central_second(geometry))
    return _moment_matrix(v, v * p, R @ central @ R.T + v * np.outer(p, p))


def _moment_matrix(volume: float, first: Array, second: Array) -> Array:
    return np.block([[second, first[:, None]], [first, volume]])


def _central_second(primitive: Primitive) -> tuple[float, float, float]:
    """Return the integrals of x^2, y^2, z^2 over a primitive about its centre [m^5]."""
    v = volume(primitive)
    match primitive:
        case Box(size):
            return (v * size[0] ** 2 / 12, v * size[1] ** 2 / 12, v * size[2] ** 2 / 12)
        case Sphere(radius):
            return (v * radius**2 / 5,) * 3
        case Cylinder(radius, length):
            return (v * radius**2 / 4, v * radius**2 / 4, v * length**2 / 12)
        case Capsule(r, length):
            # A cylinder and two half balls, whose centroids are 3/8 r beyond the cylinder's ends.
            tube, caps = math.pi * r**2 * length, 4 / 3 * math.pi * r**3
            side = tube * r**2 / 4 + caps * r**2 / 5
            along = tube * length**2 / 12 + caps * (r**2 / 5 + length**2 / 4 + 3 / 8 * length * r)
            return (side, side, along)


def _mesh_moments(mesh: trimesh.Trimesh) -> Array:
    v = float(mesh.volume)
    if v <= 0:
        return np.zeros((4, 4))
    com = np.asarray(mesh.center_mass)
    inertia = np.asarray(mesh.moment_inertia) / mesh.density
    central = np.trace(inertia) / 2 * np.eye(3) - inertia  # inverse of I = tr(C) 1 - C
    return _moment_matrix(v, v * com, central + v * np.outer(com, com))


def _mesh_in_link(shape: Shape) -> trimesh.Trimesh:
    mesh = solid_mesh(shape.geometry).copy()
    mesh.apply_transform(shape.T_link_shape.matrix)
    if mesh.volume < 0:  # the transform or the file turned it inside out
        mesh.invert()
    return mesh


def _manifold(shape: Shape) -> manifold3d.Manifold:
    """Return a shape as a manifold; a mesh that is not one becomes its convex hull."""
    import manifold3d

    mesh = _mesh_in_link(shape)
    solid = _to_manifold(mesh)
    if solid.status() != manifold3d.Error.NoError or solid.is_empty():
        solid = _to_manifold(mesh.convex_hull)
    return solid


def _to_manifold(mesh: trimesh.Trimesh) -> manifold3d.Manifold:
    import manifold3d

    return manifold3d.Manifold(
        manifold3d.Mesh64(
            vert_properties=np.asarray(mesh.vertices, dtype=np.float64),
            tri_verts=np.asarray(mesh.faces, dtype=np.uint64),
        )
    )


def _from_manifold(solid: manifold3d.Manifold) -> trimesh.Trimesh:
    import trimesh

    mesh = solid.to_mesh64()
    return trimesh.Trimesh(
        np.asarray(mesh.vert_properties)[:, :3], np.asarray(mesh.tri_verts), process=False
    )
