"""Collision shapes of simulated robots: primitives, one for each link, or convex pieces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.errors import TaskError, nearest
from morphgen.extras import explain_missing_extras
from morphgen.fitting.convex_pieces import as_convex
from morphgen.fitting.replace_collision import with_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.rounding import as_written
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import COLLISION_GEOMETRIES, CollisionGeometry, Scene


def require_geometry(geometry: str) -> None:
    """Require the name of a collision geometry."""
    if geometry not in COLLISION_GEOMETRIES:
        raise TaskError(
            f"unknown collision geometry {geometry!r}{nearest(geometry, COLLISION_GEOMETRIES)}"
        )


@explain_missing_extras()
def with_geometry(
    scenes: Sequence[Scene], geometry: CollisionGeometry, folders: Sequence[Path] = ()
) -> list[Scene]:
    """Return scenes whose robots have the collision shapes of a geometry.

    Masses and joints stay. Pairs of links that overlap with the new shapes wherever the
    joints are, or at the home pose, do not collide.
    """
    if geometry == "primitive":
        return list(scenes)
    robots: dict[int, Robot] = {}
    for scene in scenes:
        if id(scene.robot) not in robots:
            change = _light if geometry == "light" else _convex
            robots[id(scene.robot)] = change(scene.robot, folders)
    return [replace(scene, robot=robots[id(scene.robot)]) for scene in scenes]


def _light(robot: Robot, folders: Sequence[Path]) -> Robot:
    """Return the robot with the primitive of each link's token."""
    shapes = token_shapes(robot, folders)
    return with_primitives(robot, {name: (shape,) for name, shape in shapes.items()})


def _convex(robot: Robot, folders: Sequence[Path]) -> Robot:
    """Return the robot with the convex pieces of the meshes that its primitives were fitted to."""
    if not robot.fits:  # it never had meshes
        return robot
    text = robot.provenance.get("derivation")
    composed = compose(parse_derivation(str(text)), Library(folders), robot.name) if text else None
    if composed is None or as_written(composed).joints != robot.joints:
        raise TaskError(
            f"robot {robot.name!r}: collision geometry 'convex' needs its meshes, which only a "
            "robot that morphgen composes finds again; expected 'primitive' or 'light'"
        )
    return as_written(as_convex(composed, folders))
