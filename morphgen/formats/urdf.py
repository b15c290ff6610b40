"""URDF and xacro to ``Robot``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from lxml import etree

from morphgen.errors import FormatError
from morphgen.formats.data_files import read_bytes
from morphgen.formats.resolve import PackageFinder, default_finder, resolve_uri
from morphgen.formats.structure import structure_findings
from morphgen.formats.urdf_elements import read_colour, read_joint, read_link
from morphgen.formats.urdf_text import OWN
from morphgen.formats.xacro import expand
from morphgen.formats.xml import parse_description
from morphgen.model.findings import Finding
from morphgen.model.robot import Frame, Joint, Link, Robot

LARGEST_DESCRIPTION = 8 * 2**20
"""Bytes of the largest URDF that is read."""


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
    written_frames: bool = False,
) -> Robot:
    """Read a URDF, or a xacro (by its suffix), with every mesh reference resolved.

    Args:
        path: The file.
        args: xacro arguments.
        finder: Where ROS packages are looked for; by default around ``path``, in ROS's own
            environment and in the installed data packages.
        keep_order: Whether links stay in the order of the file's joints, if parents are first
            there; otherwise the tree is walked depth first.
        written_frames: Whether links that ``urdf_text`` wrote for frames become frames again.

    Returns:
        The robot, without frames unless ``written_frames``. Its home is the one that
        ``urdf_text`` wrote, else zero, or the middle of a range without zero. What was repaired or
        left out is listed in ``source_findings``.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If the file cannot be read, is not XML or does not expand.
    """
    if not path.is_file():
        why = "is no regular file" if path.exists() else "no such file"
        raise FormatError(f"{path}: {why}")
    if str(path).encode(errors="replace").decode() != str(path):
        raise FormatError(f"{str(path)!a}: the file's name is no UTF-8 text")
    finder = finder or default_finder()
    if path.suffix == ".xacro":
        data = expand(path, args or {}, finder)
    elif args:
        raise FormatError(f"{path}: xacro arguments {', '.join(args)} for a file that is no xacro")
    else:
        data = read_bytes(path, LARGEST_DESCRIPTION)
    return robot_from_xml(data, path, finder, keep_order=keep_order, written_frames=written_frames)


def robot_from_xml(
    data: bytes,
    path: Path,
    finder: PackageFinder,
    *,
    trusted: bool = False,
    keep_order: bool = False,
    written_frames: bool = False,
) -> Robot:
    """Read URDF text.

    Args:
        data: The XML.
        path: Where it comes from, for messages and relative mesh paths.
        finder: Where ``package://`` is looked for.
        trusted: Whether a document of the same structure has been examined before.
        keep_order: See ``read_urdf``.
        written_frames: See ``read_urdf``.

    Raises:
        UnsoundError: If the tree is broken or a mesh is not found.
        FormatError: If it is not XML.
    """
    root, mended = parse_description(data, str(path))
    findings = () if trusted else structure_findings(root, str(path))
    errors = tuple(finding for finding in findings if finding.severity == "error")
    if errors:
        raise UnsoundError(str(path), errors)
    missing: list[Finding] = []
    meshes = _resolved_meshes(root, path, finder, missing)
    if missing:
        raise UnsoundError(str(path), missing)
    colours = {m.get("name", ""): read_colour(m) for m in root.iterfind("material")}
    found = (read_link(element, meshes, colours) for element in root.iterfind("link"))
    links = {link.name: link for link in found}
    joints = _joints(root)
    if not (keep_order and _parents_first(joints, links)):
        joints = _topological(joints, links)
    order = [_root_name(links, joints), *(joint.child for joint in joints)]
    positions = _told_home(root, str(path))
    home = tuple(positions.get(j.name, _rest(j)) for j in joints if j.is_independent)
    bodies = tuple(links[name] for name in order)
    # Without the folder, a card that lists them is the same on every machine.
    told = tuple(
        replace(finding, where=f"{path.name}{finding.where.removeprefix(str(path))}")
        for finding in (*mended, *findings)
    )
    name = root.get("name", "")
    robot = Robot(name, bodies, tuple(joints), home=home, source_findings=told)
    frames = [frame.get("name", "") for frame in root.iterfind(f"{OWN}/frame")]
    return with_frames(robot, frames) if written_frames else robot


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


def _told_home(root: etree._Element, origin: str) -> dict[str, float]:
    """Positions at home by joint, as ``urdf_text`` wrote them."""
    home = {}
    for element in root.iterfind(f"{OWN}/home"):
        text = element.get("position", "")
        try:
            position = float(text)
        except ValueError:
            position = math.nan
        if not math.isfinite(position):
            raise FormatError(f"{origin}:{element.sourceline}: home position {text!r} is no number")
        home[element.get("joint", "")] = position
    return home


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


def _joints(root: etree._Element) -> list[Joint]:
    """The joints; one that mimics what is no joint moves by itself."""
    joints = [read_joint(element) for element in root.iterfind("joint")]
    names = {joint.name for joint in joints}
    return [
        joint if joint.mimic is None or joint.mimic.joint in names else replace(joint, mimic=None)
        for joint in joints
    ]


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
