"""URDF and xacro to ``Robot``."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import cast

import numpy as np
from lxml import etree

from morphgen.errors import FormatError, shortened
from morphgen.formats import resolve
from morphgen.formats.data_files import read_bytes
from morphgen.formats.rounding import INERTIA_NAMES
from morphgen.formats.urdf.schema import CHILDREN, above_free_base, structure_findings
from morphgen.formats.urdf.write import MORPHGEN_TAG, joined_capsules
from morphgen.formats.xml import found, parse_description
from morphgen.model import rotation
from morphgen.model.findings import Finding
from morphgen.model.geometry import (
    IDENTITY,
    MESH_SUFFIXES,
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
from morphgen.model.mesh import require_bounded_files
from morphgen.model.robot import Frame, Inertial, Joint, JointKind, Link, Mimic, Robot

MAX_URDF_BYTES = 8 * 2**20  # largest URDF that is read [bytes]
_MESH = "geometry[1]/mesh"


class UnsoundError(FormatError):
    """The structure of a URDF is invalid; ``findings`` lists the faults and their locations."""

    def __init__(self, origin: str, findings: Sequence[Finding]) -> None:
        first = findings[0]
        more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
        super().__init__(f"{first.where}: {first.why}; {first.fix}{more}")
        self.origin = origin
        self.findings = tuple(findings)

    def __reduce__(self) -> tuple[type[UnsoundError], tuple[str, tuple[Finding, ...]]]:
        return type(self), (self.origin, self.findings)


def read_urdf(
    path: Path,
    args: Mapping[str, str] | None = None,
    finder: resolve.PackageFinder | None = None,
    *,
    keep_order: bool = False,
    written_frames: bool = False,
) -> Robot:
    """Read a URDF, or a xacro (by its suffix), with every mesh reference resolved.

    The robot has no frames unless ``written_frames``. Its home is the one that ``urdf_text`` wrote,
    else zero, or the middle of a range without zero.
    """
    require_description_file(path)
    finder = finder or resolve.default_finder()
    data = urdf_bytes(path, args or {}, finder)
    return robot_from_xml(data, path, finder, keep_order=keep_order, written_frames=written_frames)


def urdf_bytes(path: Path, args: Mapping[str, str], finder: resolve.PackageFinder) -> bytes:
    """Return the content of a URDF, or of a xacro (by its suffix) when expanded."""
    if path.suffix == ".xacro":
        from morphgen.formats.xacro.expand import expand  # loads xacro and minidom

        return expand(path, args, finder)
    require_no_arguments(path, args)
    return read_bytes(path, MAX_URDF_BYTES)


def require_no_arguments(path: Path, args: Mapping[str, str] | None) -> None:
    """Require that there are no xacro arguments for a file that is not a xacro."""
    if args:
        raise FormatError(
            f"{path}: xacro arguments {', '.join(args)} for a file that is not a xacro"
        )


def require_description_file(path: Path) -> None:
    """Require that a path is a regular file, no mesh, whose name can be printed."""
    if not path.is_file():
        why = "not a regular file" if path.exists() else "no such file"
        raise FormatError(f"{path}: {why}")
    if path.suffix.lower() in MESH_SUFFIXES:
        valid = "a bundle, URDF, xacro or MJCF; `morphgen fit` takes a mesh"
        raise FormatError(f"{path}: a mesh; expected {valid}")
    if str(path).encode(errors="replace").decode() != str(path):
        raise FormatError(f"{str(path)!a}: the file's name is not UTF-8 text")


def robot_from_xml(
    data: bytes,
    path: Path,
    finder: resolve.PackageFinder,
    *,
    trusted: bool = False,
    keep_order: bool = False,
    written_frames: bool = False,
) -> Robot:
    """Read URDF text."""
    root, repairs = parse_description(data, str(path))
    findings = () if trusted else structure_findings(root, str(path))
    errors = tuple(finding for finding in findings if finding.severity == "error")
    if errors:
        raise UnsoundError(str(path), errors)
    for element in () if trusted else above_free_base(root):
        root.remove(element)
    meshes, packages, mesh_findings = resolved_meshes(root, path, finder)
    colours, unknown = _named_colours(root, str(path))
    link_list = [_link(element, meshes, colours) for element in root.iterfind("link")]
    links = {link.name: link for link in link_list}
    joints = [_joint(element) for element in root.iterfind("joint")]
    joint_names = {joint.name for joint in joints}
    joints = [  # a joint that mimics an unknown joint moves independently
        replace(joint, mimic=None)
        if joint.mimic and joint.mimic.joint not in joint_names
        else joint
        for joint in joints
    ]
    if not (keep_order and _parents_first(joints, links)):
        joints = _topological(joints, links)
    order = [_root_name(links, joints), *(joint.child for joint in joints)]
    positions = _written_home(root, str(path))
    home = tuple(positions.get(j.name, _default_position(j)) for j in joints if j.is_independent)
    # Locations without the folder make the card the same on every machine.
    source_findings = tuple(
        replace(finding, where=f"{path.name}{finding.where.removeprefix(str(path))}")
        for finding in (*repairs, *findings, *mesh_findings, *unknown)
    )
    name = root.get("name", "")
    robot = Robot(
        name,
        tuple(links[link] for link in order),
        tuple(joints),
        home=home,
        provenance={"packages": packages} if packages else {},
        source_findings=source_findings,
    )
    frames = [frame.get("name", "") for frame in root.iterfind(f"{MORPHGEN_TAG}/frame")]
    return with_frames(robot, frames) if written_frames else robot


def with_frames(robot: Robot, names: Sequence[str]) -> Robot:
    """Turn links that ``urdf_text`` wrote for frames into frames."""
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


def _written_home(root: etree._Element, origin: str) -> dict[str, float]:
    home = {}
    for element in root.iterfind(f"{MORPHGEN_TAG}/home"):
        text = element.get("position", "")
        try:
            position = float(text)
        except ValueError:
            position = math.nan
        if not math.isfinite(position):
            raise FormatError(
                f"{origin}:{element.sourceline}: home position {text!r} is not a number"
            )
        home[element.get("joint", "")] = position
    return home


def resolved_meshes(
    root: etree._Element, path: Path, finder: resolve.PackageFinder
) -> tuple[dict[str, Path], list[dict[str, str]], list[Finding]]:
    """Return the files of all meshes by URI, the installed packages that they are of, and findings.

    Shapes without a file are removed, if the finder skips them.
    """
    known: dict[str, resolve.FoundFile] = {}
    missing: dict[str, Finding] = {}
    for element in root.iterfind(f"link/*/{_MESH}"):
        uri = element.get("filename", "")
        if uri in known or uri in missing:
            continue
        try:
            known[uri] = _find_mesh(uri, root, path, finder)
        except FormatError as error:
            where, hint = f"{path}:{element.sourceline}", f", {resolve.SKIP_HINT}"
            missing[uri] = found("mesh-unresolved", where, error=error, hint=hint)
    if missing and not finder.skip_missing:
        raise UnsoundError(str(path), list(missing.values()))
    skipped = 0
    for link in root.iterfind("link"):
        for shape in [*link.iterchildren("visual", "collision")]:
            mesh = shape.find(_MESH)
            if mesh is not None and mesh.get("filename") in missing:
                link.remove(shape)
                skipped += 1
    packages, findings = _place_findings(known, str(path))
    if missing:
        names = ", ".join(repr(shortened(uri)) for uri in [*missing][:5])
        first = next(iter(missing.values()))
        values = {"skipped": skipped, "missing": len(missing), "names": names}
        findings.append(found("mesh-skipped", first.where, error=first.why, **values))
    files = {uri: file.path for uri, file in known.items()}
    require_bounded_files(files.values(), str(path))
    return files, packages, findings


def _find_mesh(
    uri: str, root: etree._Element, path: Path, finder: resolve.PackageFinder
) -> resolve.FoundFile:
    """Find a mesh as written, else as MuJoCo does by ``<mujoco><compiler>``."""
    try:
        return resolve.find_file(uri, path, finder)
    except FormatError:
        compiler = root.find("mujoco/compiler")
        if compiler is None:
            raise
        # MuJoCo strips the paths of a URDF unless told otherwise.
        name = PurePosixPath(uri.replace("\\", "/").rpartition("://")[2])
        inside = name if compiler.get("strippath") == "false" else name.name
        with suppress(FormatError):
            folder = compiler.get("meshdir", "").replace("\\", "/")
            return resolve.find_file((PurePosixPath(folder) / inside).as_posix(), path, finder)
        raise


def _place_findings(
    known: Mapping[str, resolve.FoundFile], origin: str
) -> tuple[list[dict[str, str]], list[Finding]]:
    """Return the installed packages of files, and findings about unexpected places, by package."""
    groups: dict[tuple[str, str], list[resolve.FoundFile]] = {}
    for file in known.values():
        if file.place:
            groups.setdefault((file.place, file.package), []).append(file)
    packages, findings = [], []
    for (place, package), files in groups.items():
        values = {"package": package, "count": len(files), "example": files[0].path}
        if place == "installed":
            source = resolve.package_source(files[0])
            packages.append({"package": package, **source})
            findings.append(found("mesh-from-package", origin, **values, **source))
        else:
            findings.append(found("mesh-beside", origin, **values))
    return packages, findings


def _parents_first(joints: Sequence[Joint], links: Mapping[str, Link]) -> bool:
    """Return whether every joint comes after the joint that attaches its parent link."""
    known = {_root_name(links, joints)}
    for joint in joints:
        if joint.parent not in known:
            return False
        known.add(joint.child)
    return True


def _topological(joints: list[Joint], links: Mapping[str, Link]) -> list[Joint]:
    """Return the joints depth first, so that parents precede their children."""
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    ordered: list[Joint] = []
    # Popped in the order of the file.
    stack = list(reversed(children.get(_root_name(links, joints), [])))
    while stack:
        joint = stack.pop()
        ordered.append(joint)
        stack.extend(reversed(children.get(joint.child, [])))
    return ordered


def _root_name(links: Mapping[str, Link], joints: Sequence[Joint]) -> str:
    attached = {joint.child for joint in joints}
    return next(name for name in links if name not in attached)


def _default_position(joint: Joint) -> float:
    """Return the home position without a stored one: zero if it is in range, else the middle."""
    lower, upper = joint.limits or (-math.inf, math.inf)
    if joint.kind == "continuous" or lower <= 0 <= upper or lower > upper:
        return 0.0
    return (lower + upper) / 2


def _link(
    element: etree._Element, meshes: Mapping[str, Path], colours: Mapping[str, Rgba | None]
) -> Link:
    """Convert a ``<link>``; meshes are the files by URI, colours the robot's named materials."""
    visuals, collisions = (
        joined_capsules(
            (holder.get("name", ""), Shape(geometry, _origin(holder), _rgba(holder, colours)))
            for holder in element.iterfind(kind)
            if (geometry := _geometry(holder, meshes)) is not None
        )
        for kind in ("visual", "collision")
    )
    return Link(element.get("name", ""), _inertial(element.find("inertial")), visuals, collisions)


def _joint(element: etree._Element) -> Joint:
    """Convert a ``<joint>``; a missing value is None, except that half a range ends at zero."""
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
        (1.0, 0.0, 0.0) if axis is None else rotation.vec3(_numbers(axis.get("xyz", "1 0 0"))),
        None if lower is None and upper is None else (lower or 0.0, upper or 0.0),
        _number(limit, "effort"),
        _number(limit, "velocity"),
        _number(dynamics, "damping") or 0.0,
        _number(dynamics, "friction") or 0.0,
        _mimic(element.find("mimic")),
    )


def _named_colours(
    root: etree._Element, origin: str
) -> tuple[dict[str, Rgba | None], list[Finding]]:
    """Return the colours of materials, the robot's own first, and a finding about unknown ones."""
    colours = {m.get("name", ""): _colour(m) for m in root.iterfind("material")}
    used = root.findall("link/visual/material")
    for material in used:
        name = material.get("name", "")
        colours[name] = colours.get(name) or _colour(material)
    unknown = [m for m in used if m.get("name") and colours[m.get("name", "")] is None]
    unknown = [m for m in unknown if m.find("texture") is None]
    if not unknown:
        return colours, []
    names = ", ".join(dict.fromkeys(repr(shortened(m.get("name", ""))) for m in unknown[:5]))
    where = f"{origin}:{unknown[0].sourceline}"
    return colours, [found("material-unknown", where, count=len(unknown), names=names)]


def _colour(material: etree._Element) -> Rgba | None:
    """Return the colour of a ``<material>``, clipped to [0, 1]; None without ``<color>``."""
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
    xx, xy, xz, yy, yz, zz = (_number(inertia, name) or 0.0 for name in INERTIA_NAMES)
    inertial = Inertial(mass, T.position, (xx, xy, xz, yy, yz, zz))
    if T.quaternion == IDENTITY.quaternion:
        return inertial
    R = T.matrix[:3, :3]
    # The file gives it in the axes of the origin, a robot in those of the link.
    return Inertial.from_matrix(mass, T.position, np.asarray(R @ inertial.matrix @ R.T))


def _geometry(holder: etree._Element, meshes: Mapping[str, Path]) -> Geometry | None:
    """Return the first shape of a ``<geometry>``; None if there is no shape or its size is 0."""
    shapes = holder.iterfind("geometry[1]/*")
    element = next((shape for shape in shapes if shape.tag in CHILDREN["geometry"]), None)
    if element is None:
        return None
    geometry: Primitive
    match element.tag:
        case "box":
            geometry = Box(rotation.vec3(_numbers(element.get("size", ""))))
        case "sphere":
            geometry = Sphere(float(element.get("radius", "")))
        case "capsule":
            geometry = Capsule(float(element.get("radius", "")), float(element.get("length", "")))
        case "cylinder":
            geometry = Cylinder(float(element.get("radius", "")), float(element.get("length", "")))
        case _:
            # One factor is for all three axes.
            x, *rest = _numbers(element.get("scale", "")) or [1.0]
            y, z = rest[:2] or (x, x)
            return Mesh(meshes[element.get("filename", "")], (x, y, z))
    return None if 0.0 in dimensions(geometry) else geometry


def _origin(holder: etree._Element) -> Pose:
    origin = holder.find("origin")
    if origin is None:
        return IDENTITY
    xyz = rotation.vec3(_numbers(origin.get("xyz", "0 0 0")))
    if (text := origin.get("quat_xyzw")) is not None:
        *vector, scalar = _numbers(text)
        return Pose(xyz, rotation.unit_quaternion((scalar, *vector)))
    return Pose.from_xyz_rpy(xyz, rotation.vec3(_numbers(origin.get("rpy", "0 0 0"))))


def _rgba(holder: etree._Element, colours: Mapping[str, Rgba | None]) -> Rgba | None:
    """Return the colour of a ``<visual>``; None without one, and of a ``<collision>``."""
    material = holder.find("material") if holder.tag == "visual" else None
    if material is None:
        return None
    return _colour(material) or colours.get(material.get("name", ""))


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
