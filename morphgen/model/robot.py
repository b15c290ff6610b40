"""``Robot``, the one currency of morphgen: a kinematic tree with bodies and a home pose."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import RobotError, nearest
from morphgen.model.findings import Finding
from morphgen.model.geometry import IDENTITY, Pose, Shape
from morphgen.model.rotation import Vec3

if TYPE_CHECKING:
    from morphgen.model.geometry import StoredFits

JointKind = Literal["revolute", "continuous", "prismatic", "fixed"]
JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic", "fixed")
Pair = tuple[str, str]

TOOL = "tool"
"""Name of the frame at a robot's working point."""

DEFAULT_EFFORT = 100.0
"""What a joint without a largest effort is given where a file must name one, N m or N."""
DEFAULT_VELOCITY = 1.0
"""What a joint without a largest velocity is given where a file must name one, rad/s or m/s."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a link."""

    mass: float
    """Kilograms."""
    com: Vec3 = (0.0, 0.0, 0.0)
    """Centre of mass in the link frame, metres."""
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """(ixx, ixy, ixz, iyy, iyz, izz) about the centre of mass, in link axes, kg m^2."""

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The (3, 3) inertia about the centre of mass, in link axes."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    @classmethod
    def from_matrix(cls, mass: float, com: Vec3, matrix: NDArray[np.float64]) -> Inertial:
        """Build from a symmetric (3, 3) inertia about the centre of mass, in link axes."""
        m = matrix.tolist()
        return cls(mass, com, (m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2]))


@dataclass(frozen=True)
class Link:
    """A rigid body."""

    name: str
    inertial: Inertial | None = None
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether the link is a bare frame: no mass, nothing to see, nothing to touch."""
        return (
            not self.visuals
            and not self.collisions
            and (self.inertial is None or self.inertial.mass == 0.0)
        )


@dataclass(frozen=True)
class Mimic:
    """The joint follows another: ``q = multiplier * q[joint] + offset``."""

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Joint:
    """Attaches the link ``child`` to the link ``parent``."""

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_joint: Pose = IDENTITY
    axis: Vec3 = (1.0, 0.0, 0.0)
    """Direction of motion in the joint frame."""
    limits: tuple[float, float] | None = None
    """(lower, upper) in rad or m; None where there are none."""
    effort: float | None = None
    """Largest torque or force, N m or N."""
    velocity: float | None = None
    """Largest speed, rad/s or m/s."""
    damping: float = 0.0
    friction: float = 0.0
    mimic: Mimic | None = None

    @property
    def is_movable(self) -> bool:
        """Whether the joint moves at all."""
        return self.kind != "fixed"

    @property
    def is_independent(self) -> bool:
        """Whether the joint moves by itself: neither fixed nor a mimic."""
        return self.kind != "fixed" and self.mimic is None

    @cached_property
    def unit_axis(self) -> Vec3:
        """The axis, scaled to unit length.

        Raises:
            RobotError: If the axis is zero.
        """
        length = math.hypot(*self.axis)
        if length < 1e-9:
            raise RobotError(f"joint {self.name!r}: its axis {self.axis} is zero")
        return (self.axis[0] / length, self.axis[1] / length, self.axis[2] / length)

    @property
    def effective_limits(self) -> tuple[float, float]:
        """Range to draw positions from: the limits, or one turn (1 m) about zero without."""
        if self.limits is not None and self.kind != "continuous":
            return self.limits
        return (-1.0, 1.0) if self.kind == "prismatic" else (-math.pi, math.pi)


@dataclass(frozen=True)
class Frame:
    """A named frame on a link, such as the tool."""

    name: str
    link: str
    T_link_frame: Pose = IDENTITY


@dataclass(frozen=True, eq=False)
class Robot:
    """A finished body, or a fragment of one.

    Links are in topological order, the root first; ``joints[k]`` attaches ``links[k + 1]``.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    frames: tuple[Frame, ...] = ()
    home: tuple[float, ...] = ()
    """Resting position of every independent joint, in the order of ``joints``, rad or m."""
    ignore_pairs: tuple[Pair, ...] = ()
    """Sorted pairs of links whose contact is not self-collision."""
    provenance: Mapping[str, object] = field(default_factory=dict)
    """Where the body comes from, ready for its card: derivation, parts, licences."""
    source_findings: tuple[Finding, ...] = ()
    """What was suspicious, mended or left out when the robot's file was read."""
    fits: StoredFits = field(default_factory=dict)
    """Primitives that are known of its links' collision shapes, by the content of these."""

    def __repr__(self) -> str:
        """Return one line; the fields would fill pages."""
        return (
            f"Robot({self.name!r}: {len(self.links)} links, {self.dof} independent joints, "
            f"{self.mass:.4g} kg)"
        )

    def __post_init__(self) -> None:
        if not self.links:
            raise RobotError(f"robot {self.name!r} has no links")
        _require_unique("link", (link.name for link in self.links), self.name)
        _require_unique("joint", (joint.name for joint in self.joints), self.name)
        _require_unique("frame", (frame.name for frame in self.frames), self.name)
        if len(self.joints) != len(self.links) - 1:
            raise RobotError(
                f"robot {self.name!r}: {len(self.links)} links need {len(self.links) - 1} joints, "
                f"not {len(self.joints)}"
            )
        for k, joint in enumerate(self.joints):
            child = self.links[k + 1].name
            if joint.child != child or self.link_index.get(joint.parent, k + 1) > k:
                raise RobotError(
                    f"robot {self.name!r}: joint {joint.name!r} ({joint.parent} -> {joint.child}) "
                    f"is out of topological order at link {child!r}"
                )
        self._require_mimics()
        if len(self.home) != self.dof:
            raise RobotError(
                f"robot {self.name!r}: home has {len(self.home)} values for {self.dof} joints"
            )
        for frame in self.frames:
            if frame.link not in self.link_index:
                raise RobotError(
                    f"robot {self.name!r}: frame {frame.name!r} is on no link {frame.link!r}"
                    + nearest(frame.link, self.link_index)
                )

    def _require_mimics(self) -> None:
        for joint in self.joints:
            chain = [joint.name]
            while joint.mimic is not None:
                leader = joint.mimic.joint
                if leader not in self.joint_index:
                    raise RobotError(
                        f"robot {self.name!r}: joint {joint.name!r} mimics {leader!r}, no joint"
                        + nearest(leader, self.joint_index)
                    )
                if leader in chain:
                    raise RobotError(
                        f"robot {self.name!r}: joints mimic each other: "
                        + " -> ".join([*chain, leader])
                    )
                chain.append(leader)
                joint = self.joints[self.joint_index[leader]]

    @cached_property
    def link_index(self) -> dict[str, int]:
        """Index of every link by name."""
        return {link.name: i for i, link in enumerate(self.links)}

    @cached_property
    def joint_index(self) -> dict[str, int]:
        """Index of every joint by name."""
        return {joint.name: i for i, joint in enumerate(self.joints)}

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """Index of every link's parent; -1 for the root."""
        return (-1, *(self.link_index[joint.parent] for joint in self.joints))

    @cached_property
    def movable_joints(self) -> tuple[int, ...]:
        """Indices of the joints that move, mimic joints among them."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.is_movable)

    @cached_property
    def independent_joints(self) -> tuple[int, ...]:
        """Indices of the joints that move by themselves; ``q`` is in this order."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.is_independent)

    @cached_property
    def mimic_map(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The affine map from independent to movable positions, mimic chains followed.

        Matrix (n_movable, dof) and offset (n_movable,).
        """
        column = {self.joints[k].name: i for i, k in enumerate(self.independent_joints)}
        matrix = np.zeros((len(self.movable_joints), self.dof))
        offset = np.zeros(len(self.movable_joints))
        for row, k in enumerate(self.movable_joints):
            joint, gain, shift = self.joints[k], 1.0, 0.0
            while joint.mimic is not None:
                shift += gain * joint.mimic.offset
                gain *= joint.mimic.multiplier
                joint = self.joints[self.joint_index[joint.mimic.joint]]
            if joint.name in column:
                matrix[row, column[joint.name]] = gain
            offset[row] = shift
        return matrix, offset

    def joint_chain(self, link: str) -> tuple[int, ...]:
        """Indices of the joints on the way from the root to a link.

        Raises:
            RobotError: If there is no such link.
        """
        path, i = [], self.link_index[self.link(link).name]
        while i > 0:
            path.append(i - 1)
            i = self.parents[i]
        return tuple(reversed(path))

    @property
    def dof(self) -> int:
        """Number of independent joints."""
        return len(self.independent_joints)

    @property
    def mass(self) -> float:
        """Total mass, kg."""
        return math.fsum(link.inertial.mass for link in self.links if link.inertial is not None)

    @property
    def root(self) -> Link:
        """The first link."""
        return self.links[0]

    def link(self, name: str) -> Link:
        """The link of that name.

        Raises:
            RobotError: If there is none.
        """
        if name not in self.link_index:
            raise RobotError(
                f"robot {self.name!r} has no link {name!r}" + nearest(name, self.link_index)
            )
        return self.links[self.link_index[name]]

    def frame(self, name: str) -> Frame:
        """The frame of that name.

        Raises:
            RobotError: If there is none.
        """
        for frame in self.frames:
            if frame.name == name:
                return frame
        raise RobotError(
            f"robot {self.name!r} has no frame {name!r}"
            + nearest(name, (frame.name for frame in self.frames))
        )

    def with_links(self, links: Iterable[Link]) -> Robot:
        """A copy whose links of the same names are replaced."""
        by_name = {link.name: link for link in links}
        return replace(self, links=tuple(by_name.get(link.name, link) for link in self.links))


def sorted_pair(a: str, b: str) -> Pair:
    """The pair in alphabetical order, as ``Robot.ignore_pairs`` keeps it."""
    return (a, b) if a <= b else (b, a)


def _require_unique(what: str, names: Iterable[str], robot: str) -> None:
    seen: set[str] = set()
    for name in names:
        if name in seen:
            raise RobotError(f"robot {robot!r}: two {what}s are named {name!r}")
        seen.add(name)
