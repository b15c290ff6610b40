"""``Robot``: a kinematic tree of links, with named frames and a home configuration."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from morphgen.errors import RobotError, nearest
from morphgen.model.findings import Finding
from morphgen.model.geometry import IDENTITY, Mesh, Pose, Shape, StoredFits
from morphgen.model.rotation import Vec3
from morphgen.typing import Array

JointKind = Literal["revolute", "continuous", "prismatic", "fixed"]
JOINT_KINDS: tuple[JointKind, ...] = ("revolute", "continuous", "prismatic", "fixed")
Pair = tuple[str, str]

TOOL = "tool"  # name of the frame at a robot's working point

DEFAULT_EFFORT = 100.0
"""Effort limit of a joint that names none, where a file format requires one [N m or N]."""
DEFAULT_VELOCITY = 1.0
"""Velocity limit of a joint that names none, where a file format requires one [rad/s or m/s]."""


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a link."""

    mass: float
    """Mass [kg]."""
    com: Vec3 = (0.0, 0.0, 0.0)
    """Centre of mass in the link frame [m]."""
    inertia: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    """(ixx, ixy, ixz, iyy, iyz, izz) about the centre of mass, in link axes [kg m^2]."""

    @property
    def matrix(self) -> Array:
        """The inertia about the centre of mass, in link axes, shape (3, 3) [kg m^2]."""
        xx, xy, xz, yy, yz, zz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    @classmethod
    def from_matrix(cls, mass: float, com: Vec3, matrix: Array) -> Inertial:
        """Build from a symmetric (3, 3) inertia about the centre of mass, in link axes."""
        m = matrix.tolist()
        return cls(mass, com, (m[0][0], m[0][1], m[0][2], m[1][1], m[1][2], m[2][2]))


@dataclass(frozen=True)
class Link:
    """A rigid body: its mass properties, visual shapes and collision shapes."""

    name: str
    inertial: Inertial | None = None
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()

    @property
    def is_empty(self) -> bool:
        """Whether the link is a bare frame, with neither mass nor shapes."""
        return (
            not self.visuals
            and not self.collisions
            and (self.inertial is None or self.inertial.mass == 0.0)
        )

    @property
    def solid_shapes(self) -> tuple[Shape, ...]:
        """The shapes that the link fills: its collision shapes, or without any its visual ones."""
        return self.collisions or self.visuals


@dataclass(frozen=True)
class Mimic:
    """Couples a joint to another one: ``q = multiplier * q[joint] + offset``."""

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
    """Pose of the joint frame in the parent link's frame, at position zero."""
    axis: Vec3 = (1.0, 0.0, 0.0)
    """Direction of motion in the joint frame."""
    limits: tuple[float, float] | None = None
    """Lower and upper position limit [rad or m]; None if the source names none."""
    effort: float | None = None
    """Effort limit [N m or N]; None if the source names none."""
    velocity: float | None = None
    """Velocity limit [rad/s or m/s]; None if the source names none."""
    damping: float = 0.0
    """Viscous damping [N m s/rad or N s/m]."""
    friction: float = 0.0
    """Dry friction [N m or N]."""
    mimic: Mimic | None = None

    @property
    def is_movable(self) -> bool:
        """Whether the joint is not fixed."""
        return self.kind != "fixed"

    @property
    def is_independent(self) -> bool:
        """Whether the joint is neither fixed nor a mimic joint."""
        return self.kind != "fixed" and self.mimic is None

    @property
    def is_continuous(self) -> bool:
        """Whether the joint rotates without limits, whatever its kind in the source."""
        return self.kind == "continuous" or (self.kind == "revolute" and self.limits is None)

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
        """Position limits [rad or m]; without any, (-pi, pi) and for prismatic joints (-1, 1)."""
        if self.limits is not None and self.kind != "continuous":
            return self.limits
        return (-1.0, 1.0) if self.kind == "prismatic" else (-math.pi, math.pi)


@dataclass(frozen=True)
class Frame:
    """A named frame on a link, such as the tool."""

    name: str
    link: str
    T_link_frame: Pose = IDENTITY
    """Pose of the frame in the link's frame."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A kinematic tree of links and joints: a whole robot, or a part of one.

    Lengths are in metres, angles in radians, masses in kilograms. Joint positions ``q`` have shape
    (dof,) and contain the independent joints only, in the order of ``independent_joints``.

    Attributes:
        name: Name of the robot.
        links: The links in topological order, root first, shape (n_links,).
        joints: The joints; ``joints[k]`` attaches ``links[k + 1]`` to its parent, shape
            (n_links - 1,).
        frames: Named frames on links. The frame ``tool`` is the working point.
        home: Home configuration, the position of every independent joint, shape (dof,)
            [rad or m].
        ignore_pairs: Pairs of links whose contact is not a self-collision; each pair and the
            whole tuple are sorted.
        provenance: Plain data about the robot's origin (derivation, parts, licences), which the
            bundle's card contains.
        source_findings: Suspicious, repaired or skipped content of the file that the robot was
            read from.
        fits: Known primitive fits of the links' collision shapes, by a hash of these shapes.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    frames: tuple[Frame, ...] = ()
    home: tuple[float, ...] = ()
    ignore_pairs: tuple[Pair, ...] = ()
    provenance: Mapping[str, object] = field(default_factory=dict)
    source_findings: tuple[Finding, ...] = ()
    fits: StoredFits = field(default_factory=dict)

    def __repr__(self) -> str:
        """Return one line, because the fields would fill pages."""
        return (
            f"Robot({self.name!r}: {len(self.links)} links, {self.dof} independent joints, "
            f"{self.mass:.4g} kg)"
        )

    def __post_init__(self) -> None:
        """Validate names, tree order, mimic joints, home and frames.

        Raises:
            RobotError: If they contradict each other.
        """
        where = f"robot {self.name!r}"
        if not self.links:
            raise RobotError(f"{where} has no links")
        self._require_unique("link", (link.name for link in self.links))
        self._require_unique("joint", (joint.name for joint in self.joints))
        self._require_unique("frame", (frame.name for frame in self.frames))
        if len(self.joints) != len(self.links) - 1:
            raise RobotError(
                f"{where}: {len(self.links)} links need {len(self.links) - 1} joints, "
                f"not {len(self.joints)}"
            )
        for k, joint in enumerate(self.joints):
            child = self.links[k + 1].name
            if joint.child != child or self.link_index.get(joint.parent, k + 1) > k:
                raise RobotError(
                    f"{where}: joint {joint.name!r} ({joint.parent} -> {joint.child}) "
                    f"is out of topological order at link {child!r}"
                )
            self._validate_mimic(joint)
        if len(self.home) != self.dof:
            raise RobotError(f"{where}: home has {len(self.home)} values for {self.dof} joints")
        for frame in self.frames:
            if frame.link not in self.link_index:
                raise RobotError(
                    f"{where}: frame {frame.name!r} is on the unknown link {frame.link!r}"
                    + nearest(frame.link, self.link_index)
                )

    def _require_unique(self, element: str, names: Iterable[str]) -> None:
        repeated = next((name for name, count in Counter(names).items() if count > 1), None)
        if repeated is not None:
            raise RobotError(f"robot {self.name!r}: two {element}s are named {repeated!r}")

    def _validate_mimic(self, joint: Joint) -> None:
        """Follow a mimic joint's leaders to an independent or fixed joint."""
        chain = [joint.name]
        while joint.mimic is not None:
            leader = joint.mimic.joint
            if leader not in self.joint_index:
                raise RobotError(
                    f"robot {self.name!r}: joint {joint.name!r} mimics {leader!r}, an unknown joint"
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
        """Index of every link's parent link; -1 for the root."""
        return (-1, *(self.link_index[joint.parent] for joint in self.joints))

    @cached_property
    def movable_joints(self) -> tuple[int, ...]:
        """Indices of the joints that are not fixed, mimic joints included."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.is_movable)

    @cached_property
    def movable_rows(self) -> dict[int, int]:
        """Place of every movable joint among the movable ones, by its index."""
        return {k: row for row, k in enumerate(self.movable_joints)}

    @cached_property
    def independent_joints(self) -> tuple[int, ...]:
        """Indices of the joints that are neither fixed nor mimic joints, in the order of ``q``."""
        return tuple(k for k, joint in enumerate(self.joints) if joint.is_independent)

    @cached_property
    def independent_rows(self) -> list[int]:
        """Places of the independent joints among the movable ones, shape (dof,)."""
        return [self.movable_rows[k] for k in self.independent_joints]

    @cached_property
    def mimic_map(self) -> tuple[Array, Array]:
        """Matrix M (n_movable, dof) and offset b (n_movable,): movable positions are M q + b."""
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
        """Return the indices of the joints between the root and a link, root first.

        Raises:
            RobotError: If the link is unknown.
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
        """Total mass [kg]."""
        return math.fsum(link.inertial.mass for link in self.links if link.inertial is not None)

    @property
    def root(self) -> Link:
        """The link at the base of the tree."""
        return self.links[0]

    @property
    def tool(self) -> Frame | None:
        """The frame at the working point; None without one."""
        return next((frame for frame in self.frames if frame.name == TOOL), None)

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """All meshes, each once, in the order of the links, those of visual shapes first."""
        shapes = (shape for link in self.links for shape in (*link.visuals, *link.collisions))
        geometries = dict.fromkeys(shape.geometry for shape in shapes)
        return tuple(geometry for geometry in geometries if isinstance(geometry, Mesh))

    def link(self, name: str) -> Link:
        """Return a link by name.

        Raises:
            RobotError: If the link is unknown.
        """
        if name not in self.link_index:
            raise RobotError(
                f"robot {self.name!r} has no link {name!r}" + nearest(name, self.link_index)
            )
        return self.links[self.link_index[name]]

    def frame(self, name: str) -> Frame:
        """Return a named frame.

        Raises:
            RobotError: If the frame is unknown.
        """
        for frame in self.frames:
            if frame.name == name:
                return frame
        raise RobotError(
            f"robot {self.name!r} has no frame {name!r}"
            + nearest(name, (frame.name for frame in self.frames))
        )

    def with_links(self, links: Iterable[Link]) -> Robot:
        """Return a copy in which the given links replace those of the same names."""
        by_name = {link.name: link for link in links}
        return replace(self, links=tuple(by_name.get(link.name, link) for link in self.links))


def sorted_pair(a: str, b: str) -> Pair:
    """Return the pair in alphabetical order, as in ``Robot.ignore_pairs``."""
    return (a, b) if a <= b else (b, a)
