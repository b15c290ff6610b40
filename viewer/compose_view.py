"""The robot that the compose page shows: it changes, and the robot before stays as a ghost."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from morphgen.formats.bundle import split_colours
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.population_pick import camera_view, project_points
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.scene_robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene_stage import CAMERA_DIRECTION, add_ground, look_at
from morphgen.viewer.session import Session

GHOST_OPACITY = 0.16
"""Opacity of the previous robot."""
GESTURE_TIME = 1.0
"""Changes that follow each other faster, as those of a moved slider, count as one [s]."""
_EDGE = 0.02
"""Share of the picture at its edges into which a robot may not reach."""


@dataclass(frozen=True)
class Facts:
    """Numbers of a robot that the page compares."""

    dof: int
    mass: float
    """Mass [kg]."""
    reach: float | None
    """Reach [m]; None for a robot without a tool or without joints."""


@dataclass(eq=False)
class ComposeView:
    """Robots in the scene of one browser."""

    session: Session
    shown: RobotView | None = None
    ghost: RobotView | None = None
    before: Facts | None = None
    """Facts of the ghost."""
    changed_at: float = -np.inf
    """Time of the last change by ``time.monotonic`` [s]."""
    count: int = 0
    """Number of robots shown so far; names the nodes of the scene."""


def robot_facts(robot: Robot) -> Facts:
    """Return the facts of a robot."""
    return Facts(robot.dof, robot.mass, arm_reach(robot) if has_tool(robot) and robot.dof else None)


def show(view: ComposeView, robot: Robot) -> str:
    """Show a robot; the one before it becomes the ghost, unless both belong to one gesture.

    The camera stays, unless the robot leaves the picture.

    Returns:
        What changed from the ghost to the robot; empty if there is no ghost.
    """
    client = view.session.client
    robot = split_colours(robot)
    is_gesture = time.monotonic() - view.changed_at < GESTURE_TIME
    previous = view.shown
    with client.atomic():
        view.count += 1
        view.shown = add_robot(client.scene, robot, f"/robot{view.count}")
        if previous is not None and (is_gesture and view.ghost is not None):
            previous.base.remove()
        elif previous is not None:
            if view.ghost is not None:
                view.ghost.base.remove()
            view.ghost, view.before = previous, robot_facts(previous.robot)
            _fade(previous)
    low, high = robot_bounds(robot)
    add_ground(client.scene, float(np.linalg.norm(high - low)))
    if previous is None:
        look_at(client, low, high)
    elif not _is_in_picture(view, low, high):
        look_at(client, low, high, _camera_direction(view))
    view.changed_at = time.monotonic()
    return change_text(view.before, robot_facts(robot)) if view.before else ""


def _fade(view: RobotView) -> None:
    """Make a robot the ghost."""
    view.set_opacity(GHOST_OPACITY)
    for shapes in view.layers["visual"]:
        for shape in shapes:
            shape.handle.cast_shadow = False


def change_text(before: Facts, after: Facts) -> str:
    """Return what differs between two robots, such as ``reach 1.08 to 1.68 m, mass +0.24 kg``."""
    parts = []
    if before.dof != after.dof:
        parts.append(f"{before.dof} to {after.dof} DoF")
    old, new = before.reach, after.reach
    if old is not None and new is not None and f"{old:.2f}" != f"{new:.2f}":
        parts.append(f"reach {old:.2f} to {new:.2f} m")
    if abs(difference := after.mass - before.mass) >= 0.005:
        parts.append(f"mass {difference:+.2f} kg")
    return ", ".join(parts)


def _is_in_picture(view: ComposeView, low: Array, high: Array) -> bool:
    """Return whether the camera sees all corners of a box."""
    picture = camera_view(view.session.client)
    points, depths = project_points(picture, box_corners(low, high))
    shares = points / (picture.aspect, 1.0)
    return bool((depths > 0).all() and (abs(shares - 0.5) <= 0.5 - _EDGE).all())


def _camera_direction(view: ComposeView) -> tuple[float, float, float]:
    camera = view.session.client.camera
    x, y, z = (float(value) for value in camera.position - camera.look_at)
    return (x, y, z) if np.linalg.norm((x, y)) > 1e-6 else CAMERA_DIRECTION
