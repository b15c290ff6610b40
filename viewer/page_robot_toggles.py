"""The Show tab of the robot page: layers, overlays, the workspace and the gizmo."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import viser

from morphgen.fitting.replace_collision import as_primitives, stored_primitives
from morphgen.formats.fits import read_stored_fits
from morphgen.model.findings import Finding
from morphgen.model.geometry import Pose
from morphgen.model.inverse_kinematics import solve_pose_ik
from morphgen.model.kinematics import frame_pose
from morphgen.viewer import scene_overlays, scene_robot
from morphgen.viewer.page_robot_show import (
    ADDRESS_DELAY,
    RobotPage,
    is_on,
    set_configuration,
    show_in_address,
)
from morphgen.viewer.page_robot_workspace import (
    WorkspaceView,
    add_controls,
    sample,
    show_controls,
)
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import with_library_meshes
from morphgen.viewer.scene_overlays import Overlays, remove_overlay
from morphgen.viewer.scene_stage import look_at

FRAMES, XRAY, GIZMO = "frames", "x-ray", "drag the tool"
_SHOW_OVERLAY: Mapping[str, Callable[[Overlays], None]] = {
    "joint axes": scene_overlays.show_joint_axes,
    "centres of mass": scene_overlays.show_mass_centres,
    "ignored pairs": scene_overlays.show_ignored_pairs,
    "names": scene_overlays.show_names,
}
TOGGLES = (*scene_robot.LAYERS, XRAY, FRAMES, *_SHOW_OVERLAY, "workspace", "trail", GIZMO)
"""Layers, overlays and gizmo that can be shown of a robot, as named in the address."""
TOOL_TOGGLES = ("workspace", "trail", GIZMO)
"""Toggles for robots with a tool only."""
_XRAY_OPACITY = 0.2
"""Opacity of visual shapes in the x-ray view."""
_GROWTH = 0.002
"""Distance by which collision shapes and primitives are grown while visual shapes are shown, in
extents of the robot: surfaces at the same place would flicker."""


def add_toggles(page: RobotPage) -> None:
    """Add a checkbox for everything that can be shown, and the slider of the opacity."""
    gui, session = page.session.client.gui, page.session
    for name in TOGGLES:
        if name in TOOL_TOGGLES and not has_tool(page.robot):
            continue
        box = page.toggles[name] = gui.add_checkbox(name, name == "visual")
        session.on_change(box, functools.partial(apply_toggle, page, name))
    if has_tool(page.robot):
        page.workspace = add_controls(page.session)
        position = page.workspace.position
        session.on_change(position, lambda: _cut_workspace(page), "slice")


def apply_toggle(page: RobotPage, name: str) -> None:
    """Show or hide what a toggle stands for."""
    on = page.toggles[name].value
    layer = next((layer for layer in scene_robot.LAYERS if layer == name), None)
    if layer is not None:
        _toggle_layer(page, layer, on)
    elif name == XRAY:
        page.view.set_opacity(_XRAY_OPACITY if on else 1.0)
        _show_visual(page)
    elif name == FRAMES:
        page.view.show_axes(on)
    elif name == GIZMO:
        _toggle_gizmo(page, on)
    elif name == "workspace" and page.workspace is not None:
        _toggle_workspace(page, page.workspace, on)
    elif not on:
        remove_overlay(page.overlays, name)
    elif name in _SHOW_OVERLAY:
        _SHOW_OVERLAY[name](page.overlays)
    show_in_address(page)


def _toggle_layer(page: RobotPage, layer: scene_robot.Layer, on: bool) -> None:
    if layer == "inertia":
        _toggle_inertia(page, on)
    elif layer == "primitives" and on and layer not in page.layer_shapes:
        page.session.run_in_background(lambda: _fit_primitives(page))
    elif layer == "visual":
        _show_visual(page)
    else:
        if layer == "collision":
            page.layer_shapes[layer] = [link.collisions for link in page.robot.links]
        _show_layer(page, layer)


def _has_visual(page: RobotPage) -> bool:
    """Return whether visual shapes are to be seen, solid or transparent."""
    return is_on(page, "visual") or is_on(page, XRAY)


def _show_visual(page: RobotPage) -> None:
    """Show or hide the visual shapes, and draw the layers beside them exact or a little grown."""
    page.view.set_visible("visual", _has_visual(page))
    for layer in page.layer_shapes:
        _show_layer(page, layer)


def _show_layer(page: RobotPage, layer: scene_robot.Layer) -> None:
    """Draw the collision shapes or primitives if they are to be seen, exact or a little grown."""
    if not is_on(page, layer):
        page.view.remove_layer(layer)
        return
    growth = _GROWTH * scene_robot.robot_extent(page.robot) if _has_visual(page) else 0.0
    page.view.show_shapes(layer, page.layer_shapes[layer], growth)


def _toggle_inertia(page: RobotPage, on: bool) -> None:
    """Draw the boxes of inertia with the findings about them, or remove both."""
    remove_overlay(page.overlays, "inertia findings")
    if not on:
        page.view.remove_layer("inertia")
        return
    page.view.show_inertia()
    scene_overlays.show_inertia_findings(page.overlays, page.findings)


def set_findings(page: RobotPage, findings: Sequence[Finding]) -> None:
    """Keep the findings of the checks, and show those about inertia beside its boxes."""
    page.findings = tuple(findings)
    if is_on(page, "inertia"):
        scene_overlays.show_inertia_findings(page.overlays, page.findings)


def _fit_primitives(page: RobotPage) -> None:
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
    page.layer_shapes["primitives"] = [primitives.get(link.name, ()) for link in robot.links]
    session.enqueue(lambda: _show_layer(page, "primitives"))


def _toggle_workspace(page: RobotPage, workspace: WorkspaceView, on: bool) -> None:
    """Show the workspace with the camera around it, or remove it and look at the robot again."""
    if on:
        page.session.run_in_background(lambda: _sample_workspace(page, workspace))
        return
    remove_overlay(page.overlays, "workspace")
    show_controls(workspace, visible=False)
    look_at(page.session.client, *scene_robot.robot_bounds(page.robot))


def _sample_workspace(page: RobotPage, workspace: WorkspaceView) -> None:
    page.session.set_status("sampling the workspace")
    sample(workspace, page.robot, page.session.address.state.get("slice", ""))
    page.session.set_status("")
    page.session.enqueue(lambda: _show_workspace(page, workspace))


def _show_workspace(page: RobotPage, workspace: WorkspaceView) -> None:
    if not is_on(page, "workspace"):
        return
    show_controls(workspace, visible=True)
    _cut_workspace(page)
    low, high = scene_robot.robot_bounds(page.robot)
    assert workspace.points is not None
    low = np.minimum(low, workspace.points.min(axis=0))
    look_at(page.session.client, low, np.maximum(high, workspace.points.max(axis=0)))


def _cut_workspace(page: RobotPage) -> None:
    """Draw the workspace, cut at the slider's position."""
    workspace = page.workspace
    if workspace is None or workspace.points is None or not is_on(page, "workspace"):
        return
    with page.session.client.atomic():
        y = workspace.position.value
        scene_overlays.show_workspace(page.overlays, workspace.points, y)
    page.session.call_later(ADDRESS_DELAY, lambda: show_in_address(page), "address")


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
