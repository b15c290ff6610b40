"""Read SRDF strictly: what a ``Srdf`` cannot hold is refused, not left out."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar

from lxml import etree

from morphgen.errors import FormatError, nearest
from morphgen.formats.data_files import read_bytes
from morphgen.formats.srdf import (
    FLAT_ELEMENTS,
    GROUP,
    SPHERES,
    STATE,
    BoundingSphere,
    Chain,
    FlatElement,
    Group,
    GroupState,
    LinkSpheres,
    Srdf,
)
from morphgen.formats.xml import parse_xml, shortened

_Flat = TypeVar("_Flat", bound=FlatElement | Chain)

MAX_SRDF_BYTES = 16 * 2**20
"""Size of the largest SRDF that is read [bytes]."""


def read_srdf(path: Path) -> Srdf:
    """Read an SRDF file.

    Raises:
        FormatError: If it cannot be read, or as ``parse_srdf``.
    """
    return parse_srdf(read_bytes(path, MAX_SRDF_BYTES), str(path))


def parse_srdf(data: bytes, origin: str) -> Srdf:
    """Read SRDF text; writing the result again loses nothing but comments.

    Args:
        data: The XML.
        origin: Name of the document in errors, usually its path.

    Raises:
        FormatError: If it is not XML, or an element, attribute, number or group is unknown, missing
            or invalid.
    """
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
