"""Tokens: encode a robot as 48 numbers per link, and decode it."""

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
    """Return the tokens of a robot's links, root first; ``LAYOUT`` describes their fields.

    Args:
        robot: The robot.
        shapes: One primitive per link, by link name; links without geometry are absent.
        q: Independent joint positions, shape (..., dof) [rad or m]; by default the home.
        max_links: Largest number of links among all compared robots; link indices are divided by
            ``max_links - 1``.

    Returns:
        Tokens, shape (..., n_links, 48).

    Raises:
        BenchmarkError: If the robot has more links than ``max_links``, a shape is a mesh, has no
            size or names an unknown link, a joint has no range, or a number is not finite.
        RobotError: If a joint's axis is zero.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    layout.require_max_links(len(robot.links), f"robot {robot.name!r}", max_links)
    for name in shapes:
        if name not in robot.link_index:
            raise BenchmarkError(
                f"robot {robot.name!r}: a shape is for the unknown link {name!r}"
                + nearest(name, robot.link_index)
            )
    robot = as_written(robot)  # rounded as in its file: composed and read back, the same tokens
    codes = encode_joint_positions(robot, robot.home if q is None else q)
    tool = next((frame.link for frame in robot.frames if frame.name == TOOL), None)
    static = np.zeros((len(robot.links), TOKEN_SIZE))  # all fields but the joint position
    static[:, layout.INDEX.start] = np.arange(len(robot.links)) / (max_links - 1)
    static[:, layout.PARENT.start] = np.array(robot.parents) / (max_links - 1)
    for row, link, joint in zip(static, robot.links, (None, *robot.joints), strict=True):
        row[layout.TOOL.columns] = link.name == tool
        try:
            if shape := shapes.get(link.name):
                row[layout.GEOMETRY.columns] = layout.encode_primitive(shape.geometry)
                row[layout.SHAPE_POSE.columns] = layout.encode_pose(shape.T_link_shape)
            _write_joint(row, joint)
        except ValueError as error:
            raise BenchmarkError(f"robot {robot.name!r}: link {link.name!r}: {error}") from error
    names = [repr(link.name) for link in robot.links]
    layout.require_finite(static, f"robot {robot.name!r}", names)
    result = np.broadcast_to(static, (*codes.shape[:-2], *static.shape)).copy()
    result[..., layout.POSITION.columns] = codes
    return result


def encode_joint_positions(robot: Robot, q: ArrayLike) -> Array:
    """Return the field ``joint position``, the only part of the tokens that changes with ``q``.

    Args:
        robot: The robot.
        q: Independent joint positions, shape (..., dof) [rad or m].

    Returns:
        Codes, shape (..., n_links, 16); zeros for the root and for fixed joints.

    Raises:
        BenchmarkError: If a position is not finite or a joint has no range.
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    x = normalize_positions(robot, q)
    codes = np.zeros((*x.shape[:-1], len(robot.links), layout.POSITION.size))
    codes[..., [k + 1 for k in robot.movable_joints], :] = layout.encode_position(x)
    return codes


def normalize_positions(robot: Robot, q: ArrayLike) -> Array:
    """Scale the positions of the movable joints to -1 at the lower and 1 at the upper limit.

    Positions of continuous joints, and of revolute ones without limits, are wrapped to (-pi, pi]
    and divided by pi. Those of prismatic joints without limits stay in metres. Mimic joints follow
    their leaders.

    Args:
        robot: The robot.
        q: Independent joint positions, shape (..., dof) [rad or m].

    Returns:
        Normalized positions in the order of ``robot.movable_joints``, shape (..., n_movable).

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
    invalid = np.argwhere(~np.isfinite(positions))
    if len(invalid):
        raise BenchmarkError(
            f"robot {robot.name!r}: joint {joints[invalid[0, -1]].name!r}: q is not finite"
        )
    limits = np.array([joint.effective_limits for joint in joints]).reshape(-1, 2)
    continuous = np.array([joint.is_continuous for joint in joints], dtype=bool)
    wrapped = positions - math.tau * np.ceil((positions - math.pi) / math.tau)
    half_range = (limits[:, 1] - limits[:, 0]) / 2
    centred = np.where(continuous, wrapped, positions) - limits.mean(axis=1)
    return np.asarray(centred / half_range)


def robot_from_tokens(
    tokens: ArrayLike, name: str, *, max_links: int = MAX_LINKS
) -> tuple[Robot, dict[str, Shape]]:
    """Decode tokens to a robot; the inverse of ``tokens``.

    Links are named ``link0``, ``link1`` ..., and joints ``joint1`` ... after their child links.
    The primitives become collision shapes. Movable joints are independent and have limits (-1, 1),
    so that q is the normalized position. The home is the configuration of the tokens, and the tool
    frame is its link's frame. ``docs/tokens.md`` lists what tokens do not contain.

    Args:
        tokens: Tokens of one robot in one configuration, without padding, shape (n_links, 48).
        name: Name of the robot.
        max_links: The value with which the tokens were encoded.

    Returns:
        The robot, and its primitives by link name, as ``tokens`` takes them.

    Raises:
        BenchmarkError: If the tokens are invalid; the message names link and field.
    """
    table = np.asarray(tokens, dtype=np.float64)
    what = f"tokens of {name!r}"
    if table.ndim != 2 or table.shape[1] != TOKEN_SIZE or not len(table):
        raise BenchmarkError(f"{what}: shape {table.shape}; expected (n_links, {TOKEN_SIZE})")
    layout.require_max_links(len(table), what, max_links)
    layout.require_finite(table, what, [str(i) for i in range(len(table))])
    link_tokens = [_Token(what, i, numbers) for i, numbers in enumerate(table)]
    for token in link_tokens:
        _require_index(token, max_links - 1)
    parents = [_read_parent(token, max_links - 1) for token in link_tokens]
    shapes = {f"link{token.index}": shape for token in link_tokens if (shape := _read_shape(token))}
    tools = [token for token in link_tokens if token.decode(layout.TOOL, layout.decode_flag)]
    if len(tools) > 1:
        raise tools[1].error(layout.TOOL, f"link {tools[0].index} is flagged, too; only one can")
    _require_base(link_tokens[0])
    joints = [_read_joint(token, parents[token.index]) for token in link_tokens[1:]]
    names = [f"link{token.index}" for token in link_tokens]
    robot = Robot(
        name,
        tuple(Link(n, collisions=(shapes[n],) if n in shapes else ()) for n in names),
        tuple(joint for joint, _ in joints),
        tuple(Frame(TOOL, names[token.index]) for token in tools),
        tuple(q for joint, q in joints if joint.is_movable),
    )
    return robot, shapes


def _write_joint(row: Array, joint: Joint | None) -> None:
    """Write all joint fields but the position; the root counts as fixed at the identity."""
    row[layout.KIND.columns] = layout.encode_kind(joint.kind if joint else "fixed")
    row[layout.ORIGIN.columns] = layout.encode_pose(joint.T_parent_joint if joint else IDENTITY)
    if joint is not None and joint.is_movable:
        row[layout.AXIS.columns] = joint.unit_axis


@dataclass(frozen=True, eq=False)
class _Token:
    """The token of one link, with what its error messages name."""

    what: str
    """Name of the tokens, for messages."""
    index: int
    """Row of the token, and index of its link."""
    numbers: Array
    """The numbers of the token, shape (48,)."""

    def decode(self, field: Field, decode: Callable[[Array], T]) -> T:
        """Decode a field.

        Raises:
            BenchmarkError: If its numbers are invalid.
        """
        try:
            return decode(self.numbers[field.columns])
        except ValueError as error:
            raise self.error(field, str(error)) from error

    def error(self, field: Field, why: str) -> BenchmarkError:
        return BenchmarkError(f"{self.what}: link {self.index}: {field.name}: {why}")

    def require_zeros(self, *fields: Field, why: str) -> None:
        """Require that fields are zero; ``why`` gives the reason in the error."""
        for field in fields:
            if np.abs(self.numbers[field.columns]).max() > layout.TOLERANCE:
                raise self.error(field, f"it is not zero, but {why}")


def _require_index(token: _Token, scale: int) -> None:
    index = float(token.numbers[layout.INDEX.start])
    if abs(index * scale - token.index) > layout.TOLERANCE:
        raise token.error(
            layout.INDEX,
            f"{index:g}, not {token.index}/{scale}: made with another max_links than {scale + 1}, "
            "padded, or out of order",
        )


def _read_parent(token: _Token, scale: int) -> int:
    """Decode the index of a link's parent, which precedes the link."""
    value = float(token.numbers[layout.PARENT.start])
    parent = round(value * scale)
    first, last = (0, token.index - 1) if token.index else (-1, -1)
    if abs(value * scale - parent) > layout.TOLERANCE or not first <= parent <= last:
        valid = f"k/{scale}, k = {first} ... {last}" if first < last else f"{first}/{scale}"
        raise token.error(layout.PARENT, f"{value:g} makes no tree; expected {valid}")
    return parent


def _read_shape(token: _Token) -> Shape | None:
    primitive = token.decode(layout.GEOMETRY, layout.decode_primitive)
    if primitive is None:
        token.require_zeros(layout.SHAPE_POSE, why="the link has no geometry")
        return None
    return Shape(primitive, token.decode(layout.SHAPE_POSE, layout.decode_pose))


def _require_base(token: _Token) -> None:
    joint, _ = _read_joint(token, -1)
    if joint.is_movable:
        raise token.error(layout.KIND, f"{joint.kind}, but the base is fixed")
    if not np.allclose(joint.T_parent_joint.matrix, np.eye(4), rtol=0, atol=layout.TOLERANCE):
        raise token.error(layout.ORIGIN, "the base has no parent; expected [0, 0, 0, 1, 0, 0, 0]")


def _read_joint(token: _Token, parent: int) -> tuple[Joint, float]:
    """Decode the joint that attaches a link, and its position."""
    kind = token.decode(layout.KIND, layout.decode_kind)
    name, child = f"joint{token.index}", f"link{token.index}"
    origin = token.decode(layout.ORIGIN, layout.decode_pose)
    if kind == "fixed":
        token.require_zeros(layout.AXIS, layout.POSITION, why="the joint is fixed")
        return Joint(name, kind, f"link{parent}", child, origin), 0.0
    axis = token.decode(layout.AXIS, layout.decode_axis)
    q = token.decode(layout.POSITION, layout.decode_position)
    return Joint(name, kind, f"link{parent}", child, origin, axis, (-1.0, 1.0)), q
