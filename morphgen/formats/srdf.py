"""SRDF, the semantic description of a robot that MoveIt reads beside its URDF: content and writer.

``morphgen.formats.srdf_reader`` reads it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import TypeAlias

from lxml import etree

from morphgen.errors import FormatError, nearest
from morphgen.formats.xml import shortened
from morphgen.model.robot import TOOL, Pair, Robot, sorted_pair
from morphgen.model.rotation import Vec3


@dataclass(frozen=True)
class Chain:
    """The joints and links between two links."""

    base_link: str
    tip_link: str


@dataclass(frozen=True)
class Group:
    """A planning group: links, joints, chains and other groups."""

    name: str
    links: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    chains: tuple[Chain, ...] = ()
    subgroups: tuple[str, ...] = ()


@dataclass(frozen=True)
class GroupState:
    """A named configuration of a group."""

    name: str
    group: str
    positions: tuple[tuple[str, tuple[float, ...]], ...]
    """Joints with their positions [rad or m]; joints of several degrees of freedom have several."""


@dataclass(frozen=True)
class EndEffector:
    """A group that is an end-effector of another one."""

    name: str
    parent_link: str
    """Link that carries the end-effector."""
    group: str
    parent_group: str = ""
    """Group that moves the end-effector; empty if the file names none."""


@dataclass(frozen=True)
class VirtualJoint:
    """A joint between a frame of the world and the robot."""

    name: str
    type: str
    parent_frame: str
    child_link: str


@dataclass(frozen=True)
class PassiveJoint:
    """A joint without an actuator."""

    name: str


@dataclass(frozen=True)
class JointProperty:
    """A named property of a joint."""

    joint_name: str
    property_name: str
    value: str


@dataclass(frozen=True)
class UncheckedLink:
    """A link whose collisions with all links are off, except for the enabled pairs."""

    link: str


@dataclass(frozen=True)
class LinkPair:
    """Two links whose collisions are enabled or disabled."""

    link1: str
    link2: str
    reason: str = ""
    """Why, such as ``Adjacent`` or ``Never``; empty if the file gives no reason."""


@dataclass(frozen=True)
class BoundingSphere:
    """A sphere that bounds a part of a link."""

    center: Vec3
    """Centre in the link's frame [m]."""
    radius: float
    """Radius [m]; MoveIt gives a link no collision shape if its only sphere has radius zero."""


@dataclass(frozen=True)
class LinkSpheres:
    """Spheres that approximate a link."""

    link: str
    spheres: tuple[BoundingSphere, ...]


@dataclass(frozen=True)
class Srdf:
    """The content of an SRDF; each kind of element is in the order of the file."""

    robot: str
    """Name of the robot."""
    virtual_joints: tuple[VirtualJoint, ...] = ()
    groups: tuple[Group, ...] = ()
    group_states: tuple[GroupState, ...] = ()
    end_effectors: tuple[EndEffector, ...] = ()
    passive_joints: tuple[PassiveJoint, ...] = ()
    joint_properties: tuple[JointProperty, ...] = ()
    link_spheres: tuple[LinkSpheres, ...] = ()
    unchecked_links: tuple[UncheckedLink, ...] = ()
    enabled_pairs: tuple[LinkPair, ...] = ()
    disabled_pairs: tuple[LinkPair, ...] = ()


FlatElement: TypeAlias = (
    VirtualJoint | EndEffector | PassiveJoint | JointProperty | UncheckedLink | LinkPair
)
FLAT_ELEMENTS: dict[str, tuple[str, type[FlatElement]]] = {
    "virtual_joint": ("virtual_joints", VirtualJoint),
    "end_effector": ("end_effectors", EndEffector),
    "passive_joint": ("passive_joints", PassiveJoint),
    "joint_property": ("joint_properties", JointProperty),
    "disable_default_collisions": ("unchecked_links", UncheckedLink),
    "enable_collisions": ("enabled_pairs", LinkPair),
    "disable_collisions": ("disabled_pairs", LinkPair),
}
"""Elements without children: their field of ``Srdf`` and their class, whose fields are the
element's attributes; those with a default may be missing."""
GROUP, STATE, SPHERES = "group", "group_state", "link_sphere_approximation"
"""Elements with children."""


def require_tool(robot: Robot) -> None:
    """Require that a robot has the frame ``tool``, which an SRDF and planners need.

    Raises:
        FormatError: If it has no such frame.
    """
    if all(frame.name != TOOL for frame in robot.frames):
        raise FormatError(
            f"robot {robot.name!r} has no frame {TOOL!r}, where its arm ends; import it with a "
            "tool (morphgen import FILE --tool LINK)"
        )


def srdf_text(srdf: Srdf, evidence: str = "") -> str:
    """Write SRDF; ``morphgen.formats.srdf_reader`` reads the same value back.

    Args:
        srdf: The content.
        evidence: Text of a comment before the disabled pairs, such as how they were found.
    """
    root = etree.Element("robot", name=srdf.robot)
    _write_flat(root, "virtual_joint", srdf.virtual_joints)
    for group in srdf.groups:
        element = etree.SubElement(root, GROUP, name=group.name)
        for tag, names in (("link", group.links), ("joint", group.joints)):
            for name in names:
                etree.SubElement(element, tag, name=name)
        _write_flat(element, "chain", group.chains)
        for name in group.subgroups:
            etree.SubElement(element, GROUP, name=name)
    for state in srdf.group_states:
        element = etree.SubElement(root, STATE, name=state.name, group=state.group)
        for joint, values in state.positions:
            etree.SubElement(element, "joint", name=joint, value=_join(values))
    _write_flat(root, "end_effector", srdf.end_effectors)
    _write_flat(root, "passive_joint", srdf.passive_joints)
    _write_flat(root, "joint_property", srdf.joint_properties)
    for approximation in srdf.link_spheres:
        element = etree.SubElement(root, SPHERES, link=approximation.link)
        for sphere in approximation.spheres:
            center, radius = _join(sphere.center), _join([sphere.radius])
            etree.SubElement(element, "sphere", center=center, radius=radius)
    _write_flat(root, "disable_default_collisions", srdf.unchecked_links)
    _write_flat(root, "enable_collisions", srdf.enabled_pairs)
    if evidence:
        root.append(etree.Comment(f" {evidence} "))
    _write_flat(root, "disable_collisions", srdf.disabled_pairs)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def disabled_link_pairs(srdf: Srdf, links: Iterable[str]) -> tuple[Pair, ...]:
    """Return the pairs of links whose collisions an SRDF disables, sorted.

    Args:
        srdf: The SRDF.
        links: Names of all links, with which unchecked links form pairs.
    """
    pairs = {sorted_pair(unchecked.link, b) for unchecked in srdf.unchecked_links for b in links}
    pairs -= {sorted_pair(pair.link1, pair.link2) for pair in srdf.enabled_pairs}
    pairs |= {sorted_pair(pair.link1, pair.link2) for pair in srdf.disabled_pairs}
    return tuple(sorted((a, b) for a, b in pairs if a != b))


def with_disabled_pairs(robot: Robot, srdf: Srdf, origin: str = "SRDF") -> Robot:
    """Return a robot that also ignores the contacts of the pairs that an SRDF disables.

    Links that are frames of the robot have no shapes, so their pairs are left out.

    Args:
        robot: The robot that the SRDF describes.
        srdf: The SRDF.
        origin: Name of the SRDF in errors, usually its path.

    Raises:
        FormatError: If the SRDF names a link that the robot does not have.
    """
    frames = {frame.name for frame in robot.frames}
    pairs = disabled_link_pairs(srdf, robot.link_index)
    for name in dict.fromkeys(link for pair in pairs for link in pair):
        if name not in robot.link_index and name not in frames:
            raise FormatError(
                f"{origin}: robot {robot.name!r} has no link {shortened(name)!r}"
                + nearest(name, robot.link_index)
            )
    known = {pair for pair in pairs if robot.link_index.keys() >= set(pair)}
    return replace(robot, ignore_pairs=tuple(sorted({*robot.ignore_pairs, *known})))


def _write_flat(parent: etree._Element, tag: str, values: Iterable[FlatElement | Chain]) -> None:
    for value in values:
        texts = {field.name: str(getattr(value, field.name)) for field in fields(value)}
        etree.SubElement(parent, tag, {name: text for name, text in texts.items() if text})


def _join(values: Iterable[float]) -> str:
    """Return numbers with all their digits, so that reading them back is exact."""
    return " ".join(repr(float(value)) for value in values)
