"""Repairs that are safe to make without asking."""

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
    reachable,
)
from morphgen.checks.names import named, safe_names
from morphgen.checks.solids import solid_of
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
    """A copy without the findings that say they are fixable; what is sound stays as it is."""
    moving = {link.name for g in rigid_groups(robot) if not g.is_root for link in g.links}
    locked = {joint.name for joint in robot.joints if is_locked(robot, joint)}
    joints = tuple(_joint(joint, locked=joint.name in locked) for joint in robot.joints)
    home = tuple(
        _nearest_reachable(joints[k], position)
        for k, position in zip(robot.independent_joints, robot.home, strict=True)
        if joints[k].name not in locked
    )
    links = tuple(_link(link, moves=link.name in moving) for link in robot.links)
    return _renamed(replace(robot, links=links, joints=joints, home=home))


def _link(link: Link, *, moves: bool) -> Link:
    body = link.inertial
    if is_inertia_without_mass(link):
        return replace(link, inertial=Inertial(0.0))
    wrong = body is not None and not is_mass_valid(body)
    if wrong or (moves and lacks_mass(link)):
        return with_inertia(link, DEFAULT_DENSITY) if solid_of(link) is not None else link
    if body is None or body.mass == 0 or inertia_fault(body) is None:
        return link
    solid = solid_of(link)
    if solid is None:
        return replace(link, inertial=_ball(body))
    scale = body.mass / solid.mass
    return replace(link, inertial=Inertial.from_matrix(body.mass, body.com, scale * solid.matrix))


def _ball(body: Inertial) -> Inertial:
    """The body as a ball of the same mass, its density the default."""
    radius = (3 * body.mass / (4 * math.pi * DEFAULT_DENSITY)) ** (1 / 3)
    return Inertial.from_matrix(body.mass, body.com, 0.4 * body.mass * radius**2 * np.eye(3))


def _joint(joint: Joint, *, locked: bool) -> Joint:
    if locked:
        return Joint(joint.name, "fixed", joint.parent, joint.child, joint.T_parent_joint)
    if not joint.is_movable:
        return joint
    if is_axis_valid(joint) and not is_axis_unit(joint):
        joint = replace(joint, axis=joint.unit_axis)
    if joint.kind == "continuous" and joint.limits is not None:
        joint = replace(joint, limits=None)
    if has_inverted_limits(joint):
        joint = replace(joint, limits=reachable(joint))
    if joint.is_independent and not is_positive(joint.effort):
        joint = replace(joint, effort=DEFAULT_EFFORT)
    if joint.is_independent and not is_positive(joint.velocity):
        joint = replace(joint, velocity=DEFAULT_VELOCITY)
    return joint


def _nearest_reachable(joint: Joint, position: float) -> float:
    lower, upper = reachable(joint)
    return min(max(position if math.isfinite(position) else 0.0, lower), upper)


def _renamed(robot: Robot) -> Robot:
    names = named(robot)
    reserved = {"world"} if robot.link_index.get("world", 0) > 0 else ()
    frame = safe_names(names["frame"])
    safe = rename(robot, safe_names(names["link"], reserved), safe_names(names["joint"]))
    return replace(
        safe,
        name=safe_names(names["robot"])[robot.name],
        frames=tuple(replace(part, name=frame[part.name]) for part in safe.frames),
    )
