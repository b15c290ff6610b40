"""Tokens: a robot as 48 numbers a link, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from morphgen.benchmark import token_layout as layout
from morphgen.benchmark.token_layout import (
    LAYOUT,
    MAX_LINKS,
    TOKEN_SIZE,
    Field,
    pad_tokens,
    tokens_npz,
)
from morphgen.errors import BenchmarkError, nearest
from morphgen.formats.rounding import as_written
from morphgen.model.geometry import IDENTITY, Shape
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import TOOL, Frame, Joint, Link, Robot
from morphgen.typing import Array

__all__ = [
    "LAYOUT",
    "MAX_LINKS",
    "TOKEN_SIZE",
    "Field",
    "encode_joint_positions",
    "normalize_positions",
    "pad_tokens",
    "robot_from_tokens",
    "tokens",
    "tokens_npz",
]

T = TypeVar("T")


def tokens(
    robot: Robot,
    shapes: Mapping[str, Shape],
    q: ArrayLike | None = None,
    *,
    max_links: int = MAX_LINKS,
) -> Array:
    """Tokens of a robot's links, the base first; ``LAYOUT`` names their fields.

    Args:
        robot: The body.
        shapes: The one primitive that stands for each link; links without geometry are absent.
        q: Independent joint positions, shape (..., dof), rad or m; by default the home.
        max_links: The most links that a robot of the study has; indices are divided by one less.

    Returns:
        Shape (..., n_links, 48).

    Raises:
        BenchmarkError: If the robot has more links than ``max_links``, a shape belongs to no link,
            is a mesh or has no size, a joint has no range, or a number is not finite.
        RobotError: If a joint's axis is zero.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    layout.require_max_links(len(robot.links), f"robot {robot.name!r}", max_links)
    for name in shapes:
        if name not in robot.link_index:
            raise BenchmarkError(
                f"robot {robot.name!r}: a shape is for {name!r}, no link"
                + nearest(name, robot.link_index)
            )
    robot = as_written(robot)  # one robot has one token matrix, composed or read back
    codes = encode_joint_positions(robot, robot.home if q is None else q)
    tool = next((frame.link for frame in robot.frames if frame.name == TOOL), None)
    body = np.zeros((len(robot.links), TOKEN_SIZE))
    body[:, layout.INDEX.start] = np.arange(len(robot.links)) / (max_links - 1)
    body[:, layout.PARENT.start] = np.array(robot.parents) / (max_links - 1)
    for row, link, joint in zip(body, robot.links, (None, *robot.joints), strict=True):
        row[layout.TOOL.columns] = link.name == tool
        try:
            _write_shape(row, shapes.get(link.name))
            _write_joint(row, joint)
        except ValueError as error:
            raise BenchmarkError(f"robot {robot.name!r}: link {link.name!r}: {error}") from error
    names = [repr(link.name) for link in robot.links]
    layout.require_finite(body, f"robot {robot.name!r}", names)
    made = np.broadcast_to(body, (*codes.shape[:-2], *body.shape)).copy()
    made[..., layout.POSITION.columns] = codes
    return made


def encode_joint_positions(robot: Robot, q: ArrayLike) -> Array:
    """What changes of the tokens as a robot moves: the numbers of ``joint position``.

    Args:
        robot: The body.
        q: Independent joint positions, shape (..., dof), rad or m.

    Returns:
        Shape (..., n_links, 16); zeros for the base and for fixed joints.

    Raises:
        BenchmarkError: If a position is not finite or a joint has no range.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    x = normalize_positions(robot, q)
    codes = np.zeros((*x.shape[:-1], len(robot.links), layout.POSITION.size))
    codes[..., [k + 1 for k in robot.movable_joints], :] = layout.encode_position(x)
    return codes


def normalize_positions(robot: Robot, q: ArrayLike) -> Array:
    """Positions of the movable joints: -1 at the lower limit, 1 at the upper, outside beyond.

    Continuous joints, and revolute ones without limits, are wrapped to (-pi, pi] and divided by
    pi; prismatic ones without limits count in metres. Mimic joints follow their leaders.

    Args:
        robot: The body.
        q: Independent joint positions, shape (..., dof), rad or m.

    Returns:
        In the order of ``robot.movable_joints``, shape (..., n_movable).

    Raises:
        BenchmarkError: If a position is not finite or a joint has no range.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    joints = [robot.joints[k] for k in robot.movable_joints]
    for joint in joints:
        low, high = joint.effective_limits
        if not 0 < high - low < math.inf:
            raise BenchmarkError(
                f"robot {robot.name!r}: joint {joint.name!r}: limits ({low:g}, {high:g}) leave no "
                "range to scale q by; morphgen check says how to mend them"
            )
    positions = movable_positions(robot, q)
    lost = np.argwhere(~np.isfinite(positions))
    if len(lost):
        raise BenchmarkError(
            f"robot {robot.name!r}: joint {joints[lost[0, -1]].name!r}: q is not finite"
        )
    bounds = np.array([joint.effective_limits for joint in joints]).reshape(-1, 2)
    turns = np.array([_turns_freely(joint) for joint in joints], dtype=bool)
    wrapped = positions - math.tau * np.ceil((positions - math.pi) / math.tau)
    half = (bounds[:, 1] - bounds[:, 0]) / 2
    return np.asarray((np.where(turns, wrapped, positions) - bounds.mean(axis=1)) / half)


def robot_from_tokens(
    tokens: ArrayLike, name: str, *, max_links: int = MAX_LINKS
) -> tuple[Robot, dict[str, Shape]]:
    """The robot that tokens describe; the inverse of ``tokens``.

    Links are called ``link0``, ``link1`` ..., each joint after its child: ``joint1`` ... Shapes
    are collision shapes, too. Movable joints are independent and have limits (-1, 1), so that q
    is the scaled position; the home is what the tokens were made at. The tool frame is that of
    its link. ``docs/tokens.md`` lists what tokens do not say.

    Args:
        tokens: Of one robot in one configuration, without padding, shape (n_links, 48).
        name: The robot's name.
        max_links: As the tokens were made with.

    Returns:
        The robot, and its shapes by link, as ``tokens`` takes them.

    Raises:
        BenchmarkError: If these are no robot's tokens; the message names link and field.
    """
    table = np.asarray(tokens, dtype=np.float64)
    what = f"tokens of {name!r}"
    if table.ndim != 2 or table.shape[1] != TOKEN_SIZE or not len(table):
        raise BenchmarkError(f"{what}: shape {table.shape}; expected (n_links, {TOKEN_SIZE})")
    layout.require_max_links(len(table), what, max_links)
    layout.require_finite(table, what, [str(i) for i in range(len(table))])
    rows = [_Row(what, i, numbers) for i, numbers in enumerate(table)]
    for row in rows:
        _require_index(row, max_links - 1)
    parents = [_read_parent(row, max_links - 1) for row in rows]
    shapes = {f"link{row.index}": shape for row in rows if (shape := _read_shape(row))}
    tools = [row for row in rows if row.read(layout.TOOL, layout.decode_flag)]
    if len(tools) > 1:
        raise tools[1].refusal(layout.TOOL, f"link {tools[0].index} is flagged, too; only one can")
    _require_base(rows[0])
    read = [_read_joint(row, parents[row.index]) for row in rows[1:]]
    names = [f"link{row.index}" for row in rows]
    robot = Robot(
        name,
        tuple(Link(n, collisions=(shapes[n],) if n in shapes else ()) for n in names),
        tuple(joint for joint, _ in read),
        tuple(Frame(TOOL, names[row.index]) for row in tools),
        tuple(q for joint, q in read if joint.is_movable),
    )
    return robot, shapes


def _turns_freely(joint: Joint) -> bool:
    return joint.kind == "continuous" or (joint.kind == "revolute" and joint.limits is None)


def _write_shape(row: Array, shape: Shape | None) -> None:
    if shape is not None:
        row[layout.GEOMETRY.columns] = layout.encode_primitive(shape.geometry)
        row[layout.SHAPE_POSE.columns] = layout.encode_pose(shape.T_link_shape)


def _write_joint(row: Array, joint: Joint | None) -> None:
    """Write all but the position; the base is fixed where it stands."""
    row[layout.KIND.columns] = layout.encode_kind(joint.kind if joint else "fixed")
    row[layout.ORIGIN.columns] = layout.encode_pose(joint.T_parent_joint if joint else IDENTITY)
    if joint is not None and joint.is_movable:
        row[layout.AXIS.columns] = joint.unit_axis


@dataclass(frozen=True, eq=False)
class _Row:
    """The token of one link, and how its faults are told."""

    what: str
    index: int
    numbers: Array

    def read(self, field: Field, decode: Callable[[Array], T]) -> T:
        """What a field says."""
        try:
            return decode(self.numbers[field.columns])
        except ValueError as error:
            raise self.refusal(field, str(error)) from error

    def refusal(self, field: Field, why: str) -> BenchmarkError:
        return BenchmarkError(f"{self.what}: link {self.index}: {field.name}: {why}")

    def require_zeros(self, *fields: Field, of: str) -> None:
        for field in fields:
            if np.abs(self.numbers[field.columns]).max() > layout.TOLERANCE:
                raise self.refusal(field, f"it is not zero, but {of}")


def _require_index(row: _Row, scale: int) -> None:
    index = float(row.numbers[layout.INDEX.start])
    if abs(index * scale - row.index) > layout.TOLERANCE:
        raise row.refusal(
            layout.INDEX,
            f"{index:g}, not {row.index}/{scale}: made with another max_links than {scale + 1}, "
            "padded, or out of order",
        )


def _read_parent(row: _Row, scale: int) -> int:
    """Index of a link's parent; parents come before their children."""
    value = float(row.numbers[layout.PARENT.start])
    parent = round(value * scale)
    first, last = (0, row.index - 1) if row.index else (-1, -1)
    if abs(value * scale - parent) > layout.TOLERANCE or not first <= parent <= last:
        valid = f"k/{scale}, k = {first} ... {last}" if first < last else f"{first}/{scale}"
        raise row.refusal(layout.PARENT, f"{value:g} makes no tree; expected {valid}")
    return parent


def _read_shape(row: _Row) -> Shape | None:
    primitive = row.read(layout.GEOMETRY, layout.decode_primitive)
    if primitive is None:
        row.require_zeros(layout.SHAPE_POSE, of="the link has no geometry")
        return None
    return Shape(primitive, row.read(layout.SHAPE_POSE, layout.decode_pose))


def _require_base(row: _Row) -> None:
    joint, _ = _read_joint(row, -1)
    if joint.is_movable:
        raise row.refusal(layout.KIND, f"{joint.kind}, but the base is fixed")
    if not np.allclose(joint.T_parent_joint.matrix, np.eye(4), rtol=0, atol=layout.TOLERANCE):
        raise row.refusal(layout.ORIGIN, "the base has no parent; expected [0, 0, 0, 1, 0, 0, 0]")


def _read_joint(row: _Row, parent: int) -> tuple[Joint, float]:
    """The joint that attaches a link, and its position."""
    kind = row.read(layout.KIND, layout.decode_kind)
    name, child = f"joint{row.index}", f"link{row.index}"
    origin = row.read(layout.ORIGIN, layout.decode_pose)
    if kind == "fixed":
        row.require_zeros(layout.AXIS, layout.POSITION, of="the joint is fixed")
        return Joint(name, kind, f"link{parent}", child, origin), 0.0
    axis = row.read(layout.AXIS, layout.decode_axis)
    q = row.read(layout.POSITION, layout.decode_position)
    return Joint(name, kind, f"link{parent}", child, origin, axis, (-1.0, 1.0)), q
