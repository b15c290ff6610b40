"""URDF and xacro to ``Robot``."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import yourdfpy
from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder, default_finder, resolve_uri
from morphgen.formats.structure import structure_findings
from morphgen.formats.xacro import expand
from morphgen.formats.xml import parse_xml
from morphgen.model.findings import Finding
from morphgen.model.geometry import (
    IDENTITY,
    Box,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Rgba,
    Shape,
    Sphere,
)
from morphgen.model.robot import Frame, Inertial, Joint, JointKind, Link, Mimic, Robot
from morphgen.model.rotation import Vec3


class UnsoundError(FormatError):
    """A URDF whose structure is broken; ``findings`` says where and how."""

    def __init__(self, origin: str, findings: Sequence[Finding]) -> None:
        first = findings[0]
        more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        super().__init__(f"{first.where}: {first.why}; {first.fix}{more}")
        self.origin = origin
        self.findings = tuple(findings)


def read_urdf(
    path: Path, args: Mapping[str, str] | None = None, finder: PackageFinder | None = None
) -> Robot:
    """Read a URDF, or a xacro (by its suffix), with every mesh reference resolved.

    Args:
        path: The file.
        args: xacro arguments.
        finder: Where ROS packages are looked for; by default around ``path``, in ROS's own
            environment and in the installed data packages.

    Returns:
        The robot, without frames; its home is zero, or the middle of a range without zero.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If the file cannot be read, is not XML or does not expand.
    """
    if not path.is_file():
        raise FormatError(f"{path}: no such file")
    finder = finder or default_finder()
    if path.suffix == ".xacro":
        data = expand(path, args or {}, finder)
    elif args:
        raise FormatError(f"{path}: xacro arguments {', '.join(args)} for a file that is no xacro")
    else:
        data = path.read_bytes()
    return robot_from_xml(data, path, finder)


def robot_from_xml(
    data: bytes, path: Path, finder: PackageFinder, *, trusted: bool = False
) -> Robot:
    """Read URDF text.

    Args:
        data: The XML.
        path: Where it comes from, for messages and relative mesh paths.
        finder: Where ``package://`` is looked for.
        trusted: Whether a document of the same structure has been examined before.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If it is not XML.
    """
    root = parse_xml(data, str(path))
    findings = () if trusted else structure_findings(root, str(path))
    findings = tuple(finding for finding in findings if finding.severity == "error")
    if findings:
        raise UnsoundError(str(path), findings)
    urdf = yourdfpy.URDF.load(
        io.BytesIO(etree.tostring(root)), build_scene_graph=False, load_meshes=False
    ).robot
    missing: list[Finding] = []
    meshes = _resolved_meshes(root, path, finder, missing)
    if missing:
        raise UnsoundError(str(path), missing)
    colours = {m.name: _rgba(m) for m in urdf.materials}
    links = {link.name: _link(link, meshes, colours) for link in urdf.links}
    joints = _topological([_joint(joint) for joint in urdf.joints], links)
    order = [_root_name(links, joints), *(joint.child for joint in joints)]
    home = tuple(_rest(joint) for joint in joints if joint.is_independent)
    return Robot(urdf.name, tuple(links[name] for name in order), tuple(joints), home=home)


def with_frames(robot: Robot, names: Sequence[str]) -> Robot:
    """Turn links that ``urdf_text`` wrote for frames back into frames.

    Raises:
        FormatError: If the robot has no such link on a fixed joint.
    """
    joints = {joint.child: joint for joint in robot.joints}
    for name in names:
        if name not in joints or joints[name].is_movable:
            raise FormatError(f"robot {robot.name!r} has no link {name!r} on a fixed joint")
    return replace(
        robot,
        links=tuple(link for link in robot.links if link.name not in names),
        joints=tuple(joint for joint in robot.joints if joint.child not in names),
        frames=tuple(Frame(n, joints[n].parent, joints[n].T_parent_joint) for n in names),
    )


def _resolved_meshes(
    root: etree._Element, path: Path, finder: PackageFinder, missing: list[Finding]
) -> dict[str, Path]:
    meshes: dict[str, Path] = {}
    for element in root.iter("mesh"):
        uri = element.get("filename", "")
        if uri in meshes:
            continue
        try:
            meshes[uri] = resolve_uri(uri, path, finder)
        except FormatError as error:
            meshes[uri] = Path(uri)
            where = f"{path}:{element.sourceline}"
            missing.append(
                Finding("mesh-unresolved", "error", where, str(error), "correct the mesh path")
            )
    return meshes


def _topological(joints: list[Joint], links: Mapping[str, Link]) -> list[Joint]:
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    stack = list(reversed(children.get(_root_name(links, joints), [])))
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(reversed(children.get(joint.child, [])))
    return ordered


def _root_name(links: Mapping[str, Link], joints: Sequence[Joint]) -> str:
    attached = {joint.child for joint in joints}
    return next(name for name in links if name not in attached)


def _rest(joint: Joint) -> float:
    lower, upper = joint.limits or (-math.inf, math.inf)
    if joint.kind == "continuous" or lower <= 0 <= upper or lower > upper:
        return 0.0
    return (lower + upper) / 2


def _link(
    link: yourdfpy.Link, meshes: Mapping[str, Path], colours: Mapping[str, Rgba | None]
) -> Link:
    return Link(
        link.name,
        _inertial(link.inertial),
        tuple(
            Shape(_geometry(v.geometry, meshes), _pose(v.origin), _visual_rgba(v.material, colours))
            for v in link.visuals
        ),
        tuple(Shape(_geometry(c.geometry, meshes), _pose(c.origin)) for c in link.collisions),
    )


def _inertial(inertial: yourdfpy.Inertial | None) -> Inertial | None:
    if inertial is None or inertial.mass is None:
        return None
    T = np.eye(4) if inertial.origin is None else inertial.origin
    inertia = np.zeros((3, 3)) if inertial.inertia is None else inertial.inertia
    R = T[:3, :3]
    x, y, z = T[:3, 3].tolist()
    return Inertial.from_matrix(float(inertial.mass), (x, y, z), R @ inertia @ R.T)


def _geometry(geometry: yourdfpy.Geometry, meshes: Mapping[str, Path]) -> Geometry:
    if geometry.box is not None:
        return Box(_vec3(geometry.box.size))
    if geometry.sphere is not None:
        return Sphere(float(geometry.sphere.radius))
    if geometry.cylinder is not None:
        return Cylinder(float(geometry.cylinder.radius), float(geometry.cylinder.length))
    scale = geometry.mesh.scale
    if scale is None:
        scale = 1.0
    factors = np.broadcast_to(np.asarray(scale, dtype=np.float64), (3,))
    return Mesh(meshes[geometry.mesh.filename], _vec3(factors))


def _pose(matrix: np.ndarray | None) -> Pose:
    return IDENTITY if matrix is None else Pose.from_matrix(matrix)


def _vec3(values: Sequence[float] | np.ndarray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _visual_rgba(
    material: yourdfpy.Material | None, colours: Mapping[str, Rgba | None]
) -> Rgba | None:
    if material is None:
        return None
    return _rgba(material) or colours.get(material.name)


def _rgba(material: yourdfpy.Material) -> Rgba | None:
    if material.color is None:
        return None
    r, g, b, a = (min(max(float(value), 0.0), 1.0) for value in material.color.rgba)
    return (r, g, b, a)


def _joint(joint: yourdfpy.Joint) -> Joint:
    limit, dynamics, mimic = joint.limit, joint.dynamics, joint.mimic
    limits = None
    if limit is not None and (limit.lower is not None or limit.upper is not None):
        limits = (float(limit.lower or 0.0), float(limit.upper or 0.0))
    return Joint(
        joint.name,
        cast(JointKind, joint.type),
        joint.parent,
        joint.child,
        _pose(joint.origin),
        _vec3(joint.axis),
        limits,
        effort=None if limit is None else limit.effort,
        velocity=None if limit is None else limit.velocity,
        damping=0.0 if dynamics is None else float(dynamics.damping or 0.0),
        friction=0.0 if dynamics is None else float(dynamics.friction or 0.0),
        mimic=None if mimic is None else Mimic(mimic.joint, *_mimic_line(mimic)),
    )


def _mimic_line(mimic: yourdfpy.Mimic) -> tuple[float, float]:
    multiplier = 1.0 if mimic.multiplier is None else float(mimic.multiplier)
    return (multiplier, 0.0 if mimic.offset is None else float(mimic.offset))
