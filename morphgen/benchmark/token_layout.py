"""Fields of the 48-number token of a link: encoding and decoding.

Order and sizes follow the robot state table in AnyBody (arXiv 2505.14986, appendix on the state
space). ``LAYOUT`` documents the choices that the paper leaves open.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.arguments import whole_number
from morphgen.errors import BenchmarkError
from morphgen.model import rotation
from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Pose, Primitive, Sphere
from morphgen.model.robot import JointKind
from morphgen.model.rotation import Vec3
from morphgen.typing import Array

TOKEN_SIZE = 48
MAX_LINKS = 23
"""Number of links of the paper's largest robot: 22 and the base."""
LARGEST_MAX_LINKS = 10_000
"""Largest ``max_links``: a robot's tokens have as many rows, so a larger one fills the memory."""
TOLERANCE = 1e-4
"""Largest error of a number that is still decoded; single-precision tokens are within it."""

SHAPES = ("sphere", "cylinder", "box")
"""Order of the one-hot encoding of a geometry."""
KINDS: tuple[JointKind, ...] = ("prismatic", "revolute", "fixed")
"""Order of the one-hot encoding of a joint type."""
FREQUENCIES: Array = np.array([math.pi / 2 * 2**k for k in range(8)])
"""Angular frequencies of the position encoding [rad], shape (8,)."""


@dataclass(frozen=True)
class Field:
    """A field of a token: consecutive numbers with one meaning."""

    name: str
    start: int
    """Index of the first number."""
    size: int
    """Count of numbers."""
    content: str
    """Description for users."""

    @property
    def columns(self) -> slice:
        """Slice of the field on the last axis of tokens."""
        return slice(self.start, self.start + self.size)


INDEX = Field("link index", 0, 1, "index / (max_links - 1); the base is 0")
PARENT = Field("parent index", 1, 1, "the parent's; -1 / (max_links - 1) for the base")
TOOL = Field("end-effector", 2, 4, "four times 1 on the link with the tool frame, else 0")
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
LAYOUT = (INDEX, PARENT, TOOL, GEOMETRY, SHAPE_POSE, AXIS, ORIGIN, KIND, POSITION)
"""The fields of a token, in order."""


def default_max_links(link_counts: Iterable[int]) -> int:
    """Return the number of links that robots are padded to: the paper's, or the largest count."""
    return max([MAX_LINKS, *link_counts])


def require_max_links(n_links: int, what: str, max_links: int) -> None:
    """Require at most ``max_links`` links, and a valid ``max_links``.

    Raises:
        BenchmarkError: If one of the two is violated; ``what`` names the robot in the message.
    """
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
    """Require that tokens (n_links, 48) are finite.

    Raises:
        BenchmarkError: If a number is not finite; the message names its link and field.
    """
    invalid = np.argwhere(~np.isfinite(tokens))
    if len(invalid):
        row, column = invalid[0].tolist()
        field = next(field for field in LAYOUT if column < field.columns.stop)
        numbers = _format(tokens[row, field.columns].tolist())
        raise BenchmarkError(f"{what}: link {links[row]}: {field.name}: {numbers} is not finite")


def pad_tokens(tokens: Array, max_links: int) -> tuple[Array, NDArray[np.bool_]]:
    """Pad tokens with rows of zeros, so that robots of different sizes share a batch.

    Args:
        tokens: Tokens of one robot, shape (..., n_links, 48).
        max_links: Number of rows after padding.

    Returns:
        Tokens (..., max_links, 48), and a mask (max_links,) that is True for links.

    Raises:
        BenchmarkError: If there are more links than ``max_links``.
    """
    n_links = tokens.shape[-2]
    require_max_links(n_links, "the robot", max_links)
    widths = [(0, 0)] * (tokens.ndim - 2) + [(0, max_links - n_links), (0, 0)]
    return np.pad(tokens, widths), np.arange(max_links) < n_links


def tokens_npz(tokens: Array, links: Sequence[str], name: str, max_links: int = MAX_LINKS) -> bytes:
    """Return an npz file of a robot's tokens and their description.

    Arrays: ``tokens`` (..., n_links, 48), names of the ``links`` (n_links,), names of the fields
    in ``layout`` (9,), first and end index of each field in ``columns`` (9, 2), ``name`` and
    ``max_links``.
    """
    content = io.BytesIO()
    np.savez(
        content,
        tokens=tokens,
        links=np.array(links),
        layout=np.array([field.name for field in LAYOUT]),
        columns=np.array([(field.start, field.columns.stop) for field in LAYOUT]),
        name=np.array(name),
        max_links=np.array(max_links),
    )
    return content.getvalue()


def encode_position(x: Array) -> Array:
    """Encode normalized joint positions as sines and cosines of doubling frequencies.

    As in NeRF (Mildenhall et al. 2020, equation 4), but the lowest frequency is pi/2 instead of pi,
    with which both limits would have the same code.

    Args:
        x: Positions, -1 at the lower and 1 at the upper limit, shape (...).

    Returns:
        Eight sines, then eight cosines, shape (..., 16).
    """
    angles = x[..., None] * FREQUENCIES
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)


def decode_position(numbers: Array) -> float:
    """Decode the 16 numbers of ``joint position`` to a normalized position in [-2, 2].

    Raises:
        ValueError: If the frequencies contradict each other.
    """
    x = math.atan2(numbers[0], numbers[len(FREQUENCIES)]) / (math.pi / 2)
    error = np.abs(encode_position(np.array(x)) - numbers)
    if error.max() > TOLERANCE:
        worst = int(error.argmax())
        raise ValueError(
            f"number {worst} is {numbers[worst]:g}, but the first frequency says x = {x:g}"
        )
    return x


def encode_primitive(geometry: Geometry) -> tuple[float, ...]:
    """Encode a primitive; a capsule becomes the cylinder of its total length.

    Raises:
        ValueError: If the geometry is a mesh, or a size is not positive.
    """
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
    _require_sizes(sizes)
    return (*_one_hot(kind, SHAPES), *sizes)


def decode_primitive(numbers: Array) -> Primitive | None:
    """Decode the 6 numbers of ``geometry``; None if they are zeros.

    Raises:
        ValueError: If they are not the code of a primitive.
    """
    if not numbers.any():
        return None
    kind = SHAPES[_hot_index(numbers[:3], SHAPES)]
    x, y, z = sizes = numbers[3:].tolist()
    _require_sizes(sizes)
    if kind == "box":
        return Box((x, y, z))
    equal = sizes if kind == "sphere" else sizes[:2]
    if max(equal) - min(equal) > TOLERANCE * max(equal):
        raise ValueError(f"a {kind} has {len(equal)} times its radius, not {_format(equal)}")
    return Sphere(x) if kind == "sphere" else Cylinder(x, z)


def encode_kind(kind: JointKind) -> tuple[float, ...]:
    """Encode a joint type; a continuous joint counts as revolute."""
    return _one_hot("revolute" if kind == "continuous" else kind, KINDS)


def decode_kind(numbers: Array) -> JointKind:
    """Decode the 3 numbers of ``joint type``.

    Raises:
        ValueError: If they are not a one-hot code.
    """
    return KINDS[_hot_index(numbers, KINDS)]


def encode_pose(pose: Pose) -> tuple[float, ...]:
    """Encode a pose as its position [m] and its quaternion (w, x, y, z) with w >= 0.

    Raises:
        ValueError: If the quaternion is zero or not finite.
    """
    return (*pose.position, *rotation.normalize(pose.quaternion))


def decode_pose(numbers: Array) -> Pose:
    """Decode the 7 numbers of a pose.

    Raises:
        ValueError: If the quaternion is not of unit length.
    """
    x, y, z, w, a, b, c = numbers.tolist()
    norm = math.hypot(w, a, b, c)
    if abs(norm - 1) > TOLERANCE:
        raise ValueError(f"the quaternion {_format((w, a, b, c))} is of length {norm:g}, not 1")
    return Pose((x, y, z), rotation.normalize((w, a, b, c)))


def decode_axis(numbers: Array) -> Vec3:
    """Decode the 3 numbers of ``joint axis``.

    Raises:
        ValueError: If the axis is not of unit length.
    """
    x, y, z = numbers.tolist()
    length = math.hypot(x, y, z)
    if abs(length - 1) > TOLERANCE:
        raise ValueError(f"the axis {_format((x, y, z))} is of length {length:g}, not 1")
    return (x, y, z)


def decode_flag(numbers: Array) -> bool:
    """Decode the 4 numbers of ``end-effector``.

    Raises:
        ValueError: If its four numbers are neither all 0 nor all 1.
    """
    flag = numbers[0] > 0.5
    if np.abs(numbers - flag).max() > TOLERANCE:
        raise ValueError(f"{_format(numbers.tolist())} is neither four times 0 nor four times 1")
    return bool(flag)


def _one_hot(name: str, names: Sequence[str]) -> tuple[float, ...]:
    return tuple(float(name == other) for other in names)


def _hot_index(numbers: Array, names: Sequence[str]) -> int:
    """Return the index that a one-hot code selects."""
    hot = int(numbers.argmax())
    if np.abs(numbers - np.eye(len(names))[hot]).max() > TOLERANCE:
        raise ValueError(f"{_format(numbers.tolist())} is not one-hot over [{', '.join(names)}]")
    return hot


def _require_sizes(sizes: Sequence[float]) -> None:
    if not all(0 < size < math.inf for size in sizes):
        raise ValueError(f"sizes {_format(sizes)} are not all positive and finite")


def _format(numbers: Sequence[float]) -> str:
    return f"[{', '.join(f'{number:g}' for number in numbers)}]"
