"""Poses and shapes: what a link looks like and what it collides with."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.model import rotation
from morphgen.model.rotation import Quat, Vec3
from morphgen.typing import Array

Rgba = tuple[float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """A rigid transform. Named ``T_a_b``, it maps coordinates in frame b to frame a."""

    position: Vec3 = (0.0, 0.0, 0.0)
    """Origin of b in a, metres."""
    quaternion: Quat = rotation.IDENTITY
    """Rotation of b in a: (w, x, y, z), unit length, w >= 0."""

    @classmethod
    def from_xyz_rpy(cls, xyz: Vec3 = (0, 0, 0), rpy: Vec3 = (0, 0, 0)) -> Pose:
        """Pose of a URDF ``<origin xyz rpy>``."""
        return cls((float(xyz[0]), float(xyz[1]), float(xyz[2])), rotation.from_rpy(rpy))

    @classmethod
    def from_matrix(cls, matrix: Array) -> Pose:
        """Pose of a (4, 4) homogeneous matrix."""
        rows = matrix[:3, :3].tolist()
        x, y, z = matrix[:3, 3].tolist()
        return cls(
            (x, y, z), rotation.from_matrix((tuple(rows[0]), tuple(rows[1]), tuple(rows[2])))
        )

    @cached_property
    def matrix(self) -> Array:
        """The (4, 4) homogeneous matrix; treat it as read-only."""
        matrix = np.eye(4)
        matrix[:3, :3] = rotation.to_matrix(self.quaternion)
        matrix[:3, 3] = self.position
        matrix.setflags(write=False)
        return matrix

    @property
    def rpy(self) -> Vec3:
        """URDF's roll, pitch, yaw, radians."""
        return rotation.to_rpy(self.quaternion)

    @property
    def is_identity(self) -> bool:
        """Whether the pose moves nothing."""
        return self.position == (0.0, 0.0, 0.0) and self.quaternion == rotation.IDENTITY

    def inverse(self) -> Pose:
        """The transform from a to b."""
        inverse = rotation.conjugate(self.quaternion)
        x, y, z = rotation.rotate(inverse, self.position)
        return Pose((-x, -y, -z), rotation.normalize(inverse))

    def apply(self, point: Vec3) -> Vec3:
        """Coordinates in a of a point given in b."""
        x, y, z = rotation.rotate(self.quaternion, point)
        return (self.position[0] + x, self.position[1] + y, self.position[2] + z)

    def __matmul__(self, other: Pose) -> Pose:
        """Chain transforms: ``T_a_b @ T_b_c`` is ``T_a_c``."""
        return Pose(
            self.apply(other.position), rotation.multiply(self.quaternion, other.quaternion)
        )


IDENTITY = Pose()


@dataclass(frozen=True)
class Box:
    """A box centred on its frame."""

    size: Vec3
    """Full edge lengths, metres."""


@dataclass(frozen=True)
class Sphere:
    """A sphere centred on its frame."""

    radius: float


@dataclass(frozen=True)
class Cylinder:
    """A cylinder centred on its frame, along z."""

    radius: float
    length: float


@dataclass(frozen=True)
class Capsule:
    """A capsule centred on its frame, along z."""

    radius: float
    length: float
    """Length of the cylindrical part, without the two caps."""


@dataclass(frozen=True)
class Mesh:
    """A reference to triangles in a file; ``morphgen.model.mesh.load_mesh`` reads them."""

    path: Path
    scale: Vec3 = (1.0, 1.0, 1.0)
    part: int | None = None
    """One colour group of the file, or None for all of it."""


Primitive = Box | Sphere | Cylinder | Capsule
Geometry = Primitive | Mesh


@dataclass(frozen=True)
class Shape:
    """A geometry placed on a link."""

    geometry: Geometry
    T_link_shape: Pose = IDENTITY
    rgba: Rgba | None = None
    """Colour, each in [0, 1]; None where the source names none."""


def volume(primitive: Primitive) -> float:
    """Volume of a primitive, cubic metres."""
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
    """The numbers that define a primitive's size, metres."""
    match primitive:
        case Box(size):
            return size
        case Sphere(radius):
            return (radius,)
        case Cylinder(radius, length) | Capsule(radius, length):
            return (radius, length)


def scale_shape(shape: Shape, factor: float) -> Shape:
    """Return the shape scaled uniformly about the origin of its link's frame."""
    return replace(
        shape,
        geometry=_geometry(shape.geometry, factor),
        T_link_shape=scale_pose(shape.T_link_shape, factor),
    )


def _geometry(geometry: Geometry, factor: float) -> Geometry:
    match geometry:
        case Box(size):
            return Box(scale_vector(size, factor))
        case Sphere(radius):
            return Sphere(factor * radius)
        case Cylinder(radius, length):
            return Cylinder(factor * radius, factor * length)
        case Capsule(radius, length):
            return Capsule(factor * radius, factor * length)
        case Mesh():
            return replace(geometry, scale=scale_vector(geometry.scale, factor))


def scale_pose(pose: Pose, factor: float) -> Pose:
    """Return the pose with its position multiplied by a factor."""
    return pose if factor == 1.0 else Pose(scale_vector(pose.position, factor), pose.quaternion)


def scale_vector(vector: Vec3, factor: float) -> Vec3:
    """Return the vector multiplied by a factor."""
    return (factor * vector[0], factor * vector[1], factor * vector[2])


@dataclass(frozen=True)
class StoredFit:
    """The fit of a link's collision shapes, in the link frame."""

    link: str
    token: Shape
    """The one primitive that overlaps most."""
    collision: tuple[Shape, ...]
    """A few, for physics."""
    token_iou: float
    collision_iou: float

    def scaled(self, factor: float) -> StoredFit:
        """The fit of the shapes, larger or smaller."""
        return replace(
            self,
            token=scale_shape(self.token, factor),
            collision=tuple(scale_shape(shape, factor) for shape in self.collision),
        )


StoredFits = Mapping[str, StoredFit]
"""Fits by ``morphgen.formats.fits.shapes_key``: a hash of the shapes that were fitted."""
