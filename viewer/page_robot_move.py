"""The Move tab of the robot page: a slider for every joint, and special configurations."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.model.kinematics import joint_limits, random_configurations
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import robot_tables
from morphgen.viewer.page_robot_select import mark_slider, watch_sliders
from morphgen.viewer.page_robot_show import (
    RobotPage,
    read_sliders,
    set_configuration,
    show_in_address,
)
from morphgen.viewer.session import set_value

ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": 180 / math.pi}
"""Units of angles and their number per radian."""
MAX_TRIES = 500
"""Random configurations that are tested to find one without collision."""


def add_move_tab(page: RobotPage) -> None:
    """Add buttons for special configurations and for the unit, and a slider for each joint."""
    gui, session = page.session.client.gui, page.session
    buttons = gui.add_button_group("Go to", ("home", "zero", "random free"))
    session.on_change(buttons, lambda: _go_to(page, buttons.value))
    if any(page.robot.joints[k].kind != "prismatic" for k in page.robot.independent_joints):
        unit = page.angle_choice = gui.add_dropdown("Angles in", tuple(ANGLES))
        session.on_change(unit, lambda: set_angles(page, unit.value))
    page.texts["collisions"] = gui.add_html("")
    page.slider_box = gui.add_folder(None)
    _add_sliders(page)


def free_configuration(
    checker: SelfCollisionChecker, robot: Robot, rng: np.random.Generator
) -> Array | None:
    """Return a random configuration without self-collision; None if all tries collide."""
    for _ in range(MAX_TRIES):
        q = random_configurations(robot, 1, rng)
        if list(checker.penetrations(q)) == [{}]:
            return np.asarray(q[0])
    return None


def set_angles(page: RobotPage, unit: str) -> None:
    """Show the angles of the sliders in another unit, ``rad`` or ``deg``."""
    if page.angle_choice is None or unit == page.angles:
        return
    page.angles = unit
    set_value(page.angle_choice, unit)
    _add_sliders(page)
    show_in_address(page)


def _add_sliders(page: RobotPage) -> None:
    """Add a slider for each joint by part, in the unit of the page; they replace earlier ones."""
    gui, session, robot = page.session.client.gui, page.session, page.robot
    for folder in page.slider_folders:
        folder.remove()
    page.slider_folders = []
    sliders, limits = {}, joint_limits(robot)
    page.slider_scales = [
        1.0 if robot.joints[k].kind == "prismatic" else ANGLES[page.angles]
        for k in robot.independent_joints
    ]
    assert page.slider_box is not None
    for group in robot_tables.joint_groups(robot):
        with page.slider_box:
            folder = gui.add_folder(group.title)
        page.slider_folders.append(folder)
        for row in group.rows:
            joint, scale = robot.joints[robot.independent_joints[row]], page.slider_scales[row]
            low, high = (float(value) * scale for value in limits[row])
            step = robot_tables.slider_step(low, high)
            value = robot_tables.rounded(float(page.q[row]) * scale, step)
            with folder:
                sliders[row] = gui.add_slider(
                    robot_tables.short_name(joint, group),
                    low,
                    max(high, low + 1e-9),  # viser rejects an empty range
                    step,
                    float(np.clip(value, low, high)),
                    marks=tuple((value, f"{value:.3g}") for value in (low, high)),
                    hint=robot_tables.joint_hint(joint),
                )
    page.sliders = [sliders[row] for row in range(robot.dof)]
    page.slider_values = [slider.value for slider in page.sliders]
    for slider in page.sliders:
        session.on_change(slider, lambda: read_sliders(page), "move")
    mark_slider(page)
    watch_sliders(page)


def _go_to(page: RobotPage, target: str) -> None:
    """Move the robot to a configuration: ``home``, ``zero`` or ``random free``."""
    if target == "random free":
        if page.checker is None:
            page.checker = SelfCollisionChecker(page.robot)
        q = free_configuration(page.checker, page.robot, np.random.default_rng())
        if q is None:
            text = f"{MAX_TRIES} random ones collide"
            page.session.notify("No free configuration", text, error=True)
            return
    else:
        q = np.array(page.robot.home) if target == "home" else np.zeros(page.robot.dof)
        q = np.clip(q, *joint_limits(page.robot).T)
    set_configuration(page, q)
