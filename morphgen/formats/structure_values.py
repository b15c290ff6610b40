"""What a URDF's elements must contain: children, attributes, numbers."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

from lxml import etree

from morphgen.formats.structure_place import Place, shortened
from morphgen.model.findings import Finding

_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass(frozen=True)
class Numbers:
    """An attribute that holds numbers."""

    attribute: str
    counts: tuple[int, ...] = (1,)
    """How many numbers it may hold."""
    required: bool = False
    positive: bool = False
    nonzero: bool = False
    commas_read: bool = False
    """Whether commas between the numbers are understood all the same."""
    surplus_read: bool = False
    """Whether more numbers are understood all the same: the first ones count."""


LARGEST = 1e20
"""Largest number that a URDF may hold: beyond, simulators overflow."""
SMALLEST = 1e-6
"""Smallest length of a primitive, metres: below, simulators round it to nothing."""
LONGEST_TEXT = 1000
"""Characters of the longest name or file name of a URDF."""
CHILDREN = {
    "link": ("inertial", "visual", "collision"),
    "inertial": ("origin", "mass", "inertia"),
    "visual": ("origin", "geometry", "material"),
    "collision": ("origin", "geometry"),
    "geometry": ("box", "capsule", "cylinder", "sphere", "mesh"),
    "material": ("color",),
    "joint": (
        "origin",
        "parent",
        "child",
        "axis",
        "limit",
        "mimic",
        "dynamics",
        "calibration",
        "safety_controller",
    ),
}
"""The elements that are read, by the element around them."""

_REPEATABLE = ("visual", "collision")
_REQUIRED_CHILDREN = {
    "joint": ("parent", "child"),
}
_EXPECTED_CHILDREN = {
    "inertial": {
        "mass": "its <inertial> without <mass> was left out",
        "inertia": "the missing <inertia> was read as zero",
    },
    "visual": {"geometry": "a <visual> without <geometry> was left out"},
    "collision": {"geometry": "a <collision> without <geometry> was left out"},
}
"""Children that ROS reads a robot without, and what becomes of what holds them."""
_REQUIRED_TEXT = {
    "robot": ("name",),
    "link": ("name",),
    "joint": ("name", "type"),
    "parent": ("link",),
    "child": ("link",),
    "mimic": ("joint",),
    "mesh": ("filename",),
}
_NUMBERS = {
    "origin": (Numbers("xyz", (3,)), Numbers("rpy", (3,))),
    "axis": (Numbers("xyz", (3,)),),
    "limit": tuple(Numbers(name) for name in ("lower", "upper", "effort", "velocity")),
    "mimic": (Numbers("multiplier"), Numbers("offset")),
    "dynamics": (Numbers("damping"), Numbers("friction")),
    "calibration": (Numbers("rising"), Numbers("falling")),
    "safety_controller": tuple(
        Numbers(name)
        for name in ("soft_lower_limit", "soft_upper_limit", "k_position", "k_velocity")
    ),
    "mass": (Numbers("value", required=True),),
    "inertia": tuple(
        Numbers(name, required=True) for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
    ),
    "box": (Numbers("size", (3,), required=True, positive=True, commas_read=True),),
    "sphere": (Numbers("radius", required=True, positive=True),),
    "capsule": (
        Numbers("radius", required=True, positive=True),
        Numbers("length", required=True, positive=True),
    ),
    "cylinder": (
        Numbers("radius", required=True, positive=True),
        Numbers("length", required=True, positive=True),
    ),
    "mesh": (Numbers("scale", (1, 3), nonzero=True, commas_read=True, surplus_read=True),),
    "color": (Numbers("rgba", (4,)),),
}


def content_findings(element: etree._Element, place: Place) -> Iterator[Finding]:
    """Look at an element and everything read inside it.

    Args:
        element: A ``<link>``, ``<joint>``, ``<material>`` or ``<robot>`` (its attributes only).
        place: The place to name in findings.
    """
    tag = element.tag
    yield from _text_findings(element, place)
    for numbers in _NUMBERS.get(tag, ()):
        yield from _number_findings(element, numbers, place)
    yield from _missing_findings(element, place)
    if tag == "geometry":
        yield from _geometry_findings(element, place)
    for name in CHILDREN.get(tag, ()):
        children = element.findall(name)
        if len(children) > 1 and name not in _REPEATABLE:
            yield place.finding(
                children[1],
                "element-repeated",
                f"<{tag}> has {len(children)} <{name}>; the first one counts",
                "keep one",
                f"of {len(children)} <{name}> the first one was taken",
            )
        for child in children:
            yield from content_findings(child, place)


def _text_findings(element: etree._Element, place: Place) -> Iterator[Finding]:
    tag = element.tag
    for name in _REQUIRED_TEXT.get(tag, ()):
        value = element.get(name, "")
        if len(value) > LONGEST_TEXT or not value.isprintable():
            yield place.finding(
                element,
                "text-invalid",
                f"<{tag} {name}={shortened(value)!r}> holds line breaks or other characters that "
                f"cannot be printed, or more than {LONGEST_TEXT} characters",
                "write a shorter text of printable characters",
            )
        if not value.strip():
            yield place.finding(
                element,
                "attribute-missing",
                f"<{tag}> has no {name}",
                f'write <{tag} {name}="...">',
            )


def _missing_findings(element: etree._Element, place: Place) -> Iterator[Finding]:
    tag = element.tag
    for name in _REQUIRED_CHILDREN.get(tag, ()):
        if element.find(name) is None:
            yield place.finding(
                element,
                "element-missing",
                f"<{tag}> has no <{name}>",
                f"add <{name}> or drop <{tag}>",
            )
    for name, repair in _EXPECTED_CHILDREN.get(tag, {}).items():
        if element.find(name) is None:
            yield place.finding(
                element,
                "element-missing",
                f"<{tag}> has no <{name}>",
                f"add <{name}> or drop <{tag}>",
                repair,
            )


def _geometry_findings(element: etree._Element, place: Place) -> Iterator[Finding]:
    kinds = CHILDREN["geometry"]
    shapes = [child for child in element if isinstance(child.tag, str)]
    if not shapes:
        yield place.finding(
            element,
            "geometry-missing",
            "<geometry> is empty",
            f"put one of {_tags(kinds)} into it",
            "a shape with an empty <geometry> was left out",
        )
        return
    known = [shape for shape in shapes if shape.tag in kinds]
    for shape in shapes:
        if shape not in known:
            yield place.finding(
                shape,
                "geometry-unknown",
                f"<{shortened(shape.tag)}> is no geometry that URDF knows",
                f"use one of {_tags(kinds)}",
                f"the geometry <{shortened(shape.tag)}> was left out",
            )
    if len(known) > 1:
        yield place.finding(
            known[1],
            "element-repeated",
            f"<geometry> holds {len(known)} shapes; the first one counts",
            "give each its own <visual> or <collision>",
            f"of {len(known)} shapes in one <geometry> the first one was taken",
        )


def _number_findings(element: etree._Element, numbers: Numbers, place: Place) -> Iterator[Finding]:
    name = numbers.attribute
    text = element.get(name)
    if text is None:
        if numbers.required:
            yield place.finding(
                element,
                "attribute-missing",
                f"<{element.tag}> has no {name}",
                f'write <{element.tag} {name}="...">',
            )
        return
    shown = f'<{element.tag} {name}="{shortened(text)}">'
    counts = " or ".join(str(count) for count in numbers.counts)
    vector = max(numbers.counts) > 1
    words = text.replace(",", " ").split() if vector else text.split()
    wrong = [word for word in words if not _is_number(word)]
    if wrong:
        yield place.finding(
            element,
            "number-malformed",
            f"{shown}: {shortened(wrong[0])!r} is no finite decimal number",
            "write decimal numbers with a point, separated by spaces",
        )
        return
    if len(words) not in numbers.counts:
        surplus = numbers.surplus_read and len(words) > max(numbers.counts)
        yield place.finding(
            element,
            "number-count",
            f"{shown} holds {len(words)} numbers",
            f"write {counts}",
            f"of {shown} the first {max(numbers.counts)} numbers were taken" if surplus else "",
        )
        if not surplus:
            return
        words = words[: max(numbers.counts)]
    if "," in text:
        yield place.finding(
            element,
            "number-commas",
            f"{shown} separates numbers by commas, which MuJoCo refuses",
            "separate them by spaces",
            f"the commas of {shown} were read as spaces" if numbers.commas_read else "",
        )
    values = [float(word) for word in words]
    if max(map(abs, values)) > LARGEST or (numbers.positive and 0 < min(values) < SMALLEST):
        yield place.finding(
            element,
            "number-absurd",
            f"{shown} is no number of a robot",
            f"write numbers up to {LARGEST:g} and lengths from {SMALLEST:g}, in SI units",
        )
    if numbers.positive and min(values) <= 0:
        yield place.finding(
            element,
            "size-not-positive",
            f"{shown} is not positive",
            "write lengths above 0, in metres",
            f"the shape {shown} was left out" if min(values) == 0 else "",
        )
    if numbers.nonzero and 0.0 in values:
        yield place.finding(
            element,
            "mesh-scale-invalid",
            f"{shown} flattens the mesh",
            "write factors other than 0",
        )


def _is_number(word: str) -> bool:
    return _DECIMAL.fullmatch(word) is not None and math.isfinite(float(word))


def _tags(names: tuple[str, ...]) -> str:
    return ", ".join(f"<{name}>" for name in names)
