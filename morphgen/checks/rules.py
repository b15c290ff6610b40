"""The rules that robots and parts are checked against, and the repairs that need no decision.

A check yields findings by the names of their rows in ``findings.yaml``, which has all texts; a
repair belongs to a row and changes what the finding is about.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.errors import MeshError
from morphgen.model.findings import Finding, texts_of
from morphgen.model.geometry import Capsule, Geometry, Mesh, Shape, dimensions
from morphgen.model.inertia import (
    bounding_box,
    inertial_from_density,
    solid_triangles,
    with_inertia,
)
from morphgen.model.kinematics import forward_kinematics, movable_positions
from morphgen.model.mesh import MAX_STL_FACES, hull_triangles, left_out, mesh_triangles
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    TOOL,
    Inertial,
    Joint,
    Link,
    Pair,
    Robot,
)
from morphgen.model.tree import rename, rigid_groups, take_name
from morphgen.typing import Array

if TYPE_CHECKING:
    import fcl

DEFAULT_DENSITY = 1000.0  # density of a link whose source gives no mass [kg/m^3]; that of water


found = texts_of(Path(__file__).with_name("findings.yaml"), density=DEFAULT_DENSITY)
"""Return the finding of a row of ``findings.yaml``."""

GYRATION_FACTOR = 5.0
"""Largest plausible ratio between radii of gyration and those of the solid geometry."""
COM_MARGIN = 0.5
"""Distance of the centre of mass from the bounding box that is still plausible, as a fraction of
half the size of the box."""
DENSITY_RANGE = (20.0, 25_000.0)
"""Plausible mean densities, from foam to more than tungsten [kg/m^3]."""
TRIANGLE_MARGIN = 1e-12
"""Relative margin of the triangle inequality, because MuJoCo refuses values at the limit after
rounding."""
MIN_SOLIDITY = 1e-9  # volume over the cube of the longest edge below which shapes count as flat


def check_masses(robot: Robot) -> Iterator[Finding]:
    """Find moving links without mass, and links whose mass is invalid."""
    for group in rigid_groups(robot):
        if group.is_root:
            continue
        row = "inertia-missing/carried" if group.mass > 0 else "inertia-missing"
        for link in group.links:
            if not link.is_empty and (link.inertial is None or link.inertial.mass == 0):
                repairable = _unit_density_inertial(link) is not None
                yield found(row, f"link {link.name}", repairable=repairable)
        if group.mass == 0 and all(link.is_empty for link in group.links):
            row = "massless-between" if group.mass_beyond > 0 else "massless-body"
            yield found(row, f"link {group.links[0].name}")
    for link in robot.links:
        where, inertial = f"link {link.name}", link.inertial
        if inertial is not None and not _is_mass_valid(inertial):
            values = {"mass": inertial.mass, "com": inertial.com}
            repairable = _unit_density_inertial(link) is not None
            yield found("mass-invalid", where, repairable=repairable, **values)
        if inertial is not None and link.is_empty and any(inertial.inertia):
            yield found("inertia-without-mass", where)


def check_inertia(robot: Robot) -> Iterator[Finding]:
    """Compare the mass properties of every link with physics and with its geometry."""
    for link in robot.links:
        where, inertial = f"link {link.name}", link.inertial
        if inertial is None or not _is_mass_valid(inertial) or inertial.mass == 0:
            continue
        solid, fault = _unit_density_inertial(link), _inertia_fault(inertial)
        if fault is not None:
            body = "a ball" if solid is None else "its solid geometry"
            values = {"fault": fault, "body": body, "mass": inertial.mass}
            yield found("inertia-not-physical", where, **values)
        if solid is None:
            continue
        if fault is None:
            radii, expected = _gyration_radii(inertial), _gyration_radii(solid)
            ratio = radii / expected
            if ratio.max() > GYRATION_FACTOR or ratio.min() < 1 / GYRATION_FACTOR:
                texts = (", ".join(f"{1000 * r:.3g}" for r in each) for each in (radii, expected))
                values = dict(zip(("radii", "expected"), texts, strict=True))
                yield found("inertia-implausible", where, **values)
        low, high = bounding_box(link.solid_shapes)
        margin = COM_MARGIN * (high - low) / 2
        if np.any(inertial.com < low - margin) or np.any(inertial.com > high + margin):
            ends = " to ".join(f"({', '.join(f'{v:.3g}' for v in each)})" for each in (low, high))
            yield found("com-outside", where, com=inertial.com, corners=ends)
        density, (lowest, highest) = inertial.mass / solid.mass, DENSITY_RANGE
        if not lowest <= density <= highest:
            values = {"mass": inertial.mass, "volume": solid.mass * 1e6, "value": density}
            yield found("density-implausible", where, lowest=lowest, highest=highest, **values)


def _is_mass_valid(inertial: Inertial) -> bool:
    """Return whether mass and centre of mass are finite, and the mass is not negative."""
    return inertial.mass >= 0 and all(map(math.isfinite, (inertial.mass, *inertial.com)))


def _inertia_fault(inertial: Inertial) -> str | None:
    """Return why no rigid body with positive mass can have this inertia; None if one can."""
    if not np.isfinite(inertial.matrix).all():
        return f"inertia {inertial.inertia} is not finite"
    low, middle, high = np.linalg.eigvalsh(inertial.matrix).tolist()
    moments = f"principal moments {low:.4g}, {middle:.4g}, {high:.4g} kg m^2"
    if low <= 0:
        return f"{moments} are not all positive"
    if low + middle <= high * (1 + TRIANGLE_MARGIN):
        return f"{moments}: the largest is no less than the sum of the others"
    return None


def _gyration_radii(inertial: Inertial) -> Array:
    """Return the principal radii of gyration about the centre of mass, ascending, (3,) [m]."""
    return np.asarray(np.sqrt(np.linalg.eigvalsh(inertial.matrix) / inertial.mass))


def _unit_density_inertial(link: Link) -> Inertial | None:
    """Return the mass properties of a link's shapes at 1 kg/m^3; None if none has a volume."""
    shapes = link.solid_shapes
    if not shapes or not all(has_hull(shape.geometry) for shape in shapes):
        return None
    solid = inertial_from_density(shapes, density=1.0)
    extent = float(np.ptp(bounding_box(shapes), axis=0).max())
    return solid if solid.mass > MIN_SOLIDITY * extent**3 else None


def _with_possible_inertia(link: Link) -> Link:
    """Return a link with the inertia of its solid shapes, or of a ball, at its own mass."""
    assert link.inertial is not None
    solid, mass = _unit_density_inertial(link), link.inertial.mass
    if solid is None:
        radius = (3 * mass / (4 * math.pi * DEFAULT_DENSITY)) ** (1 / 3)
        inertia = 0.4 * mass * radius**2 * np.eye(3)
    else:
        inertia = mass / solid.mass * solid.matrix
    return replace(link, inertial=Inertial.from_matrix(mass, link.inertial.com, inertia))


AXIS_TOLERANCE = 1e-3  # deviation of an axis from unit length that counts as rounding in a file
WIDEST = {"revolute": 4 * 2 * math.pi, "prismatic": 10.0}
"""Widest plausible range of a joint [rad or m]; wider limits are likely degrees or millimetres."""
MIMIC_RANGE_TOLERANCE = 0.01
"""Overshoot of a mimic joint's limits that is not reported, as a fraction of their span."""


def check_joints(robot: Robot) -> Iterator[Finding]:
    """Find faults of single joints: of axis, limits, effort, velocity, home and ``<mimic>``."""
    home = dict(zip(robot.independent_joints, robot.home, strict=True))
    for k, joint in enumerate(robot.joints):
        where = f"joint {joint.name}"
        yield from _mimic_findings(robot, joint, where)
        if joint.is_movable:
            yield from _axis_findings(joint, where)
            yield from _limit_findings(robot, joint, where)
            yield from _drive_findings(robot, joint, where)
        lower, upper = _position_range(joint)
        if k in home and not (math.isfinite(home[k]) and lower <= home[k] <= upper):
            values = {"position": home[k], "lower": lower, "upper": upper}
            yield found("home-outside-limits", where, **values)


def _axis_findings(joint: Joint, where: str) -> Iterator[Finding]:
    length = math.hypot(*joint.axis)
    if not is_axis_valid(joint):
        yield found("axis-invalid", where, axis=joint.axis)
    elif abs(length - 1) > AXIS_TOLERANCE:
        row = "axis-not-unit/prismatic" if joint.kind == "prismatic" else "axis-not-unit"
        yield found(row, where, axis=joint.axis, length=length)


def _limit_findings(robot: Robot, joint: Joint, where: str) -> Iterator[Finding]:
    limits, kind = joint.limits, joint.kind
    if kind == "continuous":
        if limits is not None:
            yield found("limits-on-continuous", where, limits=limits)
        return
    if limits is None or not all(map(math.isfinite, limits)):
        given = "without limits" if limits is None else f"with limits {limits}"
        alternative = ", or make it continuous" if kind == "revolute" else ""
        yield found("limits-missing", where, kind=kind, given=given, alternative=alternative)
        return
    lower, upper = sorted(limits)
    if limits[0] > limits[1]:
        yield found("limits-inverted", where, limits=limits, lower=lower, upper=upper)
    if lower == upper:
        yield found("limits-empty", where, repairable=_is_locked(robot, joint), lower=lower)
    if upper - lower > WIDEST[kind]:
        unit = "m" if kind == "prismatic" else "rad"
        yield found("limits-wide", where, span=upper - lower, unit=unit, widest=WIDEST[kind])


def _drive_findings(robot: Robot, joint: Joint, where: str) -> Iterator[Finding]:
    """Find effort or velocity that is missing, and negative damping or friction."""
    units = ("N", "m/s") if joint.kind == "prismatic" else ("N m", "rad/s")
    if joint.is_independent and not _is_locked(robot, joint):
        for name, value, default, unit in (
            ("effort", joint.effort, DEFAULT_EFFORT, units[0]),
            ("velocity", joint.velocity, DEFAULT_VELOCITY, units[1]),
        ):
            if value is None or not (math.isfinite(value) and value > 0):
                state = f"it has no {name}" if value is None else f"its {name} is {value:g}"
                yield found(f"{name}-missing", where, state=state, default=default, unit=unit)
    for name, loss in (("damping", joint.damping), ("friction", joint.friction)):
        if not loss >= 0 or math.isinf(loss):
            yield found(f"{name}-invalid", where, value=loss)


def _mimic_findings(robot: Robot, joint: Joint, where: str) -> Iterator[Finding]:
    mimic = joint.mimic
    if mimic is None:
        return
    if not joint.is_movable:
        yield found("mimic-on-fixed", where, mimic=mimic)
        return
    if not robot.joints[robot.joint_index[mimic.joint]].is_movable:
        yield found("mimic-leader-fixed", where, mimic=mimic)
    if not (math.isfinite(mimic.multiplier) and math.isfinite(mimic.offset)):
        yield found("mimic-invalid", where, mimic=mimic)
    elif mimic.multiplier == 0:
        yield found("mimic-still", where, mimic=mimic)


def check_mimic_range(robot: Robot) -> Iterator[Finding]:
    """Find mimic joints that their leaders drive beyond their own limits."""
    matrix, offset = robot.mimic_map
    for row, k in enumerate(robot.movable_joints):
        follower = robot.joints[k]
        lower, upper = _position_range(follower)
        leaders = np.flatnonzero(matrix[row]).tolist()
        if follower.mimic is None or not leaders or not math.isfinite(upper - lower):
            continue
        leader = robot.joints[robot.independent_joints[leaders[0]]]
        gain = float(matrix[row, leaders[0]])
        low, high = sorted(gain * q + float(offset[row]) for q in _position_range(leader))
        slack = MIMIC_RANGE_TOLERANCE * (upper - lower)
        if low < lower - slack or high > upper + slack:
            values = {"low": low, "high": high, "lower": lower, "upper": upper}
            yield found("mimic-range", f"joint {follower.name}", leader=leader.name, **values)


def is_axis_valid(joint: Joint) -> bool:
    """Return whether the axis is finite and not zero."""
    length = math.hypot(*joint.axis)
    return math.isfinite(length) and length >= 1e-9


def _is_locked(robot: Robot, joint: Joint) -> bool:
    """Return whether limits of zero make the joint equivalent to a fixed one."""
    return (
        joint.kind in ("revolute", "prismatic")
        and joint.limits == (0.0, 0.0)
        and joint.mimic is None
        and all(each.mimic is None or each.mimic.joint != joint.name for each in robot.joints)
    )


def _position_range(joint: Joint) -> tuple[float, float]:
    """Return the lowest and highest position within the limits, even if these are inverted."""
    if joint.limits is None or joint.kind == "continuous" or any(map(math.isnan, joint.limits)):
        return (-math.inf, math.inf)
    return (min(joint.limits), max(joint.limits))


EXTENT_RANGE = (1e-3, 10.0)  # plausible range of a link's longest edge [m]
UNIT_RATIOS = {1000.0: "mm and m", 25.4: "inch and mm", 39.37: "inch and m"}
"""Ratios of lengths that indicate a mistaken unit."""
UNIT_TOLERANCE = 1.2  # factor within which a ratio counts as one of UNIT_RATIOS
_ONLY_DRAWN = re.compile(r"materials? |texture|\d+ (lines?|points?|spline)")
"""Notes of a mesh file about what has no triangles: they change a picture, and no contact."""


def check_shapes(robot: Robot) -> Iterator[Finding]:
    """Find unreadable shapes and shapes without a size; each mesh is reported once per link."""
    for link in robot.links:
        where = f"link {link.name}"
        collisions = {shape.geometry for shape in link.collisions}
        for geometry in _geometries(link):
            if isinstance(geometry, Mesh):
                yield from _mesh_findings(geometry, where, collides=geometry in collisions)
            elif not is_readable(geometry):
                kind = type(geometry).__name__.lower()
                yield found("size-not-positive", where, kind=kind, dimensions=dimensions(geometry))


def check_units(robot: Robot) -> Iterator[Finding]:
    """Find links with an implausible size, or a visual-to-collision ratio that is one of units."""
    for link in robot.links:
        where = f"link {link.name}"
        visual, collision = _extent(link.visuals), _extent(link.collisions)
        for kind, extent in (("visual", visual), ("collision", collision)):
            if extent is not None and not EXTENT_RANGE[0] <= extent <= EXTENT_RANGE[1]:
                yield found("extent-implausible", where, kind=kind, extent=extent)
        if not visual or not collision:
            continue
        ratio = max(visual, collision) / min(visual, collision)
        for unit, units in UNIT_RATIOS.items():
            if unit / UNIT_TOLERANCE <= ratio <= unit * UNIT_TOLERANCE:
                values = {"visual": visual, "collision": collision, "ratio": ratio}
                yield found("visual-collision-scale", where, units=units, **values)
                break


def check_bundled_shapes(robot: Robot) -> Iterator[Finding]:
    """Report shapes that a bundle rewrites: capsules, and meshes with a mirror or a stretch."""
    for link in robot.links:
        where, geometries = f"link {link.name}", _geometries(link)
        if any(isinstance(geometry, Capsule) for geometry in geometries):
            yield found("capsule-in-urdf", where)
        for mesh in geometries:
            if not isinstance(mesh, Mesh) or not _is_scale_valid(mesh):
                continue
            if math.prod(mesh.scale) < 0:
                yield found("mesh-mirrored", where, mesh=mesh)
            elif min(mesh.scale) < max(mesh.scale):
                yield found("mesh-stretched", where, mesh=mesh)


def _mesh_findings(mesh: Mesh, where: str, *, collides: bool) -> Iterator[Finding]:
    if not mesh.path.is_file():
        yield found("mesh-unresolved", where, mesh=mesh)
    elif not _is_scale_valid(mesh):
        yield found("mesh-scale-invalid", where, mesh=mesh)
    elif fault := _mesh_fault(mesh_triangles, mesh):
        yield found("mesh-unreadable", where, fault=fault)
    else:
        if parts := left_out(mesh.path):
            only_drawn = all(map(_ONLY_DRAWN.match, parts))
            row = "mesh-left-out/drawn" if only_drawn else "mesh-left-out"
            yield found(row, where, mesh=mesh, parts="; ".join(parts))
        if collides and (fault := _mesh_fault(hull_triangles, mesh)):
            yield found("mesh-flat", where, fault=fault)
        faces = len(mesh_triangles(mesh).faces)
        if faces > MAX_STL_FACES:
            yield found("mesh-huge", where, mesh=mesh, faces=faces, most=MAX_STL_FACES)


def _geometries(link: Link) -> dict[Geometry, None]:
    """Return the different geometries of a link, visual ones first."""
    return dict.fromkeys(shape.geometry for shape in (*link.visuals, *link.collisions))


def is_readable(geometry: Geometry, read: Callable[[Mesh], object] = mesh_triangles) -> bool:
    """Return whether a primitive has positive dimensions, or a mesh can be read by a function."""
    if isinstance(geometry, Mesh):
        return _is_scale_valid(geometry) and _mesh_fault(read, geometry) is None
    return all(math.isfinite(size) and size > 0 for size in dimensions(geometry))


def has_hull(geometry: Geometry) -> bool:
    """Return whether a primitive has positive dimensions, or a mesh has a convex hull."""
    return is_readable(geometry, hull_triangles)


def _is_scale_valid(mesh: Mesh) -> bool:
    return all(math.isfinite(factor) and factor != 0 for factor in mesh.scale)


def _mesh_fault(reader: Callable[[Mesh], object], mesh: Mesh) -> str | None:
    """Return why ``mesh_triangles`` or ``hull_triangles`` fails on a mesh; None if it succeeds."""
    try:
        reader(mesh)
    except MeshError as error:
        return str(error)
    return None


def _extent(shapes: Sequence[Shape]) -> float | None:
    """Return the longest edge of the valid shapes' bounding box [m]; None without any."""
    valid = [shape for shape in shapes if has_hull(shape.geometry)]
    return float(np.ptp(bounding_box(valid), axis=0).max()) if valid else None


_Triangles: TypeAlias = Array  # corners of triangles, shape (n, 3, 3) [m]

MAX_GAP = 5e-3
"""Largest distance between the visual shapes of a link and its parent [m].

Correct models of real arms and grippers have slits of up to 3.6 mm at their joints (SAKE EZ 3.6,
Fetch 3, UR5 3).
"""
_COARSE_TRIANGLES = 500  # number of triangles per shape in the first, coarse distance test
_ROUNDING = 1e-9  # upper bound of the rounding error of a distance [m]


def check_links_apart(robot: Robot) -> Iterator[Finding]:
    """Find links that no visible shape connects to their parent at home.

    Children of a link without visual shapes are compared with the nearest ancestor that has some.
    Where one solid is inside the other, there is no gap.
    """
    if not _has_home_pose(robot):
        return
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    visuals = [
        tuple(shape for shape in link.visuals if is_readable(shape.geometry))
        for link in robot.links
    ]
    for i, link in enumerate(robot.links):
        ancestor = robot.parents[i]
        while ancestor >= 0 and not visuals[ancestor]:
            ancestor = robot.parents[ancestor]
        if ancestor < 0 or not visuals[i]:
            continue
        T_ancestor_link = np.linalg.inv(T_root_link[ancestor]) @ T_root_link[i]
        gap = _gap(visuals[ancestor], visuals[i], T_ancestor_link)
        millimetres = f"{1000 * gap:.3g}"
        if float(millimetres) > 1000 * MAX_GAP:  # as it is printed: 5 mm are not more than 5 mm
            where = f"links {robot.links[ancestor].name}, {link.name}"
            yield found("links-apart", where, millimetres=millimetres)


def check_self_collision(robot: Robot) -> Iterator[Finding]:
    """Find pairs of links that penetrate each other at home."""
    for (a, b), depth in sorted(home_penetrations(robot).items()):
        yield found("self-collision", f"links {a}, {b}", millimetres=1000 * depth)


def home_penetrations(robot: Robot) -> dict[Pair, float]:
    """Return the pairs of links that penetrate each other at home, with their depth [m].

    Unreadable shapes are left out. A robot without valid joint axes and positions is not tested.
    """
    if not _has_home_pose(robot):
        return {}

    def with_valid_collisions(link: Link) -> Link:
        valid = tuple(shape for shape in link.collisions if has_hull(shape.geometry))
        return replace(link, collisions=valid)

    testable = robot.with_links(map(with_valid_collisions, robot.links))
    checker = SelfCollisionChecker(testable, untested_pairs(testable))
    return next(checker.penetrations([robot.home]))


def _has_home_pose(robot: Robot) -> bool:
    """Return whether all joint axes are valid and all home positions finite."""
    axes_valid = all(is_axis_valid(robot.joints[k]) for k in robot.movable_joints)
    return axes_valid and bool(np.isfinite(movable_positions(robot, robot.home)).all())


def _gap(a: Sequence[Shape], b: Sequence[Shape], T_a_b: Array) -> float:
    """Return the distance between two solids [m]; below ``MAX_GAP``, perhaps an upper bound."""
    # Some of the triangles give an upper bound of the distance, which usually suffices. If not,
    # only triangles within this bound of the other solid can be nearer, so test those.
    coarse_b = _transform(_triangles(b, _COARSE_TRIANGLES), T_a_b)
    bound = _distance(_triangles(a, _COARSE_TRIANGLES), coarse_b)
    if bound <= MAX_GAP:
        return bound
    all_a, all_b = _triangles(a), _transform(_triangles(b), T_a_b)
    gap = _distance(all_a[_is_near(all_a, all_b, bound)], all_b[_is_near(all_b, all_a, bound)])
    enclosed = gap > MAX_GAP and (_encloses(all_a, all_b) or _encloses(all_b, all_a))
    return 0.0 if enclosed else gap


def _triangles(shapes: Sequence[Shape], max_per_shape: int | None = None) -> _Triangles:
    """Return triangles of shapes in their link's frame, at most about ``max_per_shape`` of each."""
    pieces = []
    for shape in shapes:
        vertices, faces = solid_triangles(shape.geometry)
        stride = 1 if max_per_shape is None else -(-len(faces) // max_per_shape)
        corners = vertices[faces[::stride]]
        pieces.append(_transform(corners, shape.T_link_shape.matrix))
    return np.concatenate(pieces)


def _transform(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _is_near(triangles: _Triangles, others: _Triangles, distance: float) -> NDArray[np.bool_]:
    """Return which triangles' bounding boxes are within a distance of the others' box, (n,)."""
    margin = distance + _ROUNDING
    low, high = others.min(axis=(0, 1)) - margin, others.max(axis=(0, 1)) + margin
    above, below = triangles.max(axis=1) >= low, triangles.min(axis=1) <= high
    return np.asarray((above & below).all(axis=1))


def _distance(a: _Triangles, b: _Triangles) -> float:
    """Return the exact distance between two sets of triangles [m]; 0 if they intersect."""
    import fcl

    objects = (
        triangle_collider(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
        for triangles in (a, b)
    )
    return max(0.0, float(fcl.distance(*objects, fcl.DistanceRequest(), fcl.DistanceResult())))


def triangle_collider(vertices: Array, faces: NDArray[np.int64]) -> fcl.CollisionObject:
    """Return the collision object of triangles: vertices (n, 3) [m] and faces (m, 3)."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return fcl.CollisionObject(model)


def _encloses(solid: _Triangles, others: _Triangles) -> bool:
    """Return whether a corner of other triangles is inside a solid, by its winding number.

    Barill et al., Fast winding numbers for soups and clouds, 2018.
    """
    import igl

    corners = np.unique(others[_is_near(others, solid, 0.0)].reshape(-1, 3), axis=0)
    if not len(corners):
        return False
    faces = np.arange(3 * len(solid)).reshape(-1, 3)
    winding = igl.fast_winding_number(solid.reshape(-1, 3), faces, corners)
    # 1 inside a closed solid and 0 outside; meshes may be inside out.
    return bool((np.abs(winding) > 0.5).any())


_UNSAFE = re.compile(r"[^A-Za-z0-9_.\-]")
_WORLD = "world"
MAX_ROBOT_NAME = 200  # longest name of a robot [characters]
PYBULLET_LINKS = 127
"""Largest number of links below the root in PyBullet 3.2.7, which fails silently on more."""


def check_names(robot: Robot) -> Iterator[Finding]:
    """Find names that loaders misinterpret, reserve, or have twice when frames are links."""
    for element, names in _all_names(robot).items():
        for name in names:
            safe = _safe_robot_name(name) if element == "robot" else _UNSAFE.sub("_", name) or "_"
            if name == safe:
                continue
            characters = " ".join(repr(c) for c in dict.fromkeys(_UNSAFE.findall(name)))
            contents = characters or ("" if name else "nothing")
            row = "name-characters" if contents else "name-characters/folder"
            values = {"contents": contents, "longest": MAX_ROBOT_NAME}
            yield found(row, f"{element} {name}", **values)
    if robot.link_index.get(_WORLD, 0) > 0:
        yield found("name-reserved", f"link {_WORLD}")
    for frame in robot.frames:
        for element, name, taken in (
            ("link", frame.name, robot.link_index),
            ("joint", f"{frame.name}_joint", robot.joint_index),
        ):
            if name in taken:
                yield found("frame-name-taken", f"frame {frame.name}", element=element, name=name)


def check_tool(robot: Robot) -> Iterator[Finding]:
    """Find a robot without a tool frame, or with one that no joint moves."""
    if robot.tool is None:
        yield found("tool-missing", f"robot {robot.name}")
        return
    chain = robot.joint_chain(robot.tool.link)
    if robot.dof > 0 and not any(robot.joints[k].is_movable for k in chain):
        yield found("tool-still", f"frame {TOOL}", link=robot.tool.link)


def check_loaders(robot: Robot) -> Iterator[Finding]:
    """Report what some loaders do not have: mimic joints, many links, and bases without mass."""
    where, movable = f"robot {robot.name}", [robot.joints[k] for k in robot.movable_joints]
    if followers := ", ".join(joint.name for joint in movable if joint.mimic is not None):
        yield found("mimic-ignored-by-loaders", where, followers=followers)
    links = len(robot.links) + len(robot.frames) - 1
    if links > PYBULLET_LINKS:
        yield found("links-too-many", where, links=links, most=PYBULLET_LINKS)
    base = rigid_groups(robot)[0]
    if base.mass == 0 and any(not link.is_empty for link in base.links):
        yield found("massless-root", f"link {robot.root.name}")


def _all_names(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return all names of a robot by kind of element; they are unique within each kind."""
    return {
        "robot": (robot.name,),
        "link": tuple(link.name for link in robot.links),
        "joint": tuple(joint.name for joint in robot.joints),
        "frame": tuple(frame.name for frame in robot.frames),
    }


def _safe_robot_name(name: str) -> str:
    """Return a safe name that a bundle can have: a letter or digit is first."""
    return _UNSAFE.sub("_", name).lstrip("_.-")[:MAX_ROBOT_NAME] or "robot"


def safe_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return a safe, unique name for every name; it stays if it is both and not reserved."""
    names, reserved = tuple(names), tuple(reserved)
    kept = {name for name in names if name and not _UNSAFE.search(name) and name not in reserved}
    taken = {*kept, *reserved}
    new_names: dict[str, str] = {}
    for name in names:
        new_names[name] = name if name in kept else take_name(_UNSAFE.sub("_", name) or "_", taken)
    return new_names


CHECKS: tuple[Callable[[Robot], Iterator[Finding]], ...] = (
    *(check_masses, check_inertia, check_joints, check_mimic_range, check_shapes, check_units),
    *(check_names, check_loaders, check_bundled_shapes, check_links_apart, check_self_collision),
)
"""The checks that apply to robots and parts; ``check_tool`` applies to robots only."""
_LINK_REPAIRS: Mapping[str, Callable[[Link], Link]] = {
    "inertia-missing": partial(with_inertia, density=DEFAULT_DENSITY),
    "mass-invalid": partial(with_inertia, density=DEFAULT_DENSITY),
    "inertia-without-mass": lambda link: replace(link, inertial=Inertial(0.0)),
    "inertia-not-physical": _with_possible_inertia,
}
_JOINT_REPAIRS: Mapping[str, Callable[[Joint], Joint]] = {
    "axis-not-unit": lambda joint: replace(joint, axis=joint.unit_axis),
    "limits-on-continuous": lambda joint: replace(joint, limits=None),
    "limits-inverted": lambda joint: replace(joint, limits=_position_range(joint)),
    "effort-missing": lambda joint: replace(joint, effort=DEFAULT_EFFORT),
    "velocity-missing": lambda joint: replace(joint, velocity=DEFAULT_VELOCITY),
    "limits-empty": lambda joint: Joint(
        joint.name, "fixed", joint.parent, joint.child, joint.T_parent_joint
    ),
}
"""Repairs by the code of a finding, in the order in which they are applied."""


def repaired(robot: Robot, findings: Collection[Finding]) -> Robot:
    """Return a robot in which the fixable ones of its findings are repaired."""
    faults = {(finding.where, finding.code) for finding in findings if finding.fixable}

    def repair(element: Any, where: str, repairs: Mapping[str, Callable[[Any], Any]]) -> Any:  # noqa: ANN401
        for code, change in repairs.items():
            element = change(element) if (where, code) in faults else element
        return element

    links = tuple(repair(link, f"link {link.name}", _LINK_REPAIRS) for link in robot.links)
    joints = tuple(repair(joint, f"joint {joint.name}", _JOINT_REPAIRS) for joint in robot.joints)
    home = []
    for k, position in zip(robot.independent_joints, robot.home, strict=True):
        lower, upper = _position_range(joints[k])
        if joints[k].is_movable:
            home.append(min(max(position if math.isfinite(position) else 0.0, lower), upper))
    return _with_safe_names(replace(robot, links=links, joints=joints, home=tuple(home)))


def _with_safe_names(robot: Robot) -> Robot:
    names = _all_names(robot)
    reserved = {_WORLD} if robot.link_index.get(_WORLD, 0) > 0 else ()
    frame_names = safe_names(names["frame"])
    safe = rename(robot, safe_names(names["link"], reserved), safe_names(names["joint"]))
    return replace(
        safe,
        name=_safe_robot_name(robot.name),
        frames=tuple(replace(frame, name=frame_names[frame.name]) for frame in safe.frames),
    )
