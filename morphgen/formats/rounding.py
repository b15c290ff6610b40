"""A robot's numbers as files hold them: the same robot whether composed or read back.

Rounding twice is rounding once. Rotations are the hard ones, because a URDF has them as roll, pitch
and yaw: they are put on a grid that is coarser than what these twelve digits lose, so that the
rotation that is read back is on the same point of it.
"""

from __future__ import annotations

import math
from dataclasses import replace

from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Shape,
    Sphere,
)
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    Inertial,
    Joint,
    Link,
    Mimic,
    Robot,
)
from morphgen.model.rotation import Vec3, normalize

_TURN_DECIMALS = 10
"""Decimals of a quaternion over its largest entry. Three angles of 12 digits lose up to 1.5e-11."""
_LARGEST = 1e-6
"""Entries of a quaternion that are within it of the largest count as equal; the first is taken."""
_UNIT = 1e-9
"""How far the length of a unit axis may be from 1 once it was rounded."""


def format_number(value: float) -> str:
    """A number with 12 significant digits; what is smaller than 1e-12 is zero."""
    return "0" if abs(value) < 1e-12 else f"{value:.12g}"


def format_inertia(value: float) -> str:
    """Inertias of finger-sized bodies are far below ``number``'s zero."""
    return f"{value:.12g}" if abs(value) > 1e-18 else "0"


def round_number(value: float) -> float:
    """Return a number as files hold it: with 12 significant digits."""
    return float(format_number(value))


def rounded_pose(pose: Pose) -> Pose:
    """A pose whose rotation survives being written as roll, pitch and yaw.

    What is no rotation stays, for others to refuse.
    """
    entries = pose.quaternion
    most = max(map(abs, entries))
    if not all(map(math.isfinite, entries)) or most == 0:
        return pose
    lead = next(value for value in entries if abs(value) > most - _LARGEST)
    w, x, y, z = (round(value / lead, _TURN_DECIMALS) for value in entries)
    return Pose(_vector(pose.position), normalize((w, x, y, z)))


def rounded_axis(joint: Joint) -> Vec3:
    """The unit axis of a joint to 12 digits; one that was rounded before stays.

    Raises:
        RobotError: If the axis is zero.
    """
    is_unit = abs(math.hypot(*joint.axis) - 1) < _UNIT
    return _vector(joint.axis if is_unit else joint.unit_axis)


def urdf_pieces(shape: Shape) -> tuple[Shape, ...]:
    """A capsule, which URDF lacks, as a cylinder and two spheres; any other shape as itself."""
    if not isinstance(shape.geometry, Capsule):
        return (shape,)
    radius, length = shape.geometry.radius, shape.geometry.length
    T = shape.T_link_shape
    return (
        Shape(Cylinder(radius, length), T, shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, length / 2)), shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, -length / 2)), shape.rgba),
    )


def as_written(robot: Robot) -> Robot:
    """The robot that is read back from its bundle, meshes and all that is only seen apart.

    What a file must name and the robot leaves open has the default. The result does not change if
    it is taken again, or of the robot that was read back.

    Raises:
        RobotError: If an axis is zero.
    """
    return replace(
        robot,
        links=tuple(_link(link) for link in robot.links),
        joints=tuple(_joint(joint) for joint in robot.joints),
        frames=tuple(replace(f, T_link_frame=rounded_pose(f.T_link_frame)) for f in robot.frames),
        home=tuple(map(round_number, robot.home)),
    )


def rounded_shapes(shapes: tuple[Shape, ...]) -> tuple[Shape, ...]:
    """Shapes as a URDF holds them; meshes keep their files and scales."""
    return tuple(
        replace(
            piece, geometry=_geometry(piece.geometry), T_link_shape=rounded_pose(piece.T_link_shape)
        )
        for shape in shapes
        for piece in urdf_pieces(shape)
    )


def _link(link: Link) -> Link:
    return replace(
        link,
        inertial=_inertial(link.inertial),
        collisions=rounded_shapes(link.collisions),
    )


def _inertial(body: Inertial | None) -> Inertial | None:
    if body is None or body.mass == 0:
        return None
    xx, xy, xz, yy, yz, zz = (float(format_inertia(value)) for value in body.inertia)
    return Inertial(round_number(body.mass), _vector(body.com), (xx, xy, xz, yy, yz, zz))


def _geometry(geometry: Geometry) -> Geometry:
    match geometry:
        case Box(size):
            return Box(_vector(size))
        case Sphere(radius):
            return Sphere(round_number(radius))
        case Cylinder(radius, length):
            return Cylinder(round_number(radius), round_number(length))
        case Capsule() | Mesh():
            return geometry


def _joint(joint: Joint) -> Joint:
    placed = rounded_pose(joint.T_parent_joint)
    if not joint.is_movable:
        return Joint(joint.name, joint.kind, joint.parent, joint.child, placed)
    endless = joint.kind == "continuous" or (joint.kind == "revolute" and joint.limits is None)
    limits = None if endless or joint.limits is None else joint.limits
    return Joint(
        joint.name,
        "continuous" if endless else joint.kind,
        joint.parent,
        joint.child,
        placed,
        rounded_axis(joint),
        limits and (round_number(limits[0]), round_number(limits[1])),
        DEFAULT_EFFORT if joint.effort is None else round_number(joint.effort),
        DEFAULT_VELOCITY if joint.velocity is None else round_number(joint.velocity),
        round_number(joint.damping),
        round_number(joint.friction),
        joint.mimic and _mimic(joint.mimic),
    )


def _mimic(mimic: Mimic) -> Mimic:
    return Mimic(mimic.joint, round_number(mimic.multiplier), round_number(mimic.offset))


def _vector(vector: Vec3) -> Vec3:
    x, y, z = map(round_number, vector)
    return (x, y, z)
