"""Collision shapes of simulated robots: all of their primitives, or one for each link."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.errors import TaskError, nearest
from morphgen.fitting.replace_collision import with_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import COLLISION_GEOMETRIES, CollisionGeometry, Scene


def require_geometry(geometry: str) -> None:
    """Require the name of a collision geometry.

    Raises:
        TaskError: If it is unknown.
    """
    if geometry not in COLLISION_GEOMETRIES:
        raise TaskError(
            f"unknown collision geometry {geometry!r}{nearest(geometry, COLLISION_GEOMETRIES)}"
        )


def with_geometry(
    scenes: Sequence[Scene], geometry: CollisionGeometry, folders: Sequence[Path] = ()
) -> list[Scene]:
    """Return scenes whose robots have the collision shapes of a geometry.

    Masses, joints and visuals stay. Pairs of links that overlap with the new shapes wherever the
    joints are, or at the home pose, do not collide.

    Args:
        scenes: The scenes; a robot that several share is converted once.
        geometry: The geometry.
        folders: Folders of parts, for their stored fits.

    Raises:
        FormatError: If a stored fit is malformed.
        MeshError: If a mesh cannot be read.
    """
    if geometry == "primitive":
        return list(scenes)
    robots: dict[int, Robot] = {}
    for scene in scenes:
        if id(scene.robot) not in robots:
            shapes = token_shapes(scene.robot, folders)
            robots[id(scene.robot)] = with_primitives(
                scene.robot, {name: (shape,) for name, shape in shapes.items()}
            )
    return [replace(scene, robot=robots[id(scene.robot)]) for scene in scenes]
