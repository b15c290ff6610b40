"""What can be shown of a robot on its page, and dragging its tool."""

from __future__ import annotations

from collections.abc import Callable

import viser

from morphgen.fitting.replace_collision import as_primitives, stored_primitives
from morphgen.formats.fits import read_stored_fits
from morphgen.model.geometry import Pose
from morphgen.model.inverse_kinematics import solve_pose_ik
from morphgen.model.kinematics import frame_pose
from morphgen.viewer import scene_overlays
from morphgen.viewer.robot_state import (
    RobotPage,
    is_on,
    set_configuration,
    tell_address,
)
from morphgen.viewer.robot_uri import with_library_meshes
from morphgen.viewer.scene_robot import (
    Layer,
    robot_extent,
    set_opacity,
    set_visible,
    show_axes,
    show_inertia,
    show_layer,
)
from morphgen.viewer.session import (
    in_worker,
    later,
    post,
    say,
    when,
)

SHOWN = ("visual", "collision", "primitives", "inertia", "frames", "joint axes")
MORE = ("centres of mass", "ignored pairs", "workspace", "trail", "drag the tool")


def add_toggles(page: RobotPage) -> None:
    """Add a checkbox for everything that can be shown, and the opacity."""
    gui, session = page.session.client.gui, page.session
    for name in (*SHOWN, *MORE):
        if name in ("workspace", "trail", "drag the tool") and not scene_overlays.has_tool(
            page.robot
        ):
            continue
        box = page.toggles[name] = gui.add_checkbox(name, name == "visual")
        when(box, session, _toggler(page, name))
    opacity = gui.add_slider("opacity", 0.05, 1.0, 0.05, 1.0)
    when(opacity, session, lambda: set_opacity(page.view, opacity.value), "opacity")


def _toggler(page: RobotPage, name: str) -> Callable[[], None]:
    return lambda: toggle(page, name)


def toggle(page: RobotPage, name: str) -> None:
    """Show or hide something, as its checkbox says."""
    on = page.toggles[name].value
    if name in SHOWN[:4]:
        _toggle_layer(page, _layer(name), on)
    elif name == "frames":
        show_axes(page.view, on)
    elif name == "drag the tool":
        _toggle_gizmo(page, on)
    elif not on:
        scene_overlays.remove(page.over, name)
    elif name == "joint axes":
        scene_overlays.show_joint_axes(page.over)
    elif name == "centres of mass":
        scene_overlays.show_mass_centres(page.over)
    elif name == "ignored pairs":
        scene_overlays.show_ignored_pairs(page.over)
    elif name == "workspace":
        later(page.session, lambda: _show_workspace(page))
    tell_address(page)


def _layer(name: str) -> Layer:
    layers: dict[str, Layer] = {
        "visual": "visual",
        "collision": "collision",
        "primitives": "primitives",
        "inertia": "inertia",
    }
    return layers[name]


def _toggle_layer(page: RobotPage, layer: Layer, on: bool) -> None:
    if layer in page.view.layers or not on:
        set_visible(page.view, layer, on)
    elif layer == "collision":
        show_layer(page.view, layer, [link.collisions for link in page.robot.links])
    elif layer == "inertia":
        show_inertia(page.view)
    else:
        later(page.session, lambda: _show_primitives(page))


def _show_primitives(page: RobotPage) -> None:
    """Draw the primitives that stand for the links; what is stored at once, the rest is fitted."""
    folders = page.session.places.folders
    robot = with_library_meshes(page.robot, page.session.places.library)
    found, missing = stored_primitives(robot, read_stored_fits(folders))
    if missing:
        say(page.session, f"fitting primitives to {len(missing)} links; this takes a while")
        fitted = in_worker(page.session, as_primitives, robot, folders)
        found = {link.name: link.collisions for link in fitted.links}
    say(page.session, "")
    if is_on(page, "primitives"):
        shapes = [found.get(link.name, ()) for link in robot.links]
        post(page.session, lambda: show_layer(page.view, "primitives", shapes))


def _show_workspace(page: RobotPage) -> None:
    say(page.session, "sampling the workspace")
    points = scene_overlays.workspace_points(page.robot)
    say(page.session, "")
    if is_on(page, "workspace"):
        scene_overlays.show_workspace(page.over, points)


def _toggle_gizmo(page: RobotPage, on: bool) -> None:
    if page.gizmo is not None:
        page.gizmo.remove()
        page.gizmo = None
    if not on:
        return
    pose = Pose.from_matrix(frame_pose(page.robot, page.q))
    page.gizmo = page.session.client.scene.add_transform_controls(
        "/gizmo",
        scale=0.2 * robot_extent(page.robot),
        depth_test=False,
        position=pose.position,
        wxyz=pose.quaternion,
    )

    async def dragged(event: viser.TransformControlsEvent) -> None:
        page.dragged = event.phase != "end"
        post(page.session, lambda: _follow(page), "drag")

    page.gizmo.on_update(dragged)


def _follow(page: RobotPage) -> None:
    """Bring the tool to the gizmo, as near as it gets."""
    if page.gizmo is None:
        return
    w, x, y, z = (float(value) for value in page.gizmo.wxyz)
    px, py, pz = (float(value) for value in page.gizmo.position)
    goal = Pose((px, py, pz), (w, x, y, z)).matrix
    set_configuration(page, solve_pose_ik(page.robot, goal, page.q))
