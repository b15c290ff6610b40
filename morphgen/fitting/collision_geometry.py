"""The geometries that a robot's collision shapes can be replaced by, by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from morphgen.errors import FitError, nearest
from morphgen.fitting.replace_collision import as_primitives
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress

Geometry = Literal["mesh", "primitive", "convex", "sphere"]
"""Collision shapes of a robot. ``mesh``: those of its parts, with meshes whose hulls simulators
collide. In place of meshes, ``primitive``: fitted boxes, cylinders and spheres; ``convex``: convex
pieces. ``sphere``: spheres in place of all shapes."""
GEOMETRIES: tuple[Geometry, ...] = get_args(Geometry)


def with_geometry(
    robot: Robot, geometry: str, folders: Sequence[Path], *, progress: Progress = no_progress
) -> Robot:
    """Return the robot with the collision shapes of a geometry.

    Args:
        robot: The robot.
        geometry: One of ``GEOMETRIES``.
        folders: Folders of parts, for their stored fits.
        progress: Receives the number of links or meshes that are done, and of all.

    Raises:
        FitError: If the geometry is unknown, or does not suit a mesh.
        FormatError: If a stored fit is malformed, or the cache cannot be written.
        MeshError: If a mesh cannot be read.
        ModuleNotFoundError: If the package that makes the shapes is not installed.
        RobotError: If a joint axis is zero.
    """
    if geometry not in GEOMETRIES:
        raise FitError(f"unknown geometry {geometry!r}{nearest(geometry, GEOMETRIES)}")
    if geometry == "primitive":
        return as_primitives(robot, folders, progress=progress)
    if geometry == "convex":
        from morphgen.fitting.convex_pieces import as_convex  # imports trimesh

        return as_convex(robot, folders, progress=progress)
    if geometry == "sphere":
        from morphgen.fitting.sphere_robot import as_spheres  # reads SRDF

        return as_spheres(robot, folders, progress=progress)
    return robot
