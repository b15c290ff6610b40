"""Shapes: meshes that load, sizes that make sense."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from morphgen.checks.solids import is_scale_valid, is_sound, mesh_fault
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh, Shape, dimensions
from morphgen.model.inertia import bounding_box
from morphgen.model.mesh import MAX_STL_FACES, convex_hull, load_mesh
from morphgen.model.robot import Robot

EXTENT_RANGE = (1e-3, 10.0)
"""Plausible largest extent of a link, metres."""
UNIT_RATIOS = {1000.0: "mm and m", 25.4: "inch and mm", 39.37: "inch and m"}
"""Ratios between lengths that a mistaken unit causes."""
UNIT_TOLERANCE = 1.2
"""Factor within which a ratio counts as one of ``UNIT_RATIOS``."""


def check_shapes(robot: Robot) -> Iterator[Finding]:
    """Find shapes that cannot be read or have no size; each mesh is reported once per link."""
    for link in robot.links:
        where = f"link {link.name}"
        touched = {shape.geometry for shape in link.collisions}
        for geometry in dict.fromkeys(
            shape.geometry for shape in (*link.visuals, *link.collisions)
        ):
            if isinstance(geometry, Mesh):
                yield from _mesh_findings(geometry, where, collides=geometry in touched)
            elif not is_sound(geometry):
                kind = type(geometry).__name__.lower()
                yield Finding(
                    "size-not-positive",
                    "error",
                    where,
                    f"a {kind} with dimensions {dimensions(geometry)} m",
                    "write lengths above 0",
                )


def check_units(robot: Robot) -> Iterator[Finding]:
    """Find links whose size, or the ratio of its visual to its collision size, hints at a unit."""
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
    """Longest edge of the bounding box of the sound shapes, metres; None without any."""
    sound = [shape for shape in shapes if is_sound(shape.geometry)]
    return float(np.ptp(bounding_box(sound), axis=0).max()) if sound else None
