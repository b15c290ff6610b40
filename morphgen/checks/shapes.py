"""Checks of shapes: unreadable meshes, invalid sizes and likely wrong units."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from morphgen.errors import MeshError
from morphgen.model.findings import Finding
from morphgen.model.geometry import Geometry, Mesh, Shape, dimensions
from morphgen.model.inertia import bounding_box, inertial_from_density
from morphgen.model.mesh import MAX_STL_FACES, convex_hull, left_out, load_mesh
from morphgen.model.robot import Inertial, Link, Robot

EXTENT_RANGE = (1e-3, 10.0)
"""Plausible range of a link's longest edge [m]."""
UNIT_RATIOS = {1000.0: "mm and m", 25.4: "inch and mm", 39.37: "inch and m"}
"""Ratios of lengths that indicate a mistaken unit."""
UNIT_TOLERANCE = 1.2
"""Factor within which a ratio counts as one of ``UNIT_RATIOS``."""
MIN_SOLIDITY = 1e-9
"""Volume over the cube of the longest edge below which shapes count as flat."""

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
                yield Finding(
                    "size-not-positive",
                    "error",
                    where,
                    f"a {kind} with dimensions {dimensions(geometry)} m",
                    "write lengths above 0",
                )


def check_units(robot: Robot) -> Iterator[Finding]:
    """Find links with an implausible size, or a visual-to-collision ratio that is one of units."""
    for link in robot.links:
        visual, collision = _extent(link.visuals), _extent(link.collisions)
        for kind, extent in (("visual", visual), ("collision", collision)):
            if extent is not None and not EXTENT_RANGE[0] <= extent <= EXTENT_RANGE[1]:
                yield Finding(
                    "extent-implausible",
                    "warning",
                    f"link {link.name}",
                    f"its {kind} geometry is {extent:.4g} m large",
                    "check the unit (m) and the mesh scale",
                )
        if not visual or not collision:
            continue
        ratio = max(visual, collision) / min(visual, collision)
        for unit, units in UNIT_RATIOS.items():
            if unit / UNIT_TOLERANCE <= ratio <= unit * UNIT_TOLERANCE:
                yield Finding(
                    "visual-collision-scale",
                    "warning",
                    f"link {link.name}",
                    f"visual {visual:.4g} m and collision {collision:.4g} m differ {ratio:.4g} "
                    f"times, about {units}",
                    "correct the mesh scale of one of them",
                )
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
        yield Finding(
            "mesh-unresolved", "error", where, f"{mesh.path}: no such file", "correct the mesh path"
        )
        return
    if not is_scale_valid(mesh):
        yield Finding(
            "mesh-scale-invalid",
            "error",
            where,
            f"{mesh.path.name}: scale {mesh.scale}",
            "write finite factors other than 0",
        )
        return
    fault = mesh_fault(mesh)
    if fault is not None:
        yield Finding("mesh-unreadable", "error", where, fault, "export the mesh again")
        return
    if parts := left_out(mesh.path):
        yield Finding(
            "mesh-left-out",
            "info" if all(map(_ONLY_DRAWN.match, parts)) else "warning",
            where,
            f"{mesh.path.name}: left out: {'; '.join(parts)}",
            "export the mesh as triangles with its materials beside it",
        )
    flat = mesh_fault(mesh, reader=convex_hull) if collides else None
    if flat is not None:
        yield Finding("mesh-flat", "error", where, flat, "collide with a thin box instead")
    faces = len(load_mesh(mesh).faces)
    if faces > MAX_STL_FACES:
        yield Finding(
            "mesh-huge",
            "warning",
            where,
            f"{mesh.path.name} has {faces} triangles; MuJoCo reads no STL of more than "
            f"{MAX_STL_FACES} (the bundle writes OBJ then)",
            "decimate the mesh",
        )


def _extent(shapes: Sequence[Shape]) -> float | None:
    """Return the longest edge of the valid shapes' bounding box [m]; None without any."""
    valid = [shape for shape in shapes if has_hull(shape.geometry)]
    return float(np.ptp(bounding_box(valid), axis=0).max()) if valid else None
