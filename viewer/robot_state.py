"""A robot's page in one browser: its configuration, and what goes with it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import viser

from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables, scene_overlays
from morphgen.viewer.scene_overlays import Overlays
from morphgen.viewer.scene_robot import (
    RobotView,
    move,
    paint_red,
)
from morphgen.viewer.session import (
    Session,
    set_value,
    show_state,
    soon,
)


@dataclass(eq=False)
class RobotPage:
    """A robot in one browser."""

    session: Session
    place: str
    robot: Robot
    view: RobotView
    over: Overlays
    q: Array
    sliders: list[viser.GuiSliderHandle[float]] = field(default_factory=list)
    told: list[float] = field(default_factory=list)
    """What the sliders showed when they were last looked at."""
    toggles: dict[str, viser.GuiCheckboxHandle] = field(default_factory=dict)
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    gizmo: viser.TransformControlsHandle | None = None
    dragged: bool = False
    tested: SelfCollisionChecker | None = None


def set_configuration(page: RobotPage, q: Array) -> None:
    """Move the robot and its sliders to a configuration, shape (dof,)."""
    page.q = np.array(q, dtype=np.float64)
    for k, slider in enumerate(page.sliders):
        set_value(slider, float(np.clip(page.q[k], slider.min, slider.max)))
        page.told[k] = slider.value
    show_moved(page)


def joints_text(q: Array) -> str:
    """A configuration as an address holds it."""
    return ",".join(f"{value:.4g}" for value in q)


def parse_joints(text: str, robot: Robot) -> Array | None:
    """A configuration from an address, within the limits; None if it is none of this robot."""
    try:
        q = np.array([float(value) for value in text.split(",")])
    except ValueError:
        return None
    if q.shape != (robot.dof,) or not np.isfinite(q).all():
        return None
    return np.asarray(np.clip(q, *joint_limits(robot).T))


def show_moved(page: RobotPage) -> None:
    """Show the robot where it is now, with all that goes with it."""
    with page.session.client.atomic():
        move(page.view, page.q)
        if page.tested is not None:
            (found,) = page.tested.penetrations([page.q])
            paint_red(page.view, {name for pair in found for name in pair})
            page.texts["collisions"].content = markup.framed(robot_tables.collision_text(found))
        if is_on(page, "ignored pairs"):
            scene_overlays.show_ignored_pairs(page.over)
        if scene_overlays.has_tool(page.robot):
            T_root_tool = frame_pose(page.robot, page.q)
            if is_on(page, "trail"):
                scene_overlays.extend_trail(page.over, T_root_tool[:3, 3])
            if page.gizmo is not None and not page.dragged:
                pose = Pose.from_matrix(T_root_tool)
                page.gizmo.position, page.gizmo.wxyz = pose.position, pose.quaternion
    soon(page.session, 0.5, lambda: tell_address(page), "address")


def tell_address(page: RobotPage) -> None:
    """Put the configuration and what is shown into the page's address."""
    at_home = np.allclose(page.q, page.robot.home)
    shown = ",".join(name for name, box in page.toggles.items() if box.value)
    show_state(
        page.session,
        page.robot.name,
        q="" if at_home else joints_text(page.q),
        show="" if shown == "visual" else shown,
    )


def is_on(page: RobotPage, name: str) -> bool:
    """Whether something is to be shown."""
    return name in page.toggles and page.toggles[name].value
