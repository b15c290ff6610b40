"""What the 48 numbers of a link's token mean, field by field, both ways.

Order and sizes are those of the table of the robot's state in AnyBody (arXiv 2505.14986, appendix
on the state space); ``LAYOUT`` says how what it leaves open is meant.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import BenchmarkError
from morphgen.model import rotation
from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Pose, Primitive, Sphere
from morphgen.model.robot import JointKind
from morphgen.model.rotation import Vec3
from morphgen.typing import Array

TOKEN_SIZE = 48
MAX_LINKS = 23
"""The paper's largest robot: 22 links and the base."""
TOLERANCE = 1e-4
"""How far a number may be off and still be read; tokens in single precision are within it."""

SHAPES = ("sphere", "cylinder", "box")
"""What the one-hot of a geometry says, in order."""
KINDS: tuple[JointKind, ...] = ("prismatic", "revolute", "fixed")
"""What the one-hot of a joint says, in order."""
FREQUENCIES: Array = np.array([math.pi / 2 * 2**k for k in range(8)])
"""Angular frequencies of the encoding of a position, rad."""


@dataclass(frozen=True)
class Field:
    """Consecutive numbers of a token that mean one thing."""

    name: str
    start: int
    size: int
    content: str

    @property
    def columns(self) -> slice:
        """Where it is on the last axis of tokens."""
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


def require_max_links(n_links: int, what: str, max_links: int) -> None:
    """Require that so many links can be told apart.

    Raises:
        BenchmarkError: If they are more than ``max_links``, or ``max_links`` is below 2.
    """
    if max_links < 2:
        raise BenchmarkError(f"max_links {max_links}: expected 2 or more, such as {MAX_LINKS}")
    if n_links > max_links:
        raise BenchmarkError(
            f"{what} has {n_links} links, more than max_links {max_links}; "
            f"make max_links {n_links} or more, the same for all robots that are compared"
        )


def require_finite(tokens: Array, what: str, links: Sequence[str]) -> None:
    """Require that tokens (n_links, 48) are finite.

    Raises:
        BenchmarkError: If a number is not; the message names its link and field.
    """
    lost = np.argwhere(~np.isfinite(tokens))
    if len(lost):
        row, column = lost[0].tolist()
        field = next(field for field in LAYOUT if column < field.columns.stop)
        numbers = _listed(tokens[row, field.columns].tolist())
        raise BenchmarkError(f"{what}: link {links[row]}: {field.name}: {numbers} is not finite")


def pad_tokens(tokens: Array, max_links: int) -> tuple[Array, NDArray[np.bool_]]:
    """Tokens with rows of zeros below, so that robots of several sizes share a batch.

    Args:
        tokens: Shape (..., n_links, 48).
        max_links: Rows that are wanted.

    Returns:
        Tokens (..., max_links, 48), and a mask (max_links,): True where there is a link.

    Raises:
        BenchmarkError: If there are more links than that.
    """
    n_links = tokens.shape[-2]
    require_max_links(n_links, "the robot", max_links)
    widths = [(0, 0)] * (tokens.ndim - 2) + [(0, max_links - n_links), (0, 0)]
    return np.pad(tokens, widths), np.arange(max_links) < n_links


def tokens_npz(tokens: Array, links: Sequence[str], name: str, max_links: int = MAX_LINKS) -> bytes:
    """A file for ``numpy.load``: a robot's tokens and what is needed to understand them.

    Arrays: ``tokens`` (..., n_links, 48), names of ``links`` (n_links,), names of the fields in
    ``layout`` (9,), where these start and end in ``columns`` (9, 2), ``name`` and ``max_links``.
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
    """The numbers of ``joint position``.

    Sines and cosines of doubling frequencies, as in NeRF (Mildenhall et al. 2020, equation 4), but
    from pi/2 on: from pi on, as there, both ends of a range would have the same code.

    Args:
        x: Positions, -1 at the lower and 1 at the upper limit, shape (...).

    Returns:
        Eight sines, then eight cosines, shape (..., 16).
    """
    angles = x[..., None] * FREQUENCIES
    return np.concatenate([np.sin(angles), np.cos(angles)], axis=-1)


def decode_position(numbers: Array) -> float:
    """The scaled position, in [-2, 2], that the 16 numbers of ``joint position`` say.

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
    """The numbers of ``geometry``; a capsule counts as the cylinder of its whole length.

    Raises:
        ValueError: If the geometry is a mesh or has no size.
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
    """The primitive that the 6 numbers of ``geometry`` say; None if they are zeros.

    Raises:
        ValueError: If they say none.
    """
    if not numbers.any():
        return None
    kind = SHAPES[_hot(numbers[:3], SHAPES)]
    x, y, z = sizes = numbers[3:].tolist()
    _require_sizes(sizes)
    if kind == "box":
        return Box((x, y, z))
    equal = sizes if kind == "sphere" else sizes[:2]
    if max(equal) - min(equal) > TOLERANCE * max(equal):
        raise ValueError(f"a {kind} has {len(equal)} times its radius, not {_listed(equal)}")
    return Sphere(x) if kind == "sphere" else Cylinder(x, z)


def encode_kind(kind: JointKind) -> tuple[float, ...]:
    """The numbers of ``joint type``; a continuous joint is revolute."""
    return _one_hot("revolute" if kind == "continuous" else kind, KINDS)


def decode_kind(numbers: Array) -> JointKind:
    """The kind that the 3 numbers of ``joint type`` say.

    Raises:
        ValueError: If they say none.
    """
    return KINDS[_hot(numbers, KINDS)]


def encode_pose(pose: Pose) -> tuple[float, ...]:
    """The numbers of a pose: position, then quaternion with w >= 0.

    Raises:
        ValueError: If the quaternion is zero or not finite.
    """
    return (*pose.position, *rotation.normalize(pose.quaternion))


def decode_pose(numbers: Array) -> Pose:
    """The pose that 7 numbers say.

    Raises:
        ValueError: If the quaternion is not of unit length.
    """
    x, y, z, w, a, b, c = numbers.tolist()
    norm = math.hypot(w, a, b, c)
    if abs(norm - 1) > TOLERANCE:
        raise ValueError(f"the quaternion {_listed((w, a, b, c))} is of length {norm:g}, not 1")
    return Pose((x, y, z), rotation.normalize((w, a, b, c)))


def decode_axis(numbers: Array) -> Vec3:
    """The axis that 3 numbers say.

    Raises:
        ValueError: If it is not of unit length.
    """
    x, y, z = numbers.tolist()
    length = math.hypot(x, y, z)
    if abs(length - 1) > TOLERANCE:
        raise ValueError(f"the axis {_listed((x, y, z))} is of length {length:g}, not 1")
    return (x, y, z)


def decode_flag(numbers: Array) -> bool:
    """Whether ``end-effector`` is set.

    Raises:
        ValueError: If its four numbers are neither all 0 nor all 1.
    """
    flag = numbers[0] > 0.5
    if np.abs(numbers - flag).max() > TOLERANCE:
        raise ValueError(f"{_listed(numbers.tolist())} is neither four times 0 nor four times 1")
    return bool(flag)


def _one_hot(name: str, names: Sequence[str]) -> tuple[float, ...]:
    return tuple(float(name == each) for each in names)


def _hot(numbers: Array, names: Sequence[str]) -> int:
    """Which name a one-hot says."""
    hot = int(numbers.argmax())
    if np.abs(numbers - np.eye(len(names))[hot]).max() > TOLERANCE:
        raise ValueError(f"{_listed(numbers.tolist())} is no one-hot of [{', '.join(names)}]")
    return hot


def _require_sizes(sizes: Sequence[float]) -> None:
    if not all(0 < size < math.inf for size in sizes):
        raise ValueError(f"sizes {_listed(sizes)} are not all positive and finite")


def _listed(numbers: Sequence[float]) -> str:
    return f"[{', '.join(f'{number:g}' for number in numbers)}]"
