"""The hash that tells whether two robots are physically the same."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from morphgen.errors import MeshError
from morphgen.formats.resolve import file_stamp
from morphgen.model.geometry import Geometry, Mesh, Pose, Shape, dimensions
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    TOOL,
    Inertial,
    Joint,
    Link,
    Robot,
)
from morphgen.model.rotation import to_matrix

HASH_LENGTH = 32
"""Hexadecimal digits of the hash of a robot and of the id of a split: 128 bits."""
_GRID = 1e-7
"""Lengths (m), angles (rad), masses (kg) and all else in a hash are told apart to this."""
_GYRATION_GRID = 1e-9
"""The same of inertia over mass, square metres: a finger's is 1e-5."""
_OFF_GRID = 1 / math.pi
"""Keeps decimal numbers away from the middle between two points of the grid, where the last bit
decides."""


def robot_hash(robot: Robot, *, visuals: bool = True) -> str:
    """A hash of the body: 32 hexadecimal digits of a SHA-256.

    It tells links, joints and home: what is where, how heavy, how far and how strongly it moves,
    and where the tool is. A mesh counts by the content of its file, with its scale and part. It
    does not tell names, colours, pairs to ignore or provenance, so the same body under other
    labels has the same hash. Numbers count to 1e-7 (m, rad, kg ...), so the last bits, which
    differ between machines, do not.

    Args:
        robot: The body.
        visuals: Whether what is only seen counts. Without, and with primitives as its collision
            shapes, a robot has the same hash however its meshes are stored.

    Raises:
        MeshError: If a mesh file cannot be read.
    """
    tool = next((frame for frame in robot.frames if frame.name == TOOL), None)
    where = None if tool is None else [robot.link_index[tool.link], _pose(tool.T_link_frame)]
    joints = [_joint(joint, robot) for joint in robot.joints]
    links = [_link(link if visuals else replace(link, visuals=())) for link in robot.links]
    return digest([links, joints, _grid(robot.home), where])


def digest(data: object) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of data written as JSON."""
    text = json.dumps(data, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_LENGTH]


def _grid(values: Iterable[float], step: float = _GRID) -> list[int]:
    """The nearest point of a grid, each as a whole number of steps."""
    return [math.floor(value / step + _OFF_GRID) for value in values]


def _link(link: Link) -> list[object]:
    shapes = [[_shape(shape) for shape in kind] for kind in (link.visuals, link.collisions)]
    return [_inertial(link.inertial), *shapes]


def _inertial(inertial: Inertial | None) -> list[int] | None:
    if inertial is None or inertial.mass == 0:
        return None
    gyration = [value / inertial.mass for value in inertial.inertia]
    return [*_grid([inertial.mass, *inertial.com]), *_grid(gyration, _GYRATION_GRID)]


def _shape(shape: Shape) -> list[object]:
    return [*_geometry(shape.geometry), _pose(shape.T_link_shape)]


def _geometry(geometry: Geometry) -> list[object]:
    if isinstance(geometry, Mesh):
        content = _content(geometry.path, file_stamp(geometry.path))
        return [content, _grid(geometry.scale), geometry.part]
    return [type(geometry).__name__, _grid(dimensions(geometry))]


def _pose(pose: Pose) -> list[int]:
    """Position and rotation matrix; the sign of a quaternion may hang on the last bit."""
    rows = to_matrix(pose.quaternion)
    return _grid([*pose.position, *rows[0], *rows[1], *rows[2]])


def _joint(joint: Joint, robot: Robot) -> list[object]:
    place = [robot.link_index[joint.parent], _pose(joint.T_parent_joint)]
    if not joint.is_movable:
        return ["fixed", *place]
    unlimited = joint.kind == "continuous" or joint.limits is None
    kind = "continuous" if unlimited and joint.kind == "revolute" else joint.kind
    effort = DEFAULT_EFFORT if joint.effort is None else joint.effort
    velocity = DEFAULT_VELOCITY if joint.velocity is None else joint.velocity
    motion = [*joint.unit_axis, effort, velocity, joint.damping, joint.friction]
    limits = None if unlimited else _grid(joint.limits or ())
    mimic = joint.mimic and [
        robot.joint_index[joint.mimic.joint],
        _grid([joint.mimic.multiplier, joint.mimic.offset]),
    ]
    return [kind, *place, _grid(motion), limits, mimic]


@lru_cache(maxsize=4096)
def _content(path: Path, stamp: tuple[int, int]) -> str:
    """SHA-256 of a file as it is at its stamp, hexadecimal."""
    del stamp
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read: {error.strerror}") from error
