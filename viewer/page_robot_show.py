"""The robot of a page in one browser: its configuration, its layers and overlays, its gizmo."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import viser

from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.fitting.replace_collision import as_primitives, stored_primitives
from morphgen.formats.fits import read_stored_fits
from morphgen.model.findings import Finding
from morphgen.model.geometry import Pose
from morphgen.model.inverse_kinematics import solve_pose_ik
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables, scene_overlays, scene_robot
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import with_library_meshes
from morphgen.viewer.scene_overlays import Overlays, remove_overlay
from morphgen.viewer.session import Session, set_value

FRAMES, GIZMO = "frames", "drag the tool"
_SHOW_OVERLAY: Mapping[str, Callable[[Overlays], None]] = {
    "joint axes": scene_overlays.show_joint_axes,
    "centres of mass": scene_overlays.show_mass_centres,
    "ignored pairs": scene_overlays.show_ignored_pairs,
}
TOGGLES = (*scene_robot.LAYERS, FRAMES, *_SHOW_OVERLAY, "workspace", "trail", GIZMO)
"""Layers, overlays and gizmo that can be shown of a robot, as named in the address."""
TOOL_TOGGLES = ("workspace", "trail", GIZMO)
"""Toggles for robots with a tool only."""
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
        show="" if toggles == "visual" else toggles,
        angles="" if page.angles == "rad" else page.angles,
        link=page.selected,
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


def add_toggles(page: RobotPage) -> None:
    """Add a checkbox for everything that can be shown, and the slider of the opacity."""
    gui, session = page.session.client.gui, page.session
    for name in TOGGLES:
        if name in TOOL_TOGGLES and not has_tool(page.robot):
            continue
        box = page.toggles[name] = gui.add_checkbox(name, name == "visual")
        session.on_change(box, functools.partial(apply_toggle, page, name))
    opacity = gui.add_slider("opacity", 0.05, 1.0, 0.05, 1.0)
    session.on_change(opacity, lambda: page.view.set_opacity(opacity.value), "opacity")


def is_on(page: RobotPage, name: str) -> bool:
    """Return whether a toggle exists and is checked."""
    return name in page.toggles and page.toggles[name].value


def apply_toggle(page: RobotPage, name: str) -> None:
    """Show or hide what a toggle stands for."""
    on = page.toggles[name].value
    layer = next((layer for layer in scene_robot.LAYERS if layer == name), None)
    if layer is not None:
        _toggle_layer(page, layer, on)
    elif name == FRAMES:
        page.view.show_axes(on)
    elif name == GIZMO:
        _toggle_gizmo(page, on)
    elif not on:
        remove_overlay(page.overlays, name)
    elif name in _SHOW_OVERLAY:
        _SHOW_OVERLAY[name](page.overlays)
    elif name == "workspace":
        page.session.run_in_background(lambda: _show_workspace(page))
    show_in_address(page)


def _toggle_layer(page: RobotPage, layer: scene_robot.Layer, on: bool) -> None:
    if layer in page.view.layers or not on:
        page.view.set_visible(layer, on)
    elif layer == "collision":
        shapes = [link.collisions for link in page.robot.links]
        page.view.show_shapes(layer, shapes)
    elif layer == "inertia":
        page.view.show_inertia()
    else:
        page.session.run_in_background(lambda: _show_primitives(page))


def _show_primitives(page: RobotPage) -> None:
    """Draw the primitives fitted to the links; fits that are not stored are computed."""
    session = page.session
    folders = session.files.library_folders
    robot = with_library_meshes(page.robot, session.files.library)
    primitives, missing = stored_primitives(robot, read_stored_fits(folders))
    if missing:
        session.set_status(f"fitting primitives to {len(missing)} links; this takes a while")
        fitted = session.run_in_worker(as_primitives, robot, folders)
        primitives = {link.name: link.collisions for link in fitted.links}
    session.set_status("")
    if is_on(page, "primitives"):
        shapes = [primitives.get(link.name, ()) for link in robot.links]
        session.enqueue(lambda: page.view.show_shapes("primitives", shapes))


def _show_workspace(page: RobotPage) -> None:
    page.session.set_status("sampling the workspace")
    points = scene_overlays.sample_workspace(page.robot)
    page.session.set_status("")
    if is_on(page, "workspace"):
        scene_overlays.show_workspace(page.overlays, points)


def _toggle_gizmo(page: RobotPage, on: bool) -> None:
    """Add or remove a gizmo at the tool; the robot follows it by inverse kinematics."""
    if page.gizmo is not None:
        page.gizmo.remove()
        page.gizmo = None
    if not on:
        return
    pose = Pose.from_matrix(frame_pose(page.robot, page.q))
    page.gizmo = page.session.client.scene.add_transform_controls(
        "/gizmo",
        scale=0.2 * scene_robot.robot_extent(page.robot),
        depth_test=False,
        position=pose.position,
        wxyz=pose.quaternion,
    )

    async def dragged(event: viser.TransformControlsEvent) -> None:
        page.is_dragging = event.phase != "end"
        page.session.enqueue(lambda: _follow_gizmo(page), "drag")

    page.gizmo.on_update(dragged)


def _follow_gizmo(page: RobotPage) -> None:
    """Move the tool to the gizmo, or as near as the joint limits allow."""
    if page.gizmo is None:
        return
    w, x, y, z = (float(value) for value in page.gizmo.wxyz)
    px, py, pz = (float(value) for value in page.gizmo.position)
    T_root_gizmo = Pose((px, py, pz), (w, x, y, z)).matrix
    set_configuration(page, solve_pose_ik(page.robot, T_root_gizmo, page.q))
