"""Findings about names, shapes and what single loaders refuse."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from morphgen.errors import MeshError
from morphgen.model.findings import Finding, Severity
from morphgen.model.geometry import Capsule, Geometry, Mesh, Shape, dimensions
from morphgen.model.inertia import bounding_box, inertial_from_density
from morphgen.model.mesh import MAX_STL_FACES, convex_hull, left_out, load_mesh
from morphgen.model.robot import TOOL, Inertial, Link, Robot
from morphgen.model.tree import rigid_groups, take_name

EXTENT_RANGE = (1e-3, 10.0)  # plausible range of a link's longest edge [m]
UNIT_RATIOS = {1000.0: "mm and m", 25.4: "inch and mm", 39.37: "inch and m"}
"""Ratios of lengths that indicate a mistaken unit."""
UNIT_TOLERANCE = 1.2  # factor within which a ratio counts as one of UNIT_RATIOS
MIN_SOLIDITY = 1e-9  # volume over the cube of the longest edge below which shapes count as flat

_ONLY_DRAWN = re.compile(r"materials? |texture|\d+ (lines?|points?|spline)")
"""Notes of a mesh file about what has no triangles: they change a picture, and no contact."""


def check_shapes(robot: Robot) -> Iterator[Finding]:
    """Find unreadable shapes and shapes without a size; each mesh is reported once per link."""
    for link in robot.links:
        where = f"link {link.name}"
        collisions = {shape.geometry for shape in link.collisions}
        for geometry in dict.fromkeys(
            shape.geometry for shape in (*link.visuals, *link.collisions)
        ):
            if isinstance(geometry, Mesh):
                yield from _mesh_findings(geometry, where, collides=geometry in collisions)
            elif not is_readable(geometry):
                kind = type(geometry).__name__.lower()
                why = f"a {kind} with dimensions {dimensions(geometry)} m"
                yield Finding("size-not-positive", "error", where, why, "write lengths above 0")


def check_units(robot: Robot) -> Iterator[Finding]:
    """Find links with an implausible size, or a visual-to-collision ratio that is one of units."""
    for link in robot.links:
        where = f"link {link.name}"
        visual, collision = _extent(link.visuals), _extent(link.collisions)
        for kind, extent in (("visual", visual), ("collision", collision)):
            if extent is not None and not EXTENT_RANGE[0] <= extent <= EXTENT_RANGE[1]:
                why = f"its {kind} geometry is {extent:.4g} m large"
                fix = "check the unit (m) and the mesh scale"
                yield Finding("extent-implausible", "warning", where, why, fix)
        if not visual or not collision:
            continue
        ratio = max(visual, collision) / min(visual, collision)
        for unit, units in UNIT_RATIOS.items():
            if unit / UNIT_TOLERANCE <= ratio <= unit * UNIT_TOLERANCE:
                why = (
                    f"visual {visual:.4g} m and collision {collision:.4g} m differ {ratio:.4g} "
                    f"times, about {units}"
                )
                fix = "correct the mesh scale of one of them"
                yield Finding("visual-collision-scale", "warning", where, why, fix)
                break


def is_readable(geometry: Geometry) -> bool:
    """Return whether a primitive has positive dimensions, or a mesh can be loaded."""
    if isinstance(geometry, Mesh):
        return is_scale_valid(geometry) and mesh_fault(geometry) is None
    return all(math.isfinite(size) and size > 0 for size in dimensions(geometry))


def has_hull(geometry: Geometry) -> bool:
    """Return whether a primitive has positive dimensions, or a mesh has a convex hull."""
    if isinstance(geometry, Mesh):
        return is_scale_valid(geometry) and mesh_fault(geometry, reader=convex_hull) is None
    return is_readable(geometry)


def is_scale_valid(mesh: Mesh) -> bool:
    """Return whether every scale factor is finite and not zero."""
    return all(math.isfinite(factor) and factor != 0 for factor in mesh.scale)


def mesh_fault(mesh: Mesh, reader: Callable[[Mesh], object] = load_mesh) -> str | None:
    """Return why ``load_mesh`` or ``convex_hull`` fails on a mesh; None if it succeeds."""
    try:
        reader(mesh)
    except MeshError as error:
        return str(error)
    return None


def unit_density_inertial(link: Link) -> Inertial | None:
    """Return the mass properties of a link's solid shapes at 1 kg/m^3.

    Collision shapes count, or visual ones if there are none. Returns None if there are no shapes,
    if one is invalid, or if all are flat.
    """
    shapes = link.collisions or link.visuals
    if not shapes or not all(has_hull(shape.geometry) for shape in shapes):
        return None
    solid = inertial_from_density(shapes, density=1.0)
    extent = float(np.ptp(bounding_box(shapes), axis=0).max())
    return solid if solid.mass > MIN_SOLIDITY * extent**3 else None


def _mesh_findings(mesh: Mesh, where: str, *, collides: bool) -> Iterator[Finding]:
    if not mesh.path.is_file():
        why, fix = f"{mesh.path}: no such file", "correct the mesh path"
        yield Finding("mesh-unresolved", "error", where, why, fix)
        return
    name = mesh.path.name
    if not is_scale_valid(mesh):
        why, fix = f"{name}: scale {mesh.scale}", "write finite factors other than 0"
        yield Finding("mesh-scale-invalid", "error", where, why, fix)
        return
    fault = mesh_fault(mesh)
    if fault is not None:
        yield Finding("mesh-unreadable", "error", where, fault, "export the mesh again")
        return
    if parts := left_out(mesh.path):
        why = f"{name}: left out: {'; '.join(parts)}"
        fix = "export the mesh as triangles with its materials beside it"
        severity: Severity = "info" if all(map(_ONLY_DRAWN.match, parts)) else "warning"
        yield Finding("mesh-left-out", severity, where, why, fix)
    flat = mesh_fault(mesh, reader=convex_hull) if collides else None
    if flat is not None:
        yield Finding("mesh-flat", "error", where, flat, "collide with a thin box instead")
    faces = len(load_mesh(mesh).faces)
    if faces > MAX_STL_FACES:
        why = (
            f"{name} has {faces} triangles; MuJoCo reads no STL of more than {MAX_STL_FACES} "
            "(the bundle writes OBJ then)"
        )
        yield Finding("mesh-huge", "warning", where, why, "decimate the mesh")


def _extent(shapes: Sequence[Shape]) -> float | None:
    """Return the longest edge of the valid shapes' bounding box [m]; None without any."""
    valid = [shape for shape in shapes if has_hull(shape.geometry)]
    return float(np.ptp(bounding_box(valid), axis=0).max()) if valid else None


_UNSAFE = re.compile(r"[^A-Za-z0-9_.\-]")
_WORLD = "world"
MAX_ROBOT_NAME = 200  # longest name of a robot [characters]


def check_names(robot: Robot) -> Iterator[Finding]:
    """Find names that loaders misinterpret, reserve, or have twice when frames are links."""
    for element, names in all_names(robot).items():
        for name in names:
            if name == safe_robot_name(name) if element == "robot" else is_name_safe(name):
                continue
            characters = " ".join(repr(c) for c in dict.fromkeys(_UNSAFE.findall(name)))
            why = "a bundle's folder cannot have its name"
            if characters or not name:
                contents = characters or "nothing"
                why = f"its name contains {contents}, invalid in paths, scopes and USD"
            fix = (
                "use letters, digits, '_', '-' and '.', in a robot's name not first and at most "
                f"{MAX_ROBOT_NAME}; the repair writes '_'"
            )
            repair = "its name was rewritten with '_' for what loaders dislike"
            yield Finding("name-characters", "warning", f"{element} {name}", why, fix, repair)
    if robot.link_index.get(_WORLD, 0) > 0:
        why = "MuJoCo reserves the name 'world' for the world body, and this link is not the root"
        fix = "rename the link, as the repair does"
        repair = "it was renamed: MuJoCo keeps that name for the world"
        yield Finding("name-reserved", "error", f"link {_WORLD}", why, fix, repair)
    for frame in robot.frames:
        for element, name, taken in (
            ("link", frame.name, robot.link_index),
            ("joint", f"{frame.name}_joint", robot.joint_index),
        ):
            if name in taken:
                why = f"a URDF represents it by a {element} {name!r}, and that name is taken"
                fix = f"rename the frame or the {element}"
                yield Finding("frame-name-taken", "error", f"frame {frame.name}", why, fix)


def check_tool(robot: Robot) -> Iterator[Finding]:
    """Find a robot without a tool frame, or with one that no joint moves."""
    tool = next((frame for frame in robot.frames if frame.name == TOOL), None)
    if tool is None:
        why = "it has no frame 'tool': tasks and reach need one"
        fix = "name the frame at the working point 'tool'"
        yield Finding("tool-missing", "warning", f"robot {robot.name}", why, fix)
    elif robot.dof > 0 and not any(
        robot.joints[k].is_movable for k in robot.joint_chain(tool.link)
    ):
        why = f"it is on link {tool.link}, which no joint moves"
        fix = "put the frame on the end-effector"
        yield Finding("tool-still", "warning", f"frame {TOOL}", why, fix)


def is_name_safe(name: str) -> bool:
    """Return whether a name has letters, digits, ``_``, ``-`` and ``.`` only, and at least one."""
    return bool(name) and _UNSAFE.search(name) is None


def all_names(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return all names of a robot by kind of element; they are unique within each kind."""
    return {
        "robot": (robot.name,),
        "link": tuple(link.name for link in robot.links),
        "joint": tuple(joint.name for joint in robot.joints),
        "frame": tuple(frame.name for frame in robot.frames),
    }


def safe_robot_name(name: str) -> str:
    """Return a safe name that a bundle can have: a letter or digit is first."""
    return _UNSAFE.sub("_", name).lstrip("_.-")[:MAX_ROBOT_NAME] or "robot"


def safe_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return a safe, unique new name for every name; safe names that are not reserved stay."""
    names, reserved = tuple(names), tuple(reserved)
    kept = {name for name in names if is_name_safe(name) and name not in reserved}
    taken = {*kept, *reserved}
    new_names: dict[str, str] = {}
    for name in names:
        new_names[name] = name if name in kept else take_name(_UNSAFE.sub("_", name) or "_", taken)
    return new_names


PYBULLET_LINKS = 127
"""Largest number of links below the root in PyBullet 3.2.7, which fails silently on more."""


def check_loaders(robot: Robot) -> Iterator[Finding]:
    """Report what some loaders do not have: mimic joints, many links, and bases without mass."""
    where = f"robot {robot.name}"
    movable = [robot.joints[k] for k in robot.movable_joints]
    followers = ", ".join(joint.name for joint in movable if joint.mimic is not None)
    if followers:
        why = f"PyBullet, older MuJoCo and (unless asked) Pinocchio ignore <mimic> of {followers}"
        fix = "load robot.xml, where it is an equality, or drive the followers yourself"
        yield Finding("mimic-ignored-by-loaders", "info", where, why, fix)
    links = len(robot.links) + len(robot.frames) - 1
    if links > PYBULLET_LINKS:
        why = f"{links} links below the root; PyBullet holds {PYBULLET_LINKS}"
        fix = "leave out bare frames, or import a part of it with --root-link"
        yield Finding("links-too-many", "error", where, why, fix)
    base = rigid_groups(robot)[0]
    if base.mass == 0 and any(not link.is_empty for link in base.links):
        why = "the base has geometry but no mass: PyBullet never lets a massless base move"
        fix = "give it a mass if the base should ever move freely"
        yield Finding("massless-root", "info", f"link {robot.root.name}", why, fix)


def check_bundled_shapes(robot: Robot) -> Iterator[Finding]:
    """Report shapes that a bundle rewrites: capsules, and meshes with a mirror or a stretch."""
    for link in robot.links:
        where = f"link {link.name}"
        geometries = {shape.geometry: None for shape in (*link.visuals, *link.collisions)}
        if any(isinstance(geometry, Capsule) for geometry in geometries):
            why = "URDF has no capsule: robot.urdf holds a cylinder and two spheres instead"
            fix = "load robot.xml, which has the capsule itself"
            yield Finding("capsule-in-urdf", "info", where, why, fix)
        for mesh in geometries:
            if not isinstance(mesh, Mesh) or not is_scale_valid(mesh):
                continue
            if math.prod(mesh.scale) < 0:
                code, effect = "mesh-mirrored", "mirrors it; some loaders turn it inside out"
            elif min(mesh.scale) < max(mesh.scale):
                code, effect = "mesh-stretched", "stretches it; some loaders use one factor only"
            else:
                continue
            why = f"{mesh.path.name}: scale {mesh.scale} {effect}"
            fix = "nothing to do in a bundle, whose meshes have the scale applied"
            yield Finding(code, "info", where, why, fix)


CHECKS = (check_shapes, check_units, check_names, check_loaders, check_bundled_shapes)
