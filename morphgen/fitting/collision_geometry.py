"""The geometries that a robot's collision shapes can be replaced by, by name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from morphgen.errors import FitError, nearest
from morphgen.fitting.replace_collision import as_primitives, as_spheres
from morphgen.model.robot import Robot

Geometry = Literal["mesh", "primitive", "convex", "sphere"]
"""Collision shapes of a robot. ``mesh``: those of its parts, with meshes whose hulls simulators
collide. In place of meshes, ``primitive``: fitted boxes, cylinders and spheres; ``convex``: convex
pieces. ``sphere``: spheres in place of all shapes."""
GEOMETRIES: tuple[Geometry, ...] = get_args(Geometry)


def with_geometry(robot: Robot, geometry: str, folders: Sequence[Path]) -> Robot:
    """Return the robot with the collision shapes of a geometry."""
    if geometry not in GEOMETRIES:
        raise FitError(f"unknown geometry {geometry!r}{nearest(geometry, GEOMETRIES)}")
    if geometry == "primitive":
        return as_primitives(robot, folders)
    if geometry == "convex":
        from morphgen.fitting.convex_pieces import as_convex  # imports trimesh

        return as_convex(robot, folders)
    if geometry == "sphere":
        return as_spheres(robot, folders)
    return robot
