"""URDF and xacro to ``Robot``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats.resolve import PackageFinder, default_finder, resolve_uri
from morphgen.formats.structure import structure_findings
from morphgen.formats.urdf_elements import read_colour, read_joint, read_link
from morphgen.formats.xacro import expand
from morphgen.formats.xml import parse_xml
from morphgen.model.findings import Finding
from morphgen.model.robot import Frame, Joint, Link, Robot


class UnsoundError(FormatError):
    """A URDF whose structure is broken; ``findings`` says where and how."""

    def __init__(self, origin: str, findings: Sequence[Finding]) -> None:
        first = findings[0]
        more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        super().__init__(f"{first.where}: {first.why}; {first.fix}{more}")
        self.origin = origin
        self.findings = tuple(findings)


def read_urdf(
    path: Path,
    args: Mapping[str, str] | None = None,
    finder: PackageFinder | None = None,
    *,
    keep_order: bool = False,
) -> Robot:
    """Read a URDF, or a xacro (by its suffix), with every mesh reference resolved.

    Args:
        path: The file.
        args: xacro arguments.
        finder: Where ROS packages are looked for; by default around ``path``, in ROS's own
            environment and in the installed data packages.
        keep_order: Whether links stay in the order of the file's joints, if parents are first
            there; otherwise the tree is walked depth first.

    Returns:
        The robot, without frames; its home is zero, or the middle of a range without zero.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If the file cannot be read, is not XML or does not expand.
    """
    if not path.is_file():
        raise FormatError(f"{path}: no such file")
    if str(path).encode(errors="replace").decode() != str(path):
        raise FormatError(f"{str(path)!a}: the file's name is no UTF-8 text")
    finder = finder or default_finder()
    if path.suffix == ".xacro":
        data = expand(path, args or {}, finder)
    elif args:
        raise FormatError(f"{path}: xacro arguments {', '.join(args)} for a file that is no xacro")
    else:
        data = path.read_bytes()
    return robot_from_xml(data, path, finder, keep_order=keep_order)


def robot_from_xml(
    data: bytes,
    path: Path,
    finder: PackageFinder,
    *,
    trusted: bool = False,
    keep_order: bool = False,
) -> Robot:
    """Read URDF text.

    Args:
        data: The XML.
        path: Where it comes from, for messages and relative mesh paths.
        finder: Where ``package://`` is looked for.
        trusted: Whether a document of the same structure has been examined before.
        keep_order: See ``read_urdf``.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If it is not XML.
    """
    root = parse_xml(data, str(path))
    findings = () if trusted else structure_findings(root, str(path))
    findings = tuple(finding for finding in findings if finding.severity == "error")
    if findings:
        raise UnsoundError(str(path), findings)
    missing: list[Finding] = []
    meshes = _resolved_meshes(root, path, finder, missing)
    if missing:
        raise UnsoundError(str(path), missing)
    colours = {m.get("name", ""): read_colour(m) for m in root.iterfind("material")}
    found = (read_link(element, meshes, colours) for element in root.iterfind("link"))
    links = {link.name: link for link in found}
    joints = [read_joint(element) for element in root.iterfind("joint")]
    if not (keep_order and _parents_first(joints, links)):
        joints = _topological(joints, links)
    order = [_root_name(links, joints), *(joint.child for joint in joints)]
    home = tuple(_rest(joint) for joint in joints if joint.is_independent)
    bodies = tuple(links[name] for name in order)
    return Robot(root.get("name", ""), bodies, tuple(joints), home=home)


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


def _parents_first(joints: Sequence[Joint], links: Mapping[str, Link]) -> bool:
    known = {_root_name(links, joints)}
    for joint in joints:
        if joint.parent not in known:
            return False
        known.add(joint.child)
    return True


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
