"""The robot of a page in one browser: its state, its configuration, and its address."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser

from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.model.findings import Finding
from morphgen.model.geometry import Pose, Shape
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables, scene_overlays, scene_robot
from morphgen.viewer.page_robot_workspace import (
    WorkspaceView,
    slice_state,
)
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.scene_overlays import Overlays
from morphgen.viewer.session import Session, set_value

ADDRESS_DELAY = 0.5
"""Delay of URL updates after a move [s]; Safari allows at most 100 updates in 30 s."""


@dataclass(eq=False)
class RobotPage:
    """The page of a robot in one browser."""

    session: Session
    uri: str
    robot: Robot
    view: scene_robot.RobotView
    overlays: Overlays
    q: Array
    """Independent joint positions, shape (dof,) [rad or m]."""
    sliders: list[viser.GuiSliderHandle[float]] = field(default_factory=list)
    """Sliders in the order of q."""
    slider_scales: list[float] = field(default_factory=list)
    """Value of each slider per unit of q: 1, or 57.3 for an angle in degrees."""
    slider_values: list[float] = field(default_factory=list)
    """Values of the sliders when they were last read or set."""
    slider_box: viser.GuiFolderHandle | None = None
    """Holds the folders of sliders; None until the Move tab is there."""
    slider_folders: list[viser.GuiFolderHandle] = field(default_factory=list)
    angle_choice: viser.GuiDropdownHandle[str] | None = None
    """Dropdown of the unit of angles; None for robots without rotational joints."""
    hover_channel: viser.GuiTextHandle | None = None
    """Hidden text field in which the browser names the joint under the pointer."""
    angles: str = "rad"
    """Unit of the sliders of rotational joints, ``rad`` or ``deg``."""
    selected: str = ""
    """Name of the selected link; empty if none is."""
    outline: list[Any] = field(default_factory=list)
    """Scene nodes of the selected link's outline."""
    range_row: int | None = None
    """Index in q of the joint whose axis and range are drawn."""
    range_nodes: list[Any] = field(default_factory=list)
    """Scene nodes of that axis and range."""
    findings: tuple[Finding, ...] = ()
    """Findings of the checks, once they are there."""
    link_choice: viser.GuiDropdownHandle[str] | None = None
    layer_shapes: dict[scene_robot.Layer, Sequence[Sequence[Shape]]] = field(default_factory=dict)
    """Shapes by link of the collision layer and the primitives, once they were shown."""
    workspace: WorkspaceView | None = None
    """Controls of the workspace; None for robots without a tool."""
    toggles: dict[str, viser.GuiCheckboxHandle] = field(default_factory=dict)
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    gizmo: viser.TransformControlsHandle | None = None
    is_dragging: bool = False
    checker: SelfCollisionChecker | None = None
    """None until the checker is built, or if its meshes cannot be read."""


def set_configuration(page: RobotPage, q: Array) -> None:
    """Move the robot and its sliders to a configuration, shape (dof,)."""
    page.q = np.array(q, dtype=np.float64)
    for k, slider in enumerate(page.sliders):
        value = robot_tables.rounded(page.q[k] * page.slider_scales[k], slider.step)
        set_value(slider, float(np.clip(value, slider.min, slider.max)))
        page.slider_values[k] = slider.value
    update_scene(page)


def read_sliders(page: RobotPage) -> None:
    """Apply the sliders that the user moved; other joints keep their exact, unrounded position."""
    for k, slider in enumerate(page.sliders):
        if slider.value != page.slider_values[k]:
            page.slider_values[k] = slider.value
            page.q[k] = slider.value / page.slider_scales[k]
    update_scene(page)


def update_scene(page: RobotPage) -> None:
    """Draw the robot and its overlays at the current configuration."""
    with page.session.client.atomic():
        page.view.set_configuration(page.q)
        if page.checker is not None:
            (collisions,) = page.checker.penetrations([page.q])
            page.view.paint_red({name for pair in collisions for name in pair})
            text = robot_tables.collision_text(collisions)
            page.texts["collisions"].content = markup.framed(text)
        if is_on(page, "ignored pairs"):
            scene_overlays.show_ignored_pairs(page.overlays)
        if has_tool(page.robot):
            T_root_tool = frame_pose(page.robot, page.q)
            if is_on(page, "trail"):
                scene_overlays.extend_trail(page.overlays, T_root_tool[:3, 3])
            if page.gizmo is not None and not page.is_dragging:
                pose = Pose.from_matrix(T_root_tool)
                page.gizmo.position, page.gizmo.wxyz = pose.position, pose.quaternion
    page.session.call_later(ADDRESS_DELAY, lambda: show_in_address(page), "address")


def show_in_address(page: RobotPage) -> None:
    """Put the configuration, toggles, unit and selected link into the page's address."""
    at_home = np.allclose(page.q, page.robot.home)
    toggles = ",".join(name for name, box in page.toggles.items() if box.value)
    page.session.update_address(
        page.robot.name,
        q="" if at_home else format_joints(page.q),
        show="" if toggles == "visual" else toggles or "none",
        angles="" if page.angles == "rad" else page.angles,
        link=page.selected,
        slice=slice_state(page.workspace) if is_on(page, "workspace") else "",
    )


def format_joints(q: Array) -> str:
    """Return a configuration as text for an address."""
    return ",".join(f"{value:.4g}" for value in q)


def parse_joints(text: str, robot: Robot) -> Array | None:
    """Return a configuration from an address, clipped to the limits; None if it does not fit."""
    try:
        q = np.array([float(value) for value in text.split(",")])
    except ValueError:
        return None
    if q.shape != (robot.dof,) or not np.isfinite(q).all():
        return None
    return np.asarray(np.clip(q, *joint_limits(robot).T))


def is_on(page: RobotPage, name: str) -> bool:
    """Return whether a toggle exists and is checked."""
    return name in page.toggles and page.toggles[name].value
