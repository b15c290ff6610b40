"""Tokens: encode a robot as 48 numbers per link."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.errors import BenchmarkError, whole_number
from morphgen.formats.rounding import as_written
from morphgen.model import rotation
from morphgen.model.geometry import IDENTITY, Box, Capsule, Cylinder, Geometry, Pose, Shape, Sphere
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Joint, JointKind, Robot
from morphgen.typing import Array

TOKEN_SIZE = 48
MAX_LINKS = 23  # number of links of the paper's largest robot: 22 and the base
LARGEST_MAX_LINKS = 10_000
"""Largest ``max_links``: a robot's tokens have as many rows, so a larger one fills the memory."""
TOLERANCE = 1e-4
"""Largest difference of numbers of tokens that are the same; of single precision is less."""

SHAPES = ("sphere", "cylinder", "box")  # order of the one-hot encoding of a geometry
KINDS: tuple[JointKind, ...] = ("prismatic", "revolute", "fixed")
"""Order of the one-hot encoding of a joint type."""
FREQUENCIES: Array = np.array([math.pi / 2 * 2**k for k in range(8)])
"""Angular frequencies of the position encoding [rad], shape (8,)."""


@dataclass(frozen=True)
class Field:
    """A field of a token: consecutive numbers with one meaning."""

    name: str
    start: int  # index of the first number
    size: int  # count of numbers
    content: str  # description for users

    @property
    def columns(self) -> slice:
        """Slice of the field on the last axis of tokens."""
        return slice(self.start, self.start + self.size)


INDEX = Field("link index", 0, 1, "index / (max_links - 1); the base is 0")
PARENT = Field("parent index", 1, 1, "the parent's; -1 / (max_links - 1) for the base")
TOOL_FLAG = Field("end-effector", 2, 4, "four times 1 on the link with the tool frame, else 0")
GEOMETRY = Field(
    "geometry",
    6,
    6,
    "one-hot [sphere, cylinder, box]; [r, r, r], [r, r, length] or [x, y, z], m; zeros for none",
)
SHAPE_POSE = Field(
    "geometry pose", 12, 7, "in the link frame: x y z, m; quaternion w x y z; zeros for none"
)
AXIS = Field("joint axis", 19, 3, "unit vector in the joint frame; zeros if fixed")
ORIGIN = Field("joint origin", 22, 7, "in the parent's frame: x y z, m; quaternion w x y z")
KIND = Field("joint type", 29, 3, "one-hot [prismatic, revolute, fixed]; the base is fixed")
POSITION = Field(
    "joint position",
    32,
    16,
    "8 sines, 8 cosines of 2^k pi/2 x, k = 0 ... 7; x is q scaled to [-1, 1]; zeros if fixed",
)
LAYOUT = (INDEX, PARENT, TOOL_FLAG, GEOMETRY, SHAPE_POSE, AXIS, ORIGIN, KIND, POSITION)
"""The fields of a token, in order."""
LAYOUT_ARRAYS: Mapping[str, Any] = {  # Any: to mypy, np.savez could get a bool
    "layout": np.array([field.name for field in LAYOUT]),
    "columns": np.array([(field.start, field.columns.stop) for field in LAYOUT]),
}
"""Names, and first and end index, of the fields, for files."""


def default_max_links(link_counts: Iterable[int]) -> int:
    """Return the number of links that robots are padded to: the paper's, or the largest count."""
    return max([MAX_LINKS, *link_counts])


def require_max_links(n_links: int, what: str, max_links: int) -> None:
    """Require at most ``max_links`` links, and a valid ``max_links``."""
    max_links = whole_number("max_links", max_links, BenchmarkError)
    if not 2 <= max_links <= LARGEST_MAX_LINKS:
        raise BenchmarkError(
            f"max_links {max_links}: expected 2 to {LARGEST_MAX_LINKS}, such as {MAX_LINKS}"
        )
    if n_links > max_links:
        raise BenchmarkError(
            f"{what} has {n_links} links, more than max_links {max_links}; "
            f"make max_links {n_links} or more, the same for all robots that are compared"
        )


def require_finite(tokens: Array, what: str, links: Sequence[str]) -> None:
    """Require that tokens (n_links, 48) are finite."""
    invalid = np.argwhere(~np.isfinite(tokens))
    if len(invalid):
        row, column = invalid[0].tolist()
        field = next(field for field in LAYOUT if column < field.columns.stop)
        numbers = _format(tokens[row, field.columns].tolist())
        raise BenchmarkError(f"{what}: link {links[row]}: {field.name}: {numbers} is not finite")


def pad_tokens(tokens: Array, max_links: int) -> tuple[Array, NDArray[np.bool_]]:
    """Pad tokens (..., n_links, 48) with zeros; return also a mask (max_links,) of links."""
    n_links = tokens.shape[-2]
    require_max_links(n_links, "the robot", max_links)
    widths = [(0, 0)] * (tokens.ndim - 2) + [(0, max_links - n_links), (0, 0)]
    return np.pad(tokens, widths), np.arange(max_links) < n_links


def tokens_npz(tokens: Array, links: Sequence[str], name: str, max_links: int = MAX_LINKS) -> bytes:
    """Return an npz file of a robot's tokens and their description; see docs/tokens.md."""
    content = io.BytesIO()
    np.savez(
        content,
        tokens=tokens,
        links=np.array(links),
        **LAYOUT_ARRAYS,
        name=np.array(name),
        max_links=np.array(max_links),
    )
    return content.getvalue()


def encode_position(x: Array) -> Array:
    """Encode normalized joint positions x (...) as eight sines and eight cosines, shape (..., 16).

    As in NeRF (Mildenhall et al. 2020, equation 4), but the lowest frequency is pi/2: with pi,
    both limits, x = -1 and x = 1, would have the same code.
    """
    angles = x[..., None] * FREQUENCIES
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)


def encode_primitive(geometry: Geometry) -> tuple[float, ...]:
    """Encode a primitive; a capsule becomes the cylinder of its total length."""
    match geometry:
        case Sphere(radius):
            kind, sizes = "sphere", (radius, radius, radius)
        case Cylinder(radius, length):
            kind, sizes = "cylinder", (radius, radius, length)
        case Capsule(radius, length):
            kind, sizes = "cylinder", (radius, radius, length + 2 * radius)
        case Box(edges):
            kind, sizes = "box", edges
        case _:
            raise ValueError(
                "a mesh has no token; morphgen.fitting.token_shapes.token_shapes gives primitives"
            )
    if not all(0 < size < math.inf for size in sizes):
        raise ValueError(f"sizes {_format(sizes)} are not all positive and finite")
    return (*_one_hot(kind, SHAPES), *sizes)


def encode_pose(pose: Pose) -> tuple[float, ...]:
    """Encode a pose as its position [m] and its quaternion (w, x, y, z) with w >= 0."""
    return (*pose.position, *rotation.normalize(pose.quaternion))


def _one_hot(name: str, names: Sequence[str]) -> tuple[float, ...]:
    return tuple(float(name == other) for other in names)


def _format(numbers: Sequence[float]) -> str:
    return f"[{', '.join(f'{number:g}' for number in numbers)}]"


def tokens(
    robot: Robot,
    shapes: Mapping[str, Shape],
    q: ArrayLike | None = None,
    *,
    max_links: int = MAX_LINKS,
) -> Array:
    """Return the tokens of a robot's links, shape (..., n_links, 48), root first; see ``LAYOUT``.

    One primitive per link with geometry; q (..., dof), by default home; ``max_links`` of all
    robots.
    """
    require_max_links(len(robot.links), f"robot {robot.name!r}", max_links)
    robot = as_written(robot)  # rounded as in its file: composed and read back, the same tokens
    codes = encode_joint_positions(robot, robot.home if q is None else q)
    tool = robot.tool and robot.tool.link
    static = np.zeros((len(robot.links), TOKEN_SIZE))  # all fields but the joint position
    static[:, INDEX.start] = np.arange(len(robot.links)) / (max_links - 1)
    static[:, PARENT.start] = np.array(robot.parents) / (max_links - 1)
    for row, link, joint in zip(static, robot.links, (None, *robot.joints), strict=True):
        row[TOOL_FLAG.columns] = link.name == tool
        try:
            if shape := shapes.get(link.name):
                row[GEOMETRY.columns] = encode_primitive(shape.geometry)
                row[SHAPE_POSE.columns] = encode_pose(shape.T_link_shape)
            _write_joint(row, joint)
        except ValueError as error:
            raise BenchmarkError(f"robot {robot.name!r}: link {link.name!r}: {error}") from error
    names = [repr(link.name) for link in robot.links]
    require_finite(static, f"robot {robot.name!r}", names)
    result = np.broadcast_to(static, (*codes.shape[:-2], *static.shape)).copy()
    result[..., POSITION.columns] = codes
    return result


def encode_joint_positions(robot: Robot, q: ArrayLike) -> Array:
    """Return the field ``joint position``, the only part of the tokens that changes with ``q``.

    Codes have the shape (..., n_links, 16) for q (..., dof); zeros for the root and fixed joints.
    """
    x = normalize_positions(robot, q)
    codes = np.zeros((*x.shape[:-1], len(robot.links), POSITION.size))
    codes[..., [k + 1 for k in robot.movable_joints], :] = encode_position(x)
    return codes


def normalize_positions(robot: Robot, q: ArrayLike) -> Array:
    """Scale the movable joints to -1 at the lower and 1 at the upper limit, shape (..., n_movable).

    Joints without limits are wrapped and divided by pi; prismatic ones stay in metres.
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
    wrapped = positions - math.tau * np.ceil((positions - math.pi) / math.tau)  # keeps +pi
    half_range = (limits[:, 1] - limits[:, 0]) / 2
    centred = np.where(continuous, wrapped, positions) - limits.mean(axis=1)
    return np.asarray(centred / half_range)


def _write_joint(row: Array, joint: Joint | None) -> None:
    """Write all joint fields but the position; the root counts as fixed at the identity."""
    kind = joint.kind if joint else "fixed"
    # A continuous joint counts as revolute.
    row[KIND.columns] = _one_hot("revolute" if kind == "continuous" else kind, KINDS)
    row[ORIGIN.columns] = encode_pose(joint.T_parent_joint if joint else IDENTITY)
    if joint is not None and joint.is_movable:
        row[AXIS.columns] = joint.unit_axis
