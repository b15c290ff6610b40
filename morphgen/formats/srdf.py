"""SRDF, the description that MoveIt reads beside a URDF: its content, its writer and reader."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from lxml import etree

from morphgen.errors import FormatError, nearest, shortened
from morphgen.formats.data_files import read_bytes
from morphgen.formats.xml import parse_xml
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
    """Require that a robot has the frame ``tool``, which an SRDF and planners need."""
    if all(frame.name != TOOL for frame in robot.frames):
        raise FormatError(
            f"robot {robot.name!r} has no frame {TOOL!r}, where its arm ends; import it with a "
            "tool (morphgen import FILE --tool LINK)"
        )


def srdf_text(srdf: Srdf, evidence: str = "") -> str:
    """Write SRDF; ``morphgen.formats.srdf`` reads the same value back."""
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
    """Return the pairs of links whose collisions an SRDF disables, sorted."""
    pairs = {sorted_pair(unchecked.link, b) for unchecked in srdf.unchecked_links for b in links}
    pairs -= {sorted_pair(pair.link1, pair.link2) for pair in srdf.enabled_pairs}
    pairs |= {sorted_pair(pair.link1, pair.link2) for pair in srdf.disabled_pairs}
    return tuple(sorted((a, b) for a, b in pairs if a != b))


def with_disabled_pairs(robot: Robot, srdf: Srdf, origin: str = "SRDF") -> Robot:
    """Return a robot that also ignores the contacts of the pairs that an SRDF disables.

    Links that are frames of the robot have no shapes, so their pairs are left out.
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


_Flat = TypeVar("_Flat", bound=FlatElement | Chain)

MAX_SRDF_BYTES = 16 * 2**20
"""Size of the largest SRDF that is read [bytes]."""


def read_srdf(path: Path) -> Srdf:
    """Read an SRDF file."""
    return parse_srdf(read_bytes(path, MAX_SRDF_BYTES), str(path))


def parse_srdf(data: bytes, origin: str) -> Srdf:
    """Read SRDF text; writing the result again loses nothing but comments."""
    root = parse_xml(data, origin)
    if root.tag != "robot":
        raise FormatError(f"{origin}: root element <{shortened(str(root.tag))}>; expected <robot>")
    name = _attributes(root, ("name",), origin)["name"]
    content: dict[str, list[Any]] = {field.name: [] for field in fields(Srdf)}
    for element in _children(root, (*FLAT_ELEMENTS, GROUP, STATE, SPHERES), origin):
        if element.tag == GROUP:
            content["groups"].append(_read_group(element, origin))
        elif element.tag == STATE:
            content["group_states"].append(_read_state(element, origin))
        elif element.tag == SPHERES:
            content["link_spheres"].append(_read_spheres(element, origin))
        else:
            field, kind = FLAT_ELEMENTS[element.tag]
            content[field].append(_read_flat(element, kind, origin))
    del content["robot"]
    srdf = Srdf(name, **{field: tuple(values) for field, values in content.items()})
    _require_groups(srdf, origin)
    return srdf


def _read_flat(element: etree._Element, kind: type[_Flat], origin: str) -> _Flat:
    _children(element, (), origin)
    required = [field.name for field in fields(kind) if field.default is MISSING]
    optional = [field.name for field in fields(kind) if field.default is not MISSING]
    return kind(**_attributes(element, required, origin, optional))


def _read_group(element: etree._Element, origin: str) -> Group:
    content: dict[str, list[Any]] = {"link": [], "joint": [], "chain": [], GROUP: []}
    for child in _children(element, content, origin):
        if child.tag == "chain":
            content["chain"].append(_read_flat(child, Chain, origin))
            continue
        _children(child, (), origin)
        content[child.tag].append(_attributes(child, ("name",), origin)["name"])
    name = _attributes(element, ("name",), origin)["name"]
    return Group(name, *(tuple(values) for values in content.values()))


def _read_state(element: etree._Element, origin: str) -> GroupState:
    positions = []
    for child in _children(element, ("joint",), origin):
        joint = _attributes(child, ("name", "value"), origin)
        positions.append((joint["name"], _numbers(child, "value", origin)))
    return GroupState(**_attributes(element, ("name", "group"), origin), positions=tuple(positions))


def _read_spheres(element: etree._Element, origin: str) -> LinkSpheres:
    spheres = []
    for child in _children(element, ("sphere",), origin):
        _attributes(child, ("center", "radius"), origin)
        x, y, z = _numbers(child, "center", origin, count=3)
        (radius,) = _numbers(child, "radius", origin, count=1)
        if radius < 0:
            raise FormatError(f"{_place(child, origin)}: radius {radius:g}; expected 0 or more")
        spheres.append(BoundingSphere((x, y, z), radius))
    return LinkSpheres(_attributes(element, ("link",), origin)["link"], tuple(spheres))


def _place(element: etree._Element, origin: str) -> str:
    return f"{origin}:{element.sourceline}: <{shortened(str(element.tag))}>"


def _children(
    element: etree._Element, tags: Iterable[str], origin: str
) -> Iterator[etree._Element]:
    """Return the children of an element, which must all have one of the tags."""
    for child in element:
        if child.tag not in tags:
            parent = shortened(str(element.tag))
            raise FormatError(
                f"{_place(child, origin)} is unknown in <{parent}>" + nearest(str(child.tag), tags)
            )
    return iter(element)


def _attributes(
    element: etree._Element, required: Iterable[str], origin: str, optional: Iterable[str] = ()
) -> dict[str, str]:
    """Return the attributes of an element; the required ones must not be missing or empty."""
    attributes = {str(name): str(value) for name, value in element.attrib.items()}
    for name in required:
        if not attributes.get(name):
            raise FormatError(f"{_place(element, origin)}: missing attribute {name!r}")
    valid = (*required, *optional)
    for name in attributes:
        if name not in valid:
            raise FormatError(
                f"{_place(element, origin)}: unknown attribute {shortened(name)!r}"
                + nearest(name, valid)
            )
    return attributes


def _numbers(
    element: etree._Element, attribute: str, origin: str, count: int | None = None
) -> tuple[float, ...]:
    """Return the finite numbers of an attribute; ``count`` of them, or any number but zero."""
    text = element.get(attribute, "")
    try:
        values = tuple(map(float, text.split()))
    except ValueError:
        values = (math.nan,)
    is_right = len(values) == count if count is not None else len(values) > 0
    if not (is_right and all(map(math.isfinite, values))):
        wanted = {None: "finite numbers", 1: "a finite number"}.get(
            count, f"{count} finite numbers"
        )
        raise FormatError(
            f"{_place(element, origin)}: {attribute} {shortened(text)!r}; expected {wanted}"
        )
    return values


def _require_groups(srdf: Srdf, origin: str) -> None:
    """Require that groups have different names and that all named groups exist."""
    names = [group.name for group in srdf.groups]
    for name, count in Counter(names).items():
        if count > 1:
            raise FormatError(f"{origin}: two groups are named {shortened(name)!r}")
    known = set(names)
    named = [(f"group {g.name!r}", sub) for g in srdf.groups for sub in g.subgroups]
    named += [(f"group_state {state.name!r}", state.group) for state in srdf.group_states]
    for effector in srdf.end_effectors:
        parents = (effector.parent_group,) if effector.parent_group else ()
        named += [(f"end_effector {effector.name!r}", g) for g in (effector.group, *parents)]
    for owner, group in named:
        if group not in known:
            raise FormatError(
                f"{origin}: {shortened(owner)} names the unknown group {shortened(group)!r}"
                + nearest(group, names)
            )
