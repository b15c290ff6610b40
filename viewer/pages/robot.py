"""The page of a robot: move it, show its layers, links and findings, download it."""

from __future__ import annotations

import functools
import io
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from typing import Any, Literal

import numpy as np
import viser
from PIL import Image

from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.fitting.replace_collision import as_primitives, stored_primitives
from morphgen.formats.bundle import CARD, MJCF, URDF, file_findings, split_colours
from morphgen.formats.fits import read_stored_fits
from morphgen.model.findings import Finding
from morphgen.model.geometry import Pose, Shape
from morphgen.model.kinematics import (
    arm_reach,
    driving_joints,
    forward_kinematics,
    frame_pose,
    joint_limits,
    link_jacobians,
    random_configurations,
    solve_pose_ik,
)
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.frame import call
from morphgen.viewer.app.session import Session, set_value
from morphgen.viewer.app.viser_internals import control_id
from morphgen.viewer.app.web_page import robot_page
from morphgen.viewer.robot_files import bundle_files, zip_files
from morphgen.viewer.robot_rows import neighbour_uris
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import (
    UPLOAD,
    WORDS,
    member_split,
    parent_folder,
    read_robot_uri,
    uri_name,
    with_library_meshes,
)
from morphgen.viewer.scene import overlays as scene_overlays
from morphgen.viewer.scene import robot as scene_robot
from morphgen.viewer.scene import stage as scene_stage
from morphgen.viewer.scene.overlays import NUM_POINTS, OFTEN, SELDOM, Overlays, remove_overlay

WEB_PAGE = "robot.html"  # name of the web page in a bundle
PANEL_WIDTH = 390.0  # width of the panel [pixels]
RENDER_TIMEOUT = 60.0  # time in which the browser has to send a screenshot [s]
_STEP = 0.01  # step of the slice [m]


@dataclass(eq=False)
class Workspace:
    """The workspace of a page's robot."""

    position: viser.GuiSliderHandle[float]  # position y of the slice [m]
    legend: viser.GuiHtmlHandle
    asked: str = ""  # position of the slice in the address; anything but a number means zero
    points: Array | None = None  # tool positions, shape (n, 3) [m]; None until they are sampled
    shell: scene_stage.Triangles | None = None  # shell of these positions

    def ask(self, position: str) -> None:
        """Remember the position that an address has until the workspace is there."""
        self.asked = position

    @property
    def state(self) -> str:
        """Position of the slice for the address; empty at zero."""
        y = self.position.value
        if self.points is None:
            return self.asked
        return f"{y:.3g}" if abs(y) > _STEP / 2 else ""


@dataclass(eq=False)
class RobotPage:
    """The page of a robot in one browser."""

    session: Session
    uri: str
    robot: Robot
    view: scene_robot.RobotView
    overlays: Overlays
    q: Array  # independent joint positions, shape (dof,) [rad or m]
    sliders: list[viser.GuiSliderHandle[float]] = field(default_factory=list)
    """Sliders in the order of q."""
    slider_scales: list[float] = field(default_factory=list)  # slider's unit per unit of q
    slider_values: list[float] = field(default_factory=list)  # values when last read or set
    slider_box: viser.GuiFolderHandle | None = None  # holds the folders of sliders
    slider_folders: list[viser.GuiFolderHandle] = field(default_factory=list)
    angle_choice: viser.GuiDropdownHandle[str] | None = None
    """Dropdown of the unit of angles; None for robots without rotational joints."""
    hover_channel: viser.GuiTextHandle | None = None  # hidden; names the joint at the pointer
    angles: str = "rad"  # unit of the sliders of rotational joints, `rad` or `deg`
    selected: str = ""  # name of the selected link; empty if none is
    range_row: int | None = None  # index in q of the joint whose axis and range are drawn
    findings: tuple[Finding, ...] = ()  # findings of the checks, once they are there
    link_choice: viser.GuiDropdownHandle[str] | None = None
    primitives: Sequence[Sequence[Shape]] | None = None  # primitives by link, once they were shown
    workspace: Workspace | None = None  # controls of the workspace; None for robots without a tool
    toggles: dict[str, viser.GuiCheckboxHandle] = field(default_factory=dict)
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    gizmo: viser.TransformControlsHandle | None = None
    is_dragging: bool = False
    checker: SelfCollisionChecker | None = None  # None until built, or if meshes are unreadable


def show(session: Session) -> None:
    """Build the page of the robot that the address names."""
    uri = session.address.subject
    gui = session.client.gui
    session.open_panel(PANEL_WIDTH, _location(session, uri), f"reading {uri_name(uri)}")
    robot = split_colours(read_robot_uri(uri, session.files))
    low, high = scene_robot.robot_bounds(robot)
    scene_stage.add_ground(session.client.scene, float(np.linalg.norm(high - low)))
    scene_stage.add_scale_bar(session.client.scene, low, high, scene_stage.CAMERA_DIRECTION)
    scene_stage.look_at(session.client, low, high)
    view = scene_robot.add_robot(session.client.scene, robot, "/robot")
    page = RobotPage(session, uri, robot, view, Overlays(view), np.array(robot.home))
    gui.add_html(summary(robot, _links(robot, uri)))
    page.texts["card"], page.texts["mark"] = gui.add_html(""), gui.add_html("")
    tabs = gui.add_tab_group()
    with tabs.add_tab("Move", viser.Icon.ARROWS_MOVE):
        _add_move_tab(page)
    with tabs.add_tab("Show", viser.Icon.EYE):
        _add_toggles(page)
    with tabs.add_tab("Links", viser.Icon.BINARY_TREE):
        _add_links_tab(page)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.texts["findings"] = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_downloads_tab(page)
    session.set_status("")
    _connect_links(page)
    session.title = robot.name
    _keep_state(page)
    session.run_in_background(lambda: _check_robot(page))


def summary(robot: Robot, links: str) -> str:
    """Return a robot's name and facts, followed by links as HTML."""
    distance = arm_reach(robot) if has_tool(robot) and robot.dof else None
    facts = robot_tables.summary(robot, distance)
    return markup.framed(f"<h3>{escape(robot.name)}</h3>", markup.dim(facts + links))


def _location(session: Session, uri: str) -> str:
    """Return breadcrumbs to the robot's set or split, with links to its neighbours there."""
    steps: list[tuple[str, Address | None]] = []
    if split := member_split(uri):
        steps.append((split, Address("split", (split,))))
    elif folder := parent_folder(uri):
        steps.append((folder, Address("gallery", (folder,))))
    previous, following = neighbour_uris(uri, session.files)
    links = [
        markup.link(Address("robot", (neighbour,)), text)
        for neighbour, text in ((previous, "◂ previous"), (following, "next ▸"))
        if neighbour
    ]
    neighbours = markup.dim(" · ".join(links)) if links else ""
    return markup.breadcrumbs(*steps, (uri_name(uri), None)) + markup.framed(neighbours)


def _links(robot: Robot, uri: str) -> str:
    """Return links to what can be done with a robot, as HTML."""
    links = [markup.choose_box(uri, "choose")]
    if robot.provenance.get("derivation"):
        target = Address("compose", (uri.removeprefix(WORDS),))
        links.append(markup.link(target, "Edit in Compose"))
    links.append(markup.link(Address("compare", (uri,)), "compare"))
    if has_tool(robot) and robot.dof:
        play = (markup.link(Address("play", (task,), robots=(uri,)), task) for task in TASKS)
        links.append(f"see it {' · '.join(play)}")
    return f"<br>{' · '.join(links)}"


def _set_configuration(page: RobotPage, q: Array) -> None:
    """Move the robot and its sliders to a configuration, shape (dof,)."""
    page.q = np.array(q, dtype=np.float64)
    for k, slider in enumerate(page.sliders):
        value = robot_tables.rounded(page.q[k] * page.slider_scales[k], slider.step)
        set_value(slider, float(np.clip(value, slider.min, slider.max)))
        page.slider_values[k] = slider.value
    update_scene(page)


def _read_sliders(page: RobotPage) -> None:
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
        if _is_on(page, "ignored pairs"):
            scene_overlays.show_ignored_pairs(page.overlays)
        if has_tool(page.robot):
            T_root_tool = frame_pose(page.robot, page.q)
            if _is_on(page, "trail"):
                scene_overlays.extend_trail(page.overlays, T_root_tool[:3, 3])
            if page.gizmo is not None and not page.is_dragging:
                pose = Pose.from_matrix(T_root_tool)
                page.gizmo.position, page.gizmo.wxyz = pose.position, pose.quaternion
    page.session.show_state_later()


def _keep_state(page: RobotPage) -> None:
    """Keep the page's state in its address, and take over what the address has."""
    session, workspace = page.session, page.workspace
    if workspace is not None:
        session.keep(
            "slice",
            lambda: workspace.state if _is_on(page, "workspace") else "",
            workspace.ask,  # before the toggle shows it
        )
    session.keep("show", lambda: _shown(page), lambda text: _show(page, text.split(",")))
    session.keep(
        "angles",
        lambda: "" if page.angles == "rad" else page.angles,
        lambda unit: _set_angles(page, unit),
    )
    session.keep("link", lambda: page.selected, lambda name: _select_link(page, name))
    session.keep(
        "q",
        lambda: "" if np.allclose(page.q, page.robot.home) else format_joints(page.q),
        lambda text: _apply_joints(page, text),
    )
    session.apply_state()
    session.show_state()


def _shown(page: RobotPage) -> str:
    """Return the checked toggles for the address."""
    shown = ",".join(name for name, box in page.toggles.items() if box.value)
    return "" if shown == "visual" else shown or "none"


def _show(page: RobotPage, names: Sequence[str]) -> None:
    """Check the named toggles and no others."""
    changed = [name for name, box in page.toggles.items() if box.value != (name in names)]
    for name in changed:
        set_value(page.toggles[name], name in names)
    for name in changed:  # after all are set: what is drawn may depend on several
        _apply_toggle(page, name)


def _apply_joints(page: RobotPage, text: str) -> None:
    if (q := parse_joints(text, page.robot)) is not None:
        _set_configuration(page, q)


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


def _is_on(page: RobotPage, name: str) -> bool:
    """Return whether a toggle exists and is checked."""
    return name in page.toggles and page.toggles[name].value


NO_LINK = "(none)"  # choice of the dropdown of links that selects none
_DRAG_ROUNDS = 4  # Newton steps by which a joint follows the pointer, per event
_MAX_TURN = 0.4  # largest such step [rad or m]


def _select_link(page: RobotPage, name: str) -> None:
    """Select a link: outline, card and slider; an empty or unknown name selects none."""
    page.selected = name = name if name in page.robot.link_index else ""
    scene_overlays.show_outline(page.overlays, page.robot.link_index[name] if name else None)
    if page.link_choice is not None:
        set_value(page.link_choice, name or NO_LINK)
        details = robot_tables.link_details(page.robot, name) if name else ""
        page.texts["details"].content = markup.framed(details)
    _show_card(page)
    _mark_slider(page)
    page.session.show_state()


def _show_card(page: RobotPage) -> None:
    """Show the card of the selected link."""
    card = ""
    if page.selected:
        text = robot_tables.link_card(page.robot, page.selected, page.findings)
        card = f'<div class="selected">{text}</div>'
    page.texts["card"].content = markup.framed(card)


def joint_of_link(robot: Robot, link: int) -> int | None:
    """Return the index in q of the joint nearest above a link that moves it; None for the base."""
    while link:
        if rows := driving_joints(robot, (link - 1,)):
            return rows[0]
        link = robot.parents[link]
    return None


def _mark_slider(page: RobotPage) -> None:
    """Colour the slider of the joint that moves the selected link."""
    style = ""
    if page.selected:
        row = joint_of_link(page.robot, page.robot.link_index[page.selected])
        if row is not None:
            name, colour = control_id(page.sliders[row]), markup.SELECTED
            style = (
                f'<style>[id="{name}"] .mantine-Slider-bar,[id="{name}"] .mantine-Slider-thumb'
                f"{{background:{colour}!important}}"
                f'div:has(>*>*>label[for="{name}"]){{box-shadow:-4px 0 {colour};'
                f"background:{colour}22}}</style>"
            )
    page.texts["mark"].content = style


def _watch_sliders(page: RobotPage) -> None:
    """Draw a joint's axis and range while the pointer or the focus is at its slider."""
    channel = page.hover_channel
    if channel is None:
        gui, session = page.session.client.gui, page.session
        channel = page.hover_channel = gui.add_text("", "")
        style = f'<style>div:has(>*>*>*>label[for="{control_id(channel)}"]){{display:none}}</style>'
        gui.add_html(style)
        session.on_change(channel, lambda: _show_range(page, _row(channel.value, page)), "range")
    rows = {control_id(slider): str(row) for row, slider in enumerate(page.sliders)}
    page.session.run_script(call("watch", control_id(channel), rows))


def _row(text: str, page: RobotPage) -> int | None:
    """Return the index in q that a browser sent; None for anything else."""
    return int(text) if text.isdecimal() and int(text) < page.robot.dof else None


def _show_range(page: RobotPage, row: int | None) -> None:
    """Draw the axis and the range of a joint, given by its index in q; None removes them."""
    if row == page.range_row:
        return
    page.range_row = row
    with page.session.client.atomic():
        joint = None if row is None else page.robot.independent_joints[row]
        scene_overlays.show_range(page.overlays, joint)


def _connect_links(page: RobotPage) -> None:
    """Let clicks in the scene select links, and drags turn their joints."""
    for link, frame in enumerate(page.view.links):
        frame.on_click(functools.partial(_clicked, page, link))
        row = joint_of_link(page.robot, link)
        if row is not None:
            frame.on_drag(_LinkDrag(page, link, row).moved)


async def _clicked(page: RobotPage, link: int, event: viser.SceneNodePointerEvent[Any]) -> None:
    """Select the link that was clicked, or none if it already was."""
    del event
    name = page.robot.links[link].name
    page.session.enqueue(lambda: _select_link(page, "" if name == page.selected else name))


class _LinkDrag:
    """A drag of one link, which turns the joint above it."""

    def __init__(self, page: RobotPage, link: int, row: int) -> None:
        """Remember the link and the index in q of its joint."""
        self._page, self._link, self._row = page, link, row
        self._point = self._target = np.zeros(3)

    async def moved(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        """Follow the pointer; the gripped point is fixed to the link."""
        page = self._page
        if event.phase == "start":
            T_root_link = page.view.T_root_link[self._link]
            offset = np.array(event.start_position) - T_root_link[:3, 3]
            self._point = T_root_link[:3, :3].T @ offset
            page.session.enqueue(lambda: _show_range(page, self._row))
        self._target = np.array(event.end_position)
        if event.phase == "end":
            page.session.enqueue(lambda: _show_range(page, None))
        else:
            page.session.enqueue(self._follow, "drag link")

    def _follow(self) -> None:
        page = self._page
        q = turn_towards(page.robot, page.q, self._row, self._link, self._point, self._target)
        _set_configuration(page, q)


def turn_towards(robot: Robot, q: Array, row: int, link: int, point: Array, target: Array) -> Array:
    """Return a configuration (dof,) in which a point of a link is as near as possible to a target.

    The point is in the link's frame, the target in the root frame, shape (3,) each [m].
    """
    q, (low, high) = q.copy(), joint_limits(robot)[row]
    column = robot.mimic_map[0][:, row]
    for _ in range(_DRAG_ROUNDS):
        T_root_link = forward_kinematics(robot, q)
        position = T_root_link[link, :3, :3] @ point + T_root_link[link, :3, 3]
        linear, angular = (link_jacobians(robot, T_root_link)[link] @ column).reshape(2, 3)
        velocity = linear + np.cross(angular, position)
        square = float(velocity @ velocity)
        if square < 1e-12:  # the point is on the joint's axis
            break
        step = float(velocity @ (target - position)) / square
        q[row] = np.clip(q[row] + np.clip(step, -_MAX_TURN, _MAX_TURN), low, high)
    return q


ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": 180 / math.pi}  # number per radian
MAX_TRIES = 500  # random configurations that are tested to find one without collision


def _add_move_tab(page: RobotPage) -> None:
    """Add buttons for special configurations and for the unit, and a slider for each joint."""
    gui, session = page.session.client.gui, page.session
    buttons = gui.add_button_group("Go to", ("home", "zero", "random free"))
    session.on_change(buttons, lambda: _go_to(page, buttons.value))
    if any(page.robot.joints[k].kind != "prismatic" for k in page.robot.independent_joints):
        unit = page.angle_choice = gui.add_dropdown("Angles in", tuple(ANGLES))
        session.on_change(unit, lambda: _set_angles(page, unit.value))
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


def _set_angles(page: RobotPage, unit: str) -> None:
    """Show the angles of the sliders in another unit, ``rad`` or ``deg``."""
    if page.angle_choice is None or unit not in ANGLES or unit == page.angles:
        return
    page.angles = unit
    set_value(page.angle_choice, unit)
    _add_sliders(page)
    page.session.show_state()


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
                    joint.name.removeprefix(f"{group.label}_"),
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
        session.on_change(slider, lambda: _read_sliders(page), "move")
    _mark_slider(page)
    _watch_sliders(page)


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
    _set_configuration(page, q)


GIZMO = "drag the tool"
_SHOW_OVERLAY: Mapping[str, Callable[[Overlays], None]] = {
    "joint axes": scene_overlays.show_joint_axes,
    "centres of mass": scene_overlays.show_mass_centres,
    "ignored pairs": scene_overlays.show_ignored_pairs,
    "names": scene_overlays.show_names,
}
TOGGLES = (*scene_robot.LAYERS, "x-ray", "frames", *_SHOW_OVERLAY, "workspace", "trail", GIZMO)
"""Layers, overlays and gizmo that can be shown of a robot, as named in the address."""
TOOL_TOGGLES = ("workspace", "trail", GIZMO)  # toggles for robots with a tool only
_XRAY_OPACITY = 0.2  # opacity of visual shapes in the x-ray view
_GROWTH = 0.002
"""Distance by which collision shapes and primitives are grown while visual shapes are shown, in
extents of the robot: surfaces at the same place would flicker."""


def _add_toggles(page: RobotPage) -> None:
    """Add a checkbox for everything that can be shown, and the slider of the workspace's slice."""
    gui, session = page.session.client.gui, page.session
    for name in TOGGLES:
        if name in TOOL_TOGGLES and not has_tool(page.robot):
            continue
        box = page.toggles[name] = gui.add_checkbox(name, name == "visual")
        session.on_change(box, functools.partial(_apply_toggle, page, name))
    if has_tool(page.robot):
        position = gui.add_slider("slice at y [m]", -1.0, 1.0, _STEP, 0.0, visible=False)
        page.workspace = Workspace(position, gui.add_html(""))
        session.on_change(position, lambda: _cut_workspace(page), "slice")


def _apply_toggle(page: RobotPage, name: str) -> None:
    """Show or hide what a toggle stands for."""
    on = page.toggles[name].value
    match name:
        case "visual" | "x-ray":
            _show_visual(page)
        case "collision" | "primitives":
            _show_layer(page, name)
        case "inertia":
            _show_inertia(page)
        case "frames":
            page.view.show_axes(on)
        case "workspace" if page.workspace is not None:
            _toggle_workspace(page, page.workspace, on)
        case "drag the tool":
            _toggle_gizmo(page, on)
        case _ if not on:
            remove_overlay(page.overlays, name)
        case _ if name in _SHOW_OVERLAY:  # the trail appears when the tool moves
            _SHOW_OVERLAY[name](page.overlays)
    page.session.show_state()


def _has_visual(page: RobotPage) -> bool:
    """Return whether visual shapes are to be seen, solid or transparent."""
    return _is_on(page, "visual") or _is_on(page, "x-ray")


def _show_visual(page: RobotPage) -> None:
    """Show the visual shapes as the toggles say, and the layers beside them exact or grown."""
    page.view.set_opacity(_XRAY_OPACITY if _is_on(page, "x-ray") else 1.0)
    page.view.set_visible("visual", _has_visual(page))
    if "collision" in page.view.layers:  # else its own toggle draws it
        _show_layer(page, "collision")
    if "primitives" in page.view.layers:
        _show_layer(page, "primitives")


def _show_layer(page: RobotPage, layer: Literal["collision", "primitives"]) -> None:
    """Draw the collision shapes or primitives if they are to be seen, exact or a little grown."""
    if not _is_on(page, layer):
        page.view.remove_layer(layer)
    elif layer == "primitives" and page.primitives is None:
        page.session.run_in_background(lambda: _fit_primitives(page), "fit")
    else:
        shapes = page.primitives if layer == "primitives" else None
        growth = _GROWTH * scene_robot.robot_extent(page.robot) if _has_visual(page) else 0.0
        page.view.show_shapes(
            layer, shapes or [link.collisions for link in page.robot.links], growth
        )


def _show_inertia(page: RobotPage) -> None:
    """Draw the boxes of inertia with the findings about them, or remove both."""
    remove_overlay(page.overlays, "inertia findings")
    if _is_on(page, "inertia"):
        page.view.show_inertia()
        scene_overlays.show_inertia_findings(page.overlays, page.findings)
    else:
        page.view.remove_layer("inertia")


def _fit_primitives(page: RobotPage) -> None:
    """Draw the primitives fitted to the links; fits that are not stored are computed."""
    session = page.session
    folders = session.files.library_folders
    robot = with_library_meshes(page.robot, session.files.library)
    primitives, missing = stored_primitives(robot, read_stored_fits(folders))
    if missing:
        with session.activity(f"fitting primitives to {len(missing)} links; this takes a while"):
            fitted = session.run_in_worker(as_primitives, robot, folders)
        primitives = {link.name: link.collisions for link in fitted.links}
    page.primitives = [primitives.get(link.name, ()) for link in robot.links]
    session.enqueue(lambda: _show_layer(page, "primitives"))


def _toggle_workspace(page: RobotPage, workspace: Workspace, on: bool) -> None:
    """Show the workspace with the camera around it, or remove it and look at the robot again."""
    if on:
        page.session.run_in_background(lambda: _sample_workspace(page, workspace))
        return
    remove_overlay(page.overlays, "workspace")
    workspace.position.visible, workspace.legend.content = False, ""
    scene_stage.look_at(page.session.client, *scene_robot.robot_bounds(page.robot))


def _sample_workspace(page: RobotPage, workspace: Workspace) -> None:
    with page.session.activity("sampling the workspace"):
        points = scene_overlays.sample_workspace(page.robot)
        workspace.shell = scene_overlays.shell(points)
    page.session.enqueue(lambda: _show_workspace(page, workspace, points))


def _show_workspace(page: RobotPage, workspace: Workspace, points: Array) -> None:
    """Show sampled tool positions, cut at the position that the address asks for."""
    if not _is_on(page, "workspace"):
        return
    slider, (low, high) = workspace.position, (points.min(axis=0), points.max(axis=0))
    slider.min = float(np.floor(low[1] / _STEP) * _STEP)
    slider.max = float(max(np.ceil(high[1] / _STEP) * _STEP, slider.min + _STEP))
    try:
        y = float(workspace.asked)
    except ValueError:
        y = 0.0
    set_value(slider, float(np.clip(y if np.isfinite(y) else 0.0, slider.min, slider.max)))
    workspace.points, slider.visible = points, True
    workspace.legend.content = markup.framed(_legend(high - low))
    _cut_workspace(page)
    robot_low, robot_high = scene_robot.robot_bounds(page.robot)
    low, high = np.minimum(low, robot_low), np.maximum(high, robot_high)
    scene_stage.look_at(page.session.client, low, high)


def _legend(sides: Array) -> str:
    """Return what the colours of the workspace mean; its sides have shape (3,) [m]."""
    seldom, often = (f"rgb{tuple(colour.tolist())}" for colour in (SELDOM, OFTEN))
    size = " × ".join(f"{side:.2f}" for side in sides)  # noqa: RUF001
    return (
        f'<div class="scale" style="background:linear-gradient(90deg,{seldom},{often})"></div>'
        + '<div class="ends"><span>few configurations</span><span>many</span></div>'
        + markup.dim(
            f"Surface: outermost tool positions of {NUM_POINTS:,} random configurations, "
            f"{size} m. Slice: how many of them lead to each cell."
        )
    )


def _cut_workspace(page: RobotPage) -> None:
    """Draw the workspace, cut at the slider's position."""
    workspace = page.workspace
    if workspace is None or workspace.points is None or not _is_on(page, "workspace"):
        return
    assert workspace.shell is not None  # comes with the points
    with page.session.client.atomic():
        y = workspace.position.value
        scene_overlays.show_workspace(page.overlays, workspace.points, workspace.shell, y)
    page.session.show_state_later()


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
    _set_configuration(page, solve_pose_ik(page.robot, T_root_gizmo, page.q))


def _add_links_tab(page: RobotPage) -> None:
    """Add a dropdown that selects a link with all its properties, and the tree of links."""
    gui = page.session.client.gui
    page.link_choice = gui.add_dropdown(
        "Link", (NO_LINK, *(link.name for link in page.robot.links))
    )
    page.texts["details"] = gui.add_html("")
    gui.add_html(markup.framed(robot_tables.link_table(page.robot)))
    choice = page.link_choice
    page.session.on_change(
        choice, lambda: _select_link(page, "" if choice.value == NO_LINK else choice.value)
    )


def _check_robot(page: RobotPage) -> None:
    """Show the findings of the checks, and build the self-collision checker."""
    session, redact = page.session, page.session.files.redact
    with session.activity("checking"):
        findings = list(check(page.robot, tool_required=has_tool(page.robot)))
        if ":" not in page.uri and (folder := session.files.path(page.uri)).is_dir():
            findings += file_findings(folder) if (folder / CARD).is_file() else ()
        session.enqueue(lambda: _show_findings(page, findings))
        page.texts["findings"].content = markup.framed(markup.findings_table(findings, redact))
    try:
        page.checker = SelfCollisionChecker(page.robot)
    except MorphgenError as error:
        text = f"collisions cannot be tested: {escape(redact(error))}"
        page.texts["collisions"].content = markup.framed(markup.dim(text))
        return
    session.enqueue(lambda: update_scene(page), "move")


def _show_findings(page: RobotPage, findings: Sequence[Finding]) -> None:
    """Show the findings of the selected link on its card, and those about inertia at the boxes."""
    page.findings = tuple(findings)
    if _is_on(page, "inertia"):
        scene_overlays.show_inertia_findings(page.overlays, page.findings)
    _show_card(page)


def _add_downloads_tab(page: RobotPage) -> None:
    """Add buttons for the bundle, its files and a screenshot, and the command for the robot."""
    gui, session = page.session.client.gui, page.session
    dark = session.dark
    downloads: tuple[tuple[str, Callable[[], object]], ...] = (
        ("Bundle (.zip)", lambda: _send_bundle(page, with_page=with_page.value)),
        ("URDF", lambda: _send_file(page, URDF, ".urdf")),
        ("MJCF", lambda: _send_file(page, MJCF, ".xml")),
        ("Screenshot", lambda: _send_screenshot(page)),
        ("Web page (.html)", lambda: _send_made(page, ".html", robot_page, dark)),
        ("Turntable (.mp4)", lambda: _send_made(page, ".mp4", scene_robot.turntable, ".mp4")),
        ("Turntable (.gif)", lambda: _send_made(page, ".gif", scene_robot.turntable, ".gif")),
    )
    hint = "adds robot.html, which shows the robot in 3D without a server or a network"
    with_page = gui.add_checkbox("bundle with a web page", initial_value=False, hint=hint)
    for label, send in downloads:
        button = gui.add_button(label, icon=viser.Icon.DOWNLOAD)
        session.on_press(button, send)
    gui.add_html(markup.framed(markup.command(_command(page))))


def _command(page: RobotPage) -> str:
    """Return the command that makes or shows the robot, and its derivation as a comment."""
    if page.uri.startswith(WORDS):
        return shlex.join(["morphgen", "compose", *page.uri.removeprefix(WORDS).split()])
    derivation = page.robot.provenance.get("derivation")
    comment = f"# {derivation}" if derivation else ""
    if ":" not in page.uri:
        return f"morphgen show {shlex.quote(page.uri)}\n{comment}".rstrip()
    if page.uri.startswith(UPLOAD):
        return f"# for the file that you uploaded: morphgen show FILE\n{comment}".rstrip()
    return comment


def _send_made(page: RobotPage, suffix: str, make: Callable[..., bytes], option: object) -> None:
    """Send a file that a worker makes of the robot."""
    with page.session.activity(f"making the {suffix}"):
        _send(page, suffix, page.session.run_in_worker(make, page.robot, option))


def _send_bundle(page: RobotPage, *, with_page: bool) -> None:
    session = page.session
    with session.activity("packing the bundle"):
        files = session.run_in_worker(bundle_files, page.uri, session.files)
        if with_page:
            files[WEB_PAGE] = session.run_in_worker(robot_page, page.robot, session.dark)
        _send(page, ".zip", zip_files(page.robot.name or "robot", files))


def _send_file(page: RobotPage, file: str, suffix: str) -> None:
    files = page.session.run_in_worker(bundle_files, page.uri, page.session.files)
    _send(page, suffix, files[file])


def _send_screenshot(page: RobotPage) -> None:
    client = page.session.client
    height, width = client.camera.image_height, client.camera.image_width
    try:
        image = client.get_render(height, width, transport_format="png", timeout=RENDER_TIMEOUT)
    except (OSError, ValueError, RuntimeError, TimeoutError) as error:
        raise MorphgenError(f"the browser sent no picture: {error}") from error
    content = io.BytesIO()
    Image.fromarray(image).save(content, "PNG")
    _send(page, ".png", content.getvalue())


def _send(page: RobotPage, suffix: str, content: bytes) -> None:
    """Send a file to the browser, named after the robot."""
    page.session.send_file(f"{page.robot.name or 'robot'}{suffix}", content)
