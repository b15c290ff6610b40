"""Elements of an examined URDF to links and joints.

``structure_findings`` has seen to it that required attributes are there and numbers are numbers.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import numpy as np
from lxml import etree

from morphgen.formats.structure_values import CHILDREN
from morphgen.model.geometry import (
    IDENTITY,
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Primitive,
    Rgba,
    Shape,
    Sphere,
    dimensions,
)
from morphgen.model.robot import Inertial, Joint, JointKind, Link, Mimic
from morphgen.model.rotation import Vec3

_INERTIA = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def read_link(
    element: etree._Element, meshes: Mapping[str, Path], colours: Mapping[str, Rgba | None]
) -> Link:
    """A ``<link>``.

    Args:
        element: The element.
        meshes: File of every mesh by the name that the URDF gives it.
        colours: The robot's named materials.
    """
    return Link(
        element.get("name", ""),
        _inertial(element.find("inertial")),
        tuple(
            Shape(geometry, _origin(visual), _visual_rgba(visual, colours))
            for visual in element.iterfind("visual")
            if (geometry := _geometry(visual, meshes)) is not None
        ),
        tuple(
            Shape(geometry, _origin(collision))
            for collision in element.iterfind("collision")
            if (geometry := _geometry(collision, meshes)) is not None
        ),
    )


def read_joint(element: etree._Element) -> Joint:
    """A ``<joint>``; what it leaves out stays None, but a limit's other end, which is zero."""
    limit, dynamics = element.find("limit"), element.find("dynamics")
    lower, upper = _number(limit, "lower"), _number(limit, "upper")
    parent, child = element.find("parent"), element.find("child")
    axis = element.find("axis")
    return Joint(
        element.get("name", ""),
        cast(JointKind, element.get("type")),
        "" if parent is None else parent.get("link", ""),
        "" if child is None else child.get("link", ""),
        _origin(element),
        (1.0, 0.0, 0.0) if axis is None else _vector(axis.get("xyz", "1 0 0")),
        None if lower is None and upper is None else (lower or 0.0, upper or 0.0),
        _number(limit, "effort"),
        _number(limit, "velocity"),
        _number(dynamics, "damping") or 0.0,
        _number(dynamics, "friction") or 0.0,
        _mimic(element.find("mimic")),
    )


def read_colour(material: etree._Element) -> Rgba | None:
    """The colour of a ``<material>``, each in [0, 1]; None if it names none."""
    colour = material.find("color")
    if colour is None:
        return None
    r, g, b, a = (min(max(value, 0.0), 1.0) for value in _numbers(colour.get("rgba", "1 1 1 1")))
    return (r, g, b, a)


def _inertial(element: etree._Element | None) -> Inertial | None:
    if element is None:
        return None
    mass = _number(element.find("mass"), "value")
    if mass is None:
        return None
    T = _origin(element)
    inertia = element.find("inertia")
    xx, xy, xz, yy, yz, zz = (_number(inertia, name) or 0.0 for name in _INERTIA)
    body = Inertial(mass, T.position, (xx, xy, xz, yy, yz, zz))
    if T.quaternion == IDENTITY.quaternion:
        return body
    R = T.matrix[:3, :3]
    return Inertial.from_matrix(mass, T.position, np.asarray(R @ body.matrix @ R.T))


def _geometry(holder: etree._Element, meshes: Mapping[str, Path]) -> Geometry | None:
    """The first shape that URDF knows; None if there is none, or it has no size."""
    shapes = holder.iterfind("geometry[1]/*")
    element = next((shape for shape in shapes if shape.tag in CHILDREN["geometry"]), None)
    if element is None:
        return None
    geometry: Primitive
    match element.tag:
        case "box":
            geometry = Box(_vector(element.get("size", "")))
        case "sphere":
            geometry = Sphere(float(element.get("radius", "")))
        case "capsule":
            geometry = Capsule(float(element.get("radius", "")), float(element.get("length", "")))
        case "cylinder":
            geometry = Cylinder(float(element.get("radius", "")), float(element.get("length", "")))
        case _:
            x, *rest = _numbers(element.get("scale", "")) or [1.0]
            y, z = rest[:2] or (x, x)
            return Mesh(meshes[element.get("filename", "")], (x, y, z))
    return None if 0.0 in dimensions(geometry) else geometry


def _origin(holder: etree._Element) -> Pose:
    origin = holder.find("origin")
    if origin is None:
        return IDENTITY
    return Pose.from_xyz_rpy(
        _vector(origin.get("xyz", "0 0 0")), _vector(origin.get("rpy", "0 0 0"))
    )


def _visual_rgba(visual: etree._Element, colours: Mapping[str, Rgba | None]) -> Rgba | None:
    material = visual.find("material")
    if material is None:
        return None
    return read_colour(material) or colours.get(material.get("name", ""))


def _mimic(element: etree._Element | None) -> Mimic | None:
    if element is None:
        return None
    multiplier, offset = _number(element, "multiplier"), _number(element, "offset")
    return Mimic(element.get("joint", ""), 1.0 if multiplier is None else multiplier, offset or 0.0)


def _number(element: etree._Element | None, name: str) -> float | None:
    text = None if element is None else element.get(name)
    return None if text is None or not text.strip() else float(text)


def _numbers(text: str) -> list[float]:
    return [float(word) for word in text.replace(",", " ").split()]


def _vector(text: str) -> Vec3:
    x, y, z = _numbers(text)
    return (x, y, z)
