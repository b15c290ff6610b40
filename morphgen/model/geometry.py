"""Poses, primitives, meshes, and shapes: geometries at a pose on a link."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from morphgen.model import rotation
from morphgen.model.rotation import Quat, Vec3
from morphgen.typing import Array

Rgba = tuple[float, float, float, float]

MESH_SUFFIXES = (".dae", ".obj", ".stl")
"""Suffixes of the mesh files that can be read, in lower case."""


@dataclass(frozen=True)
class Pose:
    """A rigid transform. Named ``T_a_b``, it maps coordinates in frame b to frame a."""

    position: Vec3 = (0.0, 0.0, 0.0)
    """Origin of frame b in frame a [m]."""
    quaternion: Quat = rotation.IDENTITY
    """Rotation of frame b in frame a: (w, x, y, z), unit length, w >= 0."""

    @classmethod
    def from_xyz_rpy(cls, xyz: Vec3 = (0, 0, 0), rpy: Vec3 = (0, 0, 0)) -> Pose:
        """Build from the position [m] and roll-pitch-yaw [rad] of a URDF ``<origin>``."""
        return cls(rotation.vec3(xyz), rotation.from_rpy(rpy))

    @classmethod
    def from_matrix(cls, matrix: Array) -> Pose:
        """Build from a (4, 4) homogeneous matrix."""
        rows = matrix[:3, :3].tolist()
        return cls(rotation.vec3(matrix[:3, 3].tolist()), rotation.from_matrix(rows))

    @cached_property
    def matrix(self) -> Array:
        """The homogeneous matrix, shape (4, 4), read-only."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.to_matrix(self.quaternion)
        matrix[:3, 3] = self.position
        matrix.setflags(write=False)
        return matrix

    @property
    def rpy(self) -> Vec3:
        """Roll, pitch and yaw as in URDF [rad]."""
        return rotation.to_rpy(self.quaternion)

    @property
    def is_identity(self) -> bool:
        """Whether the pose is exactly the identity."""
        return self.position == (0.0, 0.0, 0.0) and self.quaternion == rotation.IDENTITY

    def inverse(self) -> Pose:
        """Return ``T_b_a`` for ``T_a_b``."""
        w, i, j, k = self.quaternion
        inverse = (w, -i, -j, -k)
        x, y, z = rotation.rotate(inverse, self.position)
        return Pose((-x, -y, -z), rotation.normalize(inverse))

    def apply(self, point: Vec3) -> Vec3:
        """Transform a point from frame b to frame a."""
        x, y, z = rotation.rotate(self.quaternion, point)
        return (self.position[0] + x, self.position[1] + y, self.position[2] + z)

    def __matmul__(self, other: Pose) -> Pose:
        """Compose transforms: ``T_a_b @ T_b_c`` is ``T_a_c``."""
        return Pose(
            self.apply(other.position), rotation.multiply(self.quaternion, other.quaternion)
        )


IDENTITY = Pose()


@dataclass(frozen=True)
class Box:
    """A box centred on its frame."""

    size: Vec3
    """Edge lengths along x, y and z [m]."""


@dataclass(frozen=True)
class Sphere:
    """A sphere centred on its frame."""

    radius: float
    """Radius [m]."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred on its frame, along z."""

    radius: float
    """Radius [m]."""
    length: float
    """Length along z [m]."""


@dataclass(frozen=True)
class Capsule:
    """A capsule centred on its frame, along z."""

    radius: float
    """Radius [m]."""
    length: float
    """Length of the cylindrical part, without the two caps [m]."""


@dataclass(frozen=True)
class Mesh:
    """A reference to a mesh file, which ``morphgen.model.mesh.load_mesh`` reads."""

    path: Path
    scale: Vec3 = (1.0, 1.0, 1.0)
    """Scale factors along x, y and z; negative ones mirror the mesh."""
    part: int | None = None
    """Index of one colour of the file (see ``mesh_parts``); None for the whole file."""


class MeshPart(NamedTuple):
    """Triangles of a mesh file that share a colour."""

    rgba: Rgba | None
    """Colour, each channel in [0, 1], the mean of a texture; None if the file names none."""
    vertices: Array  # shape (n, 3) [m]
    faces: NDArray[np.int64]  # shape (m, 3)


@dataclass(frozen=True)
class MeshContent:
    """The content of a mesh file."""

    parts: tuple[MeshPart, ...]  # one for each geometry
    left_out: tuple[str, ...]
    """Content that was not read, each a phrase with a count, such as ``3 line sets``."""
    pixels: int  # number of pixels of the textures that were read, each use counted
    self_contained: bool  # whether the file names no other file


Primitive = Box | Sphere | Cylinder | Capsule
Geometry = Primitive | Mesh


@dataclass(frozen=True)
class Shape:
    """A geometry at a pose on a link."""

    geometry: Geometry
    T_link_shape: Pose = IDENTITY
    rgba: Rgba | None = None
    """Colour, each channel in [0, 1]; None if the source names none."""


def volume(primitive: Primitive) -> float:
    """Return the volume of a primitive [m^3]."""
    match primitive:
        case Box(size):
            return size[0] * size[1] * size[2]
        case Sphere(radius):
            return 4 / 3 * math.pi * radius**3
        case Cylinder(radius, length):
            return math.pi * radius**2 * length
        case Capsule(radius, length):
            return math.pi * radius**2 * (length + 4 / 3 * radius)


def dimensions(primitive: Primitive) -> tuple[float, ...]:
    """Return the edge lengths, the radius, or the radius and the length of a primitive [m]."""
    match primitive:
        case Box(size):
            return size
        case Sphere(radius):
            return (radius,)
        case Cylinder(radius, length) | Capsule(radius, length):
            return (radius, length)


def half_extents(primitive: Primitive) -> Vec3:
    """Return the half extents of a primitive along its own axes [m]."""
    match primitive:
        case Box((x, y, z)):
            return (x / 2, y / 2, z / 2)
        case Sphere(radius):
            return (radius, radius, radius)
        case Cylinder(radius, length):
            return (radius, radius, length / 2)
        case Capsule(radius, length):
            return (radius, radius, length / 2 + radius)


def map_dimensions(function: Callable[[float], float], primitive: Primitive) -> Primitive:
    """Return the primitive whose ``dimensions`` are those of another one after a function."""
    sizes = map(function, dimensions(primitive))
    if isinstance(primitive, Box):
        return Box(rotation.vec3(sizes))
    return type(primitive)(*sizes)


def scale_shape(shape: Shape, factor: float) -> Shape:
    """Return the shape scaled uniformly about the origin of its link's frame."""
    geometry: Geometry
    if isinstance(shape.geometry, Mesh):
        geometry = replace(shape.geometry, scale=scale_vector(shape.geometry.scale, factor))
    else:
        geometry = map_dimensions(lambda size: factor * size, shape.geometry)
    return replace(shape, geometry=geometry, T_link_shape=scale_pose(shape.T_link_shape, factor))


def scale_pose(pose: Pose, factor: float) -> Pose:
    """Return the pose with its position scaled and its rotation unchanged."""
    return pose if factor == 1.0 else Pose(scale_vector(pose.position, factor), pose.quaternion)


def scale_vector(vector: Vec3, factor: float) -> Vec3:
    """Return the vector multiplied by a factor."""
    return (factor * vector[0], factor * vector[1], factor * vector[2])


@dataclass(frozen=True)
class StoredFit:
    """Primitives fitted to a link's collision shapes; all shapes are in the link frame."""

    link: str  # name of the link
    token: Shape  # the single primitive with the largest overlap, for tokens
    collision: tuple[Shape, ...]
    """A few primitives that approximate the shapes more closely, for physics."""
    token_iou: float  # intersection over union of ``token`` with the shapes, in [0, 1]
    collision_iou: float  # intersection over union of ``collision`` with the shapes, in [0, 1]

    def scaled(self, factor: float) -> StoredFit:
        """Return the fit of the shapes scaled by a factor."""
        return replace(
            self,
            token=scale_shape(self.token, factor),
            collision=tuple(scale_shape(shape, factor) for shape in self.collision),
        )


StoredFits = Mapping[str, StoredFit]
"""Fits by ``morphgen.formats.fits.shapes_key``, a hash of the fitted shapes."""
