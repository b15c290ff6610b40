"""The hash that tells whether two robots are physically the same."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import replace

from morphgen.files import content_sha256
from morphgen.model.geometry import Geometry, Mesh, Pose, dimensions
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    Inertial,
    Joint,
    Link,
    Robot,
)
from morphgen.model.rotation import to_matrix

HASH_LENGTH = 32  # hexadecimal digits of the hash of a robot and of the id of a split: 128 bits
_GRID = 1e-7
"""Resolution of the numbers in a hash: lengths [m], angles [rad], masses [kg] and others."""
_GYRATION_GRID = 1e-9  # resolution of inertia over mass [m^2]; a finger has 1e-5
_OFF_GRID = 1 / math.pi
"""Offset of the grid [steps], so that decimal numbers are not halfway between grid points, where
the last bit would decide."""


def robot_hash(robot: Robot, *, visuals: bool = True) -> str:
    """Return a hash of the physical robot: 32 hexadecimal digits of a SHA-256.

    A mesh counts as the content of its file, its scale and its part. Names, colours, ignored pairs
    and provenance are not covered. Numbers have a resolution of 1e-7 (m, rad, kg ...), because
    their last bits differ between machines.

    visuals: Include visual shapes. Without them, and with primitives as collision shapes, the hash
    does not depend on how meshes are stored.
    """
    tool = robot.tool
    tool_frame = None if tool is None else [robot.link_index[tool.link], _pose(tool.T_link_frame)]
    joints = [_joint(joint, robot) for joint in robot.joints]
    links = [_link(link if visuals else replace(link, visuals=())) for link in robot.links]
    return digest([links, joints, _grid(robot.home), tool_frame])


def digest(data: object) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of data written as JSON."""
    text = json.dumps(data, separators=(",", ":"))  # its spelling is part of every hash
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_LENGTH]


def _grid(values: Iterable[float], step: float = _GRID) -> list[int]:
    """Return the nearest grid point of each value as a number of steps."""
    return [math.floor(value / step + _OFF_GRID) for value in values]


def _link(link: Link) -> list[object]:
    shapes = [
        [[*_geometry(shape.geometry), _pose(shape.T_link_shape)] for shape in kind]
        for kind in (link.visuals, link.collisions)
    ]
    return [_inertial(link.inertial), *shapes]


def _inertial(inertial: Inertial | None) -> list[int] | None:
    if inertial is None or inertial.mass == 0:
        return None
    gyration = [value / inertial.mass for value in inertial.inertia]
    return [*_grid([inertial.mass, *inertial.com]), *_grid(gyration, _GYRATION_GRID)]


def _geometry(geometry: Geometry) -> list[object]:
    if isinstance(geometry, Mesh):
        content = content_sha256(geometry.path)
        return [content, _grid(geometry.scale), geometry.part]
    return [type(geometry).__name__, _grid(dimensions(geometry))]


def _pose(pose: Pose) -> list[int]:
    """Return position and rotation matrix; the sign of a quaternion may depend on the last bit."""
    rows = to_matrix(pose.quaternion)
    return _grid([*pose.position, *rows[0], *rows[1], *rows[2]])


def _joint(joint: Joint, robot: Robot) -> list[object]:
    attachment = [robot.link_index[joint.parent], _pose(joint.T_parent_joint)]
    if not joint.is_movable:
        return ["fixed", *attachment]
    unlimited = joint.kind == "continuous" or joint.limits is None
    kind = "continuous" if joint.is_continuous else joint.kind
    effort = DEFAULT_EFFORT if joint.effort is None else joint.effort
    velocity = DEFAULT_VELOCITY if joint.velocity is None else joint.velocity
    motion = [*joint.unit_axis, effort, velocity, joint.damping, joint.friction]
    limits = None if unlimited else _grid(joint.limits or ())
    mimic = joint.mimic and [
        robot.joint_index[joint.mimic.joint],
        _grid([joint.mimic.multiplier, joint.mimic.offset]),
    ]
    return [kind, *attachment, _grid(motion), limits, mimic]
