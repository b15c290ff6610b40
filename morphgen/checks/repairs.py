"""Safe repairs of a robot: those that need no decision by the user."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from morphgen.checks.inertia import (
    DEFAULT_DENSITY,
    inertia_fault,
    is_inertia_without_mass,
    is_mass_valid,
    lacks_mass,
)
from morphgen.checks.joints import (
    has_inverted_limits,
    is_axis_unit,
    is_axis_valid,
    is_locked,
    is_positive,
    position_range,
)
from morphgen.checks.loaders import all_names, safe_names, safe_robot_name, unit_density_inertial
from morphgen.model.inertia import with_inertia
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    Inertial,
    Joint,
    Link,
    Robot,
)
from morphgen.model.tree import rename, rigid_groups


def repaired(robot: Robot) -> Robot:
    """Return a robot in which every fixable finding is repaired and all else is unchanged."""
    moving = {
        link.name for group in rigid_groups(robot) if not group.is_root for link in group.links
    }
    locked = {joint.name for joint in robot.joints if is_locked(robot, joint)}
    joints = tuple(_repair_joint(joint, locked=joint.name in locked) for joint in robot.joints)
    home = tuple(
        _nearest_position(joints[k], position)
        for k, position in zip(robot.independent_joints, robot.home, strict=True)
        if joints[k].name not in locked
    )
    links = tuple(_repair_link(link, moves=link.name in moving) for link in robot.links)
    return _repair_names(replace(robot, links=links, joints=joints, home=home))


def _repair_link(link: Link, *, moves: bool) -> Link:
    inertial = link.inertial
    if is_inertia_without_mass(link):
        return replace(link, inertial=Inertial(0.0))
    invalid = inertial is not None and not is_mass_valid(inertial)
    if invalid or (moves and lacks_mass(link)):
        return (
            with_inertia(link, DEFAULT_DENSITY) if unit_density_inertial(link) is not None else link
        )
    if inertial is None or inertial.mass == 0 or inertia_fault(inertial) is None:
        return link
    solid, mass = unit_density_inertial(link), inertial.mass
    if solid is None:  # the inertia of a ball with the same mass and the default density
        radius = (3 * mass / (4 * math.pi * DEFAULT_DENSITY)) ** (1 / 3)
        inertia = 0.4 * mass * radius**2 * np.eye(3)
    else:
        inertia = mass / solid.mass * solid.matrix
    return replace(link, inertial=Inertial.from_matrix(mass, inertial.com, inertia))


def _repair_joint(joint: Joint, *, locked: bool) -> Joint:
    if locked:
        return Joint(joint.name, "fixed", joint.parent, joint.child, joint.T_parent_joint)
    if not joint.is_movable:
        return joint
    if is_axis_valid(joint) and not is_axis_unit(joint):
        joint = replace(joint, axis=joint.unit_axis)
    if joint.kind == "continuous" and joint.limits is not None:
        joint = replace(joint, limits=None)
    if has_inverted_limits(joint):
        joint = replace(joint, limits=position_range(joint))
    if joint.is_independent and not is_positive(joint.effort):
        joint = replace(joint, effort=DEFAULT_EFFORT)
    if joint.is_independent and not is_positive(joint.velocity):
        joint = replace(joint, velocity=DEFAULT_VELOCITY)
    return joint


def _nearest_position(joint: Joint, position: float) -> float:
    lower, upper = position_range(joint)
    return min(max(position if math.isfinite(position) else 0.0, lower), upper)


def _repair_names(robot: Robot) -> Robot:
    names = all_names(robot)
    reserved = {"world"} if robot.link_index.get("world", 0) > 0 else ()
    frame_names = safe_names(names["frame"])
    safe = rename(robot, safe_names(names["link"], reserved), safe_names(names["joint"]))
    return replace(
        safe,
        name=safe_robot_name(robot.name),
        frames=tuple(replace(frame, name=frame_names[frame.name]) for frame in safe.frames),
    )
