"""A split: which robots are trained on, which tested on, at which task.

Robots are given by their derivations, never by a file, so any machine rebuilds them; the hash of
each body tells that it is the same. ``morphgen.benchmark.split_file`` has the file.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Literal

from morphgen.benchmark.token_layout import MAX_LINKS
from morphgen.errors import BenchmarkError, MeshError
from morphgen.formats.resolve import file_stamp
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
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

Regime = Literal["interpolation", "composition", "extrapolation"]
REGIMES: tuple[Regime, ...] = ("interpolation", "composition", "extrapolation")
Side = Literal["train", "test"]
SIDES: tuple[Side, ...] = ("train", "test")

FORMAT = 1
COMPOSED = "composed"
"""Category of a robot that was drawn from no grammar."""
MADE_MAX_LINKS = "max_links"
"""Key in ``made`` of the most links of a robot, if they are not the paper's."""
HASH_LENGTH = 32
"""Letters of the hash of a body and of the id of a split: 128 bits."""

_GRID = 1e-7
"""Lengths (m), angles (rad), masses (kg) and all else in a hash are told apart to this."""
_GYRATION_GRID = 1e-9
"""The same of inertia over mass, square metres: a finger's is 1e-5."""
_OFF_GRID = 1 / math.pi
"""Keeps decimal numbers away from the middle between two points of the grid, where the last bit
decides."""


@dataclass(frozen=True)
class Member:
    """A robot of a split, and what it does there."""

    name: str
    """Unique within the split, and the name of the robot."""
    category: str
    """The grammar that it was drawn from, or ``composed``."""
    derivation: str
    """Parts and parameters, see ``morphgen.grammar.derivation``."""
    task: str
    """Name of a task; whoever makes environments of the split knows which there are."""
    obstacles: bool
    body: str
    """Hash of the finished body, see ``robot_hash``."""


@dataclass(frozen=True)
class Split:
    """Robots to train and to test on."""

    name: str
    """Such as ``extrapolation/arms/reach``."""
    regime: Regime
    summary: str
    train: tuple[Member, ...]
    test: tuple[Member, ...]
    made: Mapping[str, object] = field(default_factory=dict)
    """How the robots were chosen: arguments and seed of the generator."""
    accepted: Mapping[str, str] = field(default_factory=dict)
    """Findings of the audit that the author knows of: reason by code."""
    reference: str = ""
    """Where the split comes from, such as a paper's table."""
    statistics: Mapping[str, object] = field(default_factory=dict)
    """Figures about its robots, for readers; nothing depends on them."""

    @property
    def max_links(self) -> int:
        """The most links that a robot may have, by which indices of tokens are scaled.

        Raises:
            BenchmarkError: If the split was made with another than a whole number from 2 on.
        """
        given = self.made.get(MADE_MAX_LINKS, MAX_LINKS)
        if type(given) is not int or given < 2:
            raise BenchmarkError(
                f"split {self.name!r}: made: {MADE_MAX_LINKS}: {given!r}; expected a whole number, "
                "2 or more"
            )
        return given

    def side(self, side: Side) -> tuple[Member, ...]:
        """The members of a side."""
        return self.train if side == "train" else self.test


def split_id(split: Split) -> str:
    """A hash of what matters: the regime, and each side's members in order; 32 hex digits."""
    sides = [
        [[m.name, m.category, m.derivation, m.task, m.obstacles, m.body] for m in split.side(side)]
        for side in SIDES
    ]
    return _digest([split.regime, *sides])


def robots(split: Split, side: Side, library: Library) -> Iterator[Robot]:
    """The robots of a side in order, each composed when asked for; see ``member_robot``."""
    for member in split.side(side):
        yield member_robot(member, library)


def member_robot(member: Member, library: Library) -> Robot:
    """Compose the robot of a member.

    Raises:
        BenchmarkError: If its body is not the one that the split was made with.
        GrammarError: If its derivation is none.
        CompositionError: If its parts do not fit any more.
        PartError: If the library lacks a part, or a parameter of it.
        FormatError: If a part's source cannot be read.
    """
    derivation = parse_derivation(member.derivation, f"derivation of {member.name!r}")
    robot = compose(derivation, library, member.name)
    body = robot_hash(robot)
    if body != member.body:
        raise BenchmarkError(
            f"robot {member.name!r}: the split was made with body {member.body}, but its "
            f"derivation gives {body}: a part, or morphgen, has changed since"
        )
    return robot


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
    return _digest([links, joints, _grid(robot.home), where])


def _digest(data: object) -> str:
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
