"""Round a robot's numbers as its files do, so that a composed robot equals the one read back.

Rounding is idempotent. That is difficult for rotations only, because a URDF holds them as roll,
pitch and yaw with twelve digits. They are rounded to a grid of quaternions that is coarser than the
error of these digits, so that the rotation read back rounds to the same point of the grid.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

from morphgen.model.geometry import Geometry, Mesh, Pose, Shape, map_dimensions
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY, Inertial, Joint, Mimic, Robot
from morphgen.model.rotation import Vec3, unit_quaternion, vec3

_ROTATION_DECIMALS = 10
"""Decimals of a quaternion divided by its largest entry; angles of 12 digits err up to 1.5e-11."""
_TIE_TOLERANCE = 1e-6
"""Entries of a quaternion that differ by less from the largest count as equal to it."""
_UNIT_TOLERANCE = 1e-9  # largest difference of a rounded unit axis's length from 1


INERTIA_NAMES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
"""Names of the entries of ``Inertial.inertia`` in URDF and SDFormat, in their order."""


def format_number(value: float) -> str:
    """Return a number with 12 significant digits; magnitudes below 1e-12 are zero."""
    return "0" if abs(value) < 1e-12 else f"{value:.12g}"


def format_numbers(values: Iterable[float]) -> str:
    """Return numbers as ``format_number`` does, separated by spaces."""
    return " ".join(map(format_number, values))


def format_inertia(value: float) -> str:
    """Return an inertia with 12 digits; those of fingers are far below ``format_number``'s zero."""
    return "0" if abs(value) <= 1e-18 else f"{value:.12g}"


def round_number(value: float) -> float:
    """Return a number as files hold it: with 12 significant digits."""
    return float(format_number(value))


def rounded_pose(pose: Pose) -> Pose:
    """Round a pose so that writing its rotation as roll, pitch and yaw does not change it.

    An invalid rotation is returned unchanged; the checks report it.
    """
    entries = pose.quaternion
    largest = max(map(abs, entries))
    if not all(map(math.isfinite, entries)) or largest == 0:
        return pose
    # The first of nearly equal entries, so that rounding errors do not change the choice.
    lead = next(value for value in entries if abs(value) > largest - _TIE_TOLERANCE)
    rounded = (round(value / lead, _ROTATION_DECIMALS) for value in entries)
    return Pose(_vector(pose.position), unit_quaternion(rounded))


def rounded_axis(joint: Joint) -> Vec3:
    """Return the unit axis of a joint with 12 digits; a rounded one is not normalised again."""
    is_unit = abs(math.hypot(*joint.axis) - 1) < _UNIT_TOLERANCE
    return _vector(joint.axis if is_unit else joint.unit_axis)


def as_written(robot: Robot) -> Robot:
    """Return the robot as read back from its bundle, except for meshes and visual shapes.

    Values that a file must contain and the robot does not specify get their default. The function
    is idempotent, and gives the same for the robot that was read back.
    """
    return replace(
        robot,
        links=tuple(
            replace(
                link, inertial=_inertial(link.inertial), collisions=rounded_shapes(link.collisions)
            )
            for link in robot.links
        ),
        joints=tuple(_joint(joint) for joint in robot.joints),
        frames=tuple(replace(f, T_link_frame=rounded_pose(f.T_link_frame)) for f in robot.frames),
        home=tuple(map(round_number, robot.home)),
    )


def rounded_shapes(shapes: tuple[Shape, ...]) -> tuple[Shape, ...]:
    """Return shapes as a URDF holds them; meshes keep their files and scales."""
    return tuple(
        replace(
            shape, geometry=_geometry(shape.geometry), T_link_shape=rounded_pose(shape.T_link_shape)
        )
        for shape in shapes
    )


def _inertial(inertial: Inertial | None) -> Inertial | None:
    if inertial is None or inertial.mass == 0:
        return None
    xx, xy, xz, yy, yz, zz = (float(format_inertia(value)) for value in inertial.inertia)
    return Inertial(round_number(inertial.mass), _vector(inertial.com), (xx, xy, xz, yy, yz, zz))


def _geometry(geometry: Geometry) -> Geometry:
    return geometry if isinstance(geometry, Mesh) else map_dimensions(round_number, geometry)


def _joint(joint: Joint) -> Joint:
    T_parent_joint = rounded_pose(joint.T_parent_joint)
    if not joint.is_movable:
        return Joint(joint.name, joint.kind, joint.parent, joint.child, T_parent_joint)
    limits = None if joint.is_continuous else joint.limits
    mimic = joint.mimic
    return replace(
        joint,
        kind="continuous" if joint.is_continuous else joint.kind,
        T_parent_joint=T_parent_joint,
        axis=rounded_axis(joint),
        limits=limits and (round_number(limits[0]), round_number(limits[1])),
        effort=round_number(DEFAULT_EFFORT if joint.effort is None else joint.effort),
        velocity=round_number(DEFAULT_VELOCITY if joint.velocity is None else joint.velocity),
        damping=round_number(joint.damping),
        friction=round_number(joint.friction),
        mimic=mimic
        and Mimic(mimic.joint, round_number(mimic.multiplier), round_number(mimic.offset)),
    )


def _vector(vector: Vec3) -> Vec3:
    return vec3(map(round_number, vector))
