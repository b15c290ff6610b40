"""The page of a robot: move it, show its layers, links and findings, download it."""

from __future__ import annotations

import functools
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any, Literal

import numpy as np
import viser

from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import CARD, MJCF, URDF, file_findings, split_colours
from morphgen.model import kinematics
from morphgen.model.findings import Finding
from morphgen.model.geometry import Pose, Shape
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer import markup, robot_uri
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session, bind, set_value
from morphgen.viewer.robot_files import bundle_files, robot_page, turntable, zip_files
from morphgen.viewer.scene import robot as scene_robot
from morphgen.viewer.scene import stage as scene_stage

PANEL_WIDTH = 390.0  # width of the panel [pixels]
NO_LINK = "(none)"  # choice of the dropdown of links that selects none
ANGLES: Mapping[str, float] = {"rad": 1.0, "deg": 180 / math.pi}  # number per radian


def show(session: Session) -> None:
    """Build the page of the robot that the address names."""
    uri = session.address.subject
    session.open_panel(PANEL_WIDTH, _location(uri), f"reading {robot_uri.uri_name(uri)}")
    page = RobotPage(session, uri, split_colours(robot_uri.read_robot_uri(uri, session.files)))
    session.set_status("")
    session.run_in_background(page.check)


def _location(uri: str) -> str:
    """Return breadcrumbs to the robot's set or split."""
    steps: list[tuple[str, Address | None]] = []
    if split := robot_uri.member_split(uri):
        steps.append((split, Address("split", (split,))))
    elif folder := robot_uri.parent_folder(uri):
        steps.append((folder, Address("gallery", (folder,))))
    return markup.breadcrumbs(*steps, (robot_uri.uri_name(uri), None))


def _links(robot: Robot, uri: str) -> str:
    links = [markup.choose_box(uri, "choose")]
    if robot.provenance.get("derivation"):
        target = Address("compose", (uri.removeprefix(robot_uri.WORDS),))
        links.append(markup.link(target, "Edit in Compose"))
    if robot.tool and robot.dof:
        play = (markup.link(Address("play", (task,), robots=(uri,)), task) for task in TASKS)
        links.append(f"see it {' · '.join(play)}")
    reasons = [] if robot.provenance.get("derivation") else ["Compose: it is not made of parts"]
    if robot.tool is None:
        reasons.append(f"{' and '.join(TASKS)}: no link has the name {TOOL}")
    elif not robot.dof:
        reasons.append(f"{' and '.join(TASKS)}: no joint moves")
    return f"<br>{' · '.join(links)}" + "".join(f"<br>no {escape(each)}" for each in reasons)


class RobotPage:
    """The page of a robot in one browser."""

    def __init__(self, session: Session, uri: str, robot: Robot) -> None:
        """Draw the robot, add the controls, and take over what the address has."""
        self.session, self.uri, self.robot = session, uri, robot
        scene, gui = session.client.scene, session.client.gui
        low, high = scene_robot.robot_bounds(robot)
        scene_stage.add_ground(scene, float(np.linalg.norm(high - low)))
        scene_stage.look_at(session.client, low, high)
        self.view = scene_robot.add_robot(scene, robot, "/robot")
        self.q: Array = np.array(robot.home)  # independent joint positions (dof,) [rad or m]
        self.findings: tuple[Finding, ...] = ()  # findings of the checks, once they are there
        self._checker: SelfCollisionChecker | None = None
        self._sliders: list[viser.GuiSliderHandle[float]] = []  # in the order of q
        self._folders: list[viser.GuiFolderHandle] = []  # folders of the sliders
        gui.add_html(markup.summary(robot, _links(robot, uri)))
        self._card = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Move", viser.Icon.ARROWS_MOVE):
            buttons = gui.add_button_group("Go to", ("home", "zero", "random"))
            kinds = (robot.joints[k].kind for k in robot.independent_joints)
            visible = any(kind != "prismatic" for kind in kinds)
            self._angles = gui.add_dropdown("Angles in", tuple(ANGLES), visible=visible)
            self._collisions = gui.add_html("")
            self._slider_box = gui.add_folder(None)
        with tabs.add_tab("Show", viser.Icon.EYE):
            self._layers = Layers(self)
        with tabs.add_tab("Links", viser.Icon.BINARY_TREE):
            names = (NO_LINK, *(link.name for link in robot.links))
            self._link = gui.add_dropdown("Link", names)
            gui.add_html(markup.framed(markup.link_table(robot)))
        with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
            self._findings = gui.add_html("")
        with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
            _add_downloads(self)
        session.on_change(buttons, lambda: self._go_to(buttons.value))
        session.on_change(self._angles, self._add_sliders)
        session.on_change(self._link, lambda: self.select(self.selected))
        self._connect_links()
        session.title = robot.name
        bind(session, "angles", self._angles)
        bind(session, "link", self._link)
        session.keep("q", self._write_joints, self._apply_joints)
        session.apply_state()
        self._add_sliders()
        self._layers.show()
        self.select(self.selected)
        self.update_scene()

    @property
    def selected(self) -> str:
        """Name of the selected link; empty if none is."""
        return "" if self._link.value == NO_LINK else self._link.value

    def _write_joints(self) -> str:
        return "" if np.allclose(self.q, self.robot.home) else format_joints(self.q)

    def _apply_joints(self, text: str) -> None:
        if (q := parse_joints(text, self.robot)) is not None:
            self.q = q

    def move(self, q: Array) -> None:
        """Move the robot and its sliders to a configuration, shape (dof,)."""
        self.q = np.array(q, dtype=np.float64)
        for row, slider in enumerate(self._sliders):
            value = markup.rounded(self.q[row] * self._scale(row), slider.step)
            set_value(slider, float(np.clip(value, slider.min, slider.max)))
        self.update_scene()

    def update_scene(self) -> None:
        """Draw the robot and its overlays at the current configuration."""
        with self.session.client.atomic():
            self.view.set_configuration(self.q)
            if self._checker is not None:
                (collisions,) = self._checker.penetrations([self.q])
                self.view.paint_red({name for pair in collisions for name in pair})
                text = markup.collision_text(collisions)
                self._collisions.content = markup.framed(text)
            self._layers.follow()
        self.session.show_state_later()

    def _scale(self, row: int) -> float:
        joint = self.robot.joints[self.robot.independent_joints[row]]
        return 1.0 if joint.kind == "prismatic" else ANGLES[self._angles.value]

    def _add_sliders(self) -> None:
        """Add a slider for each joint by part, in the page's unit, in place of earlier ones."""
        gui, session, robot = self.session.client.gui, self.session, self.robot
        for folder in self._folders:
            folder.remove()
        self._folders = []
        sliders, limits = {}, kinematics.joint_limits(robot)
        for label, title, rows in markup.joint_groups(robot):
            with self._slider_box:
                self._folders.append(folder := gui.add_folder(title))
            for row in rows:
                joint, scale = robot.joints[robot.independent_joints[row]], self._scale(row)
                low, high = (float(value) * scale for value in limits[row])
                step = markup.slider_step(low, high)
                value = markup.rounded(float(self.q[row]) * scale, step)
                with folder:
                    sliders[row] = gui.add_slider(
                        joint.name.removeprefix(f"{label}_"),
                        low,
                        max(high, low + 1e-9),  # viser rejects an empty range
                        step,
                        float(np.clip(value, low, high)),
                        marks=tuple((value, f"{value:.3g}") for value in (low, high)),
                    )
                session.on_change(sliders[row], functools.partial(self._slide, row), f"move {row}")
        self._sliders = [sliders[row] for row in range(robot.dof)]
        session.show_state_later()

    def _slide(self, row: int) -> None:
        """Apply a slider that the user moved; other joints keep their exact, unrounded position."""
        self.q[row] = self._sliders[row].value / self._scale(row)
        self.update_scene()

    def _go_to(self, target: str) -> None:
        robot = self.robot
        if target == "random":
            (q,) = kinematics.random_configurations(robot, 1, np.random.default_rng())
        else:
            q = np.array(robot.home) if target == "home" else np.zeros(robot.dof)
        self.move(np.clip(q, *kinematics.joint_limits(robot).T))

    def select(self, name: str) -> None:
        """Select a link, which gets an outline and a card; an empty name selects none."""
        set_value(self._link, name or NO_LINK)
        scene_robot.show_outline(self.view, self.robot.link_index[name] if name else None)
        self._show_card()
        self.session.show_state()

    def _show_card(self) -> None:
        card = ""
        if name := self.selected:
            text = markup.link_card(self.robot, name, self.findings)
            card = f'<div class="selected">{text}</div>'
        self._card.content = markup.framed(card)

    def _connect_links(self) -> None:
        """Let clicks in the scene select links."""
        for link, frame in enumerate(self.view.links):
            frame.on_click(functools.partial(self._clicked, self.robot.links[link].name))

    async def _clicked(self, name: str, event: viser.SceneNodePointerEvent[Any]) -> None:
        del event
        self.session.enqueue(lambda: self.select("" if name == self.selected else name))

    def check(self) -> None:
        """Show the findings of the checks, and build the self-collision checker."""
        session, redact = self.session, self.session.files.redact
        with session.activity("checking"):
            findings = list(check(self.robot, tool_required=self.robot.tool is not None))
            if ":" not in self.uri and (folder := session.files.path(self.uri)).is_dir():
                findings += file_findings(folder) if (folder / CARD).is_file() else ()
            session.enqueue(lambda: self._show_findings(findings))
        try:
            self._checker = SelfCollisionChecker(self.robot)
        except MorphgenError as error:
            text = f"collisions cannot be tested: {escape(redact(error))}"
            self._collisions.content = markup.framed(markup.dim(text))
            return
        session.enqueue(self.update_scene, "move")

    def _show_findings(self, findings: Sequence[Finding]) -> None:
        """Show the findings on their tab and the selected link's card."""
        self.findings = tuple(findings)
        table = markup.findings_table(findings, self.session.files.redact)
        self._findings.content = markup.framed(table)
        self._show_card()


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
    return np.asarray(np.clip(q, *kinematics.joint_limits(robot).T))


GIZMO = "drag the tool"
_SHOW_OVERLAY: Mapping[str, Callable[[scene_robot.RobotView], None]] = {
    "joint axes": scene_robot.show_joint_axes,
    "names": scene_robot.show_names,
}
TOGGLES = (*scene_robot.LAYERS, "x-ray", "frames", *_SHOW_OVERLAY, "workspace", GIZMO)
"""Layers, overlays and gizmo that can be shown of a robot, as named in the address."""
TOOL_TOGGLES = ("workspace", GIZMO)  # toggles for robots with a tool only
_XRAY_OPACITY = 0.2  # opacity of visual shapes in the x-ray view
_GROWTH = 0.002
"""Distance by which collision shapes and primitives are grown while visual shapes are shown, in
extents of the robot: surfaces at the same place would flicker."""


class Layers:
    """The tab with a check box for everything that can be shown of a robot."""

    def __init__(self, page: RobotPage) -> None:
        """Add the check boxes."""
        gui, session = page.session.client.gui, page.session
        self._page, self._session, self._robot = page, session, page.robot
        self._view = page.view
        self._primitives: Sequence[Sequence[Shape]] | None = None  # by link, once they were shown
        self._gizmo: viser.TransformControlsHandle | None = None
        self._is_dragging = False
        names = [name for name in TOGGLES if page.robot.tool or name not in TOOL_TOGGLES]
        self._boxes = {name: gui.add_checkbox(name, name == "visual") for name in names}
        for name, box in self._boxes.items():
            session.on_change(box, functools.partial(self._toggle, name))
        session.keep("show", self._write, self._apply)

    def show(self) -> None:
        """Draw what the check boxes say."""
        for name, box in self._boxes.items():
            if box.value != (name == "visual"):
                self._toggle(name)

    def follow(self) -> None:
        """Draw what depends on the robot's configuration."""
        if self._gizmo is not None and not self._is_dragging:
            pose = Pose.from_matrix(kinematics.frame_pose(self._robot, self._page.q))
            self._gizmo.position, self._gizmo.wxyz = pose.position, pose.quaternion

    def _write(self) -> str:
        shown = ",".join(name for name, box in self._boxes.items() if box.value)
        return "" if shown == "visual" else shown or "none"

    def _apply(self, text: str) -> None:
        for name, box in self._boxes.items():
            set_value(box, name in text.split(","))

    def _is_on(self, name: str) -> bool:
        return name in self._boxes and self._boxes[name].value

    def _toggle(self, name: str) -> None:
        """Show or hide what a box stands for."""
        on = self._boxes[name].value
        match name:
            case "visual" | "x-ray":
                self._show_visual()
            case "collision" | "primitives":
                self._show_layer(name)
            case "inertia" if on:
                self._view.show_inertia()
            case "inertia":
                self._view.remove_layer("inertia")
            case "frames":
                self._view.show_axes(on)
            case "workspace":
                self._toggle_workspace(on)
            case "drag the tool":
                self._toggle_gizmo(on)
            case _ if not on:
                scene_robot.remove_overlay(self._view, name)
            case _:
                _SHOW_OVERLAY[name](self._view)
        self._session.show_state()

    def _has_visual(self) -> bool:
        """Return whether visual shapes are to be seen, solid or transparent."""
        return self._is_on("visual") or self._is_on("x-ray")

    def _show_visual(self) -> None:
        """Show the visual shapes as the boxes say, and the layers beside them exact or grown."""
        self._view.set_opacity(_XRAY_OPACITY if self._is_on("x-ray") else 1.0)
        self._view.set_visible("visual", self._has_visual())
        if "collision" in self._view.layers:  # else its own box draws it
            self._show_layer("collision")
        if "primitives" in self._view.layers:
            self._show_layer("primitives")

    def _show_layer(self, layer: Literal["collision", "primitives"]) -> None:
        """Draw collision shapes or primitives if they are to be seen, exact or a little grown."""
        if not self._is_on(layer):
            self._view.remove_layer(layer)
        elif layer == "primitives" and self._primitives is None:
            self._session.run_in_background(self._fit_primitives, "fit")
        else:
            shapes = self._primitives if layer == "primitives" else None
            extent = scene_robot.robot_extent(self._robot)
            self._view.show_shapes(
                layer,
                shapes or [link.collisions for link in self._robot.links],
                _GROWTH * extent if self._has_visual() else 0.0,
            )

    def _fit_primitives(self) -> None:
        """Draw the primitives fitted to the links; fits that are not stored are computed."""
        session, folders = self._session, self._session.files.library_folders
        robot = robot_uri.with_library_meshes(self._robot, session.files.library)
        with session.activity("fitting primitives, which takes a while unless they are stored"):
            fitted = session.workers.call(as_primitives, robot, folders)
        self._primitives = [link.collisions for link in fitted.links]
        session.enqueue(lambda: self._show_layer("primitives"))

    def _toggle_workspace(self, on: bool) -> None:
        """Show the workspace with the camera around it, or remove it and look at the robot."""
        if on:
            self._session.run_in_background(self._sample_workspace)
            return
        scene_robot.remove_overlay(self._view, "workspace")
        scene_stage.look_at(self._session.client, *scene_robot.robot_bounds(self._robot))

    def _sample_workspace(self) -> None:
        with self._session.activity("sampling the workspace"):
            shell = scene_robot.workspace_shell(self._robot)
        self._session.enqueue(lambda: self._show_workspace(shell))

    def _show_workspace(self, shell: scene_stage.Triangles) -> None:
        if self._is_on("workspace"):
            scene_robot.show_workspace(self._view, shell)
            bounds = (*scene_robot.robot_bounds(self._robot), *shell[0])
            low, high = np.min(bounds, axis=0), np.max(bounds, axis=0)
            scene_stage.look_at(self._session.client, low, high)

    def _toggle_gizmo(self, on: bool) -> None:
        """Add or remove a gizmo at the tool; the robot follows it by inverse kinematics."""
        if self._gizmo is not None:
            self._gizmo.remove()
            self._gizmo = None
        if not on:
            return
        pose = Pose.from_matrix(kinematics.frame_pose(self._robot, self._page.q))
        gizmo = self._gizmo = self._session.client.scene.add_transform_controls(
            "/gizmo",
            scale=0.2 * scene_robot.robot_extent(self._robot),
            depth_test=False,
            position=pose.position,
            wxyz=pose.quaternion,
        )

        async def dragged(event: viser.TransformControlsEvent) -> None:
            self._is_dragging = event.phase != "end"
            self._session.enqueue(follow, "drag")

        def follow() -> None:
            """Move the tool to the gizmo, or as near as the joint limits allow."""
            if gizmo is self._gizmo:
                w, x, y, z = (float(value) for value in gizmo.wxyz)
                px, py, pz = (float(value) for value in gizmo.position)
                T_root_gizmo = Pose((px, py, pz), (w, x, y, z)).matrix
                self._page.move(kinematics.solve_pose_ik(self._robot, T_root_gizmo, self._page.q))

        gizmo.on_update(dragged)


def _add_downloads(page: RobotPage) -> None:
    """Add buttons for the bundle, its files, pictures and films, and the robot's command."""
    gui, session, robot = page.session.client.gui, page.session, page.robot
    run, name = session.workers.call, page.robot.name or "robot"

    def bundle() -> dict[str, bytes]:
        return run(bundle_files, page.uri, session.files)

    def send(suffix: str, make: Callable[[], bytes]) -> None:
        """Send a file to the browser, named after the robot."""
        with session.activity(f"making the {suffix}"):
            session.send_file(f"{name}{suffix}", make())

    downloads: Mapping[str, tuple[str, Callable[[], bytes]]] = {
        "Bundle (.zip)": (".zip", lambda: zip_files(name, bundle())),
        "URDF": (".urdf", lambda: bundle()[URDF]),
        "MJCF": (".xml", lambda: bundle()[MJCF]),
        "Web page (.html)": (".html", lambda: run(robot_page, robot, session.dark)),
        "Turntable (.mp4)": (".mp4", lambda: run(turntable, robot, ".mp4")),
        "Turntable (.gif)": (".gif", lambda: run(turntable, robot, ".gif")),
    }
    for label, (suffix, make) in downloads.items():
        button = gui.add_button(label, icon=viser.Icon.DOWNLOAD)
        session.on_press(button, functools.partial(send, suffix, make))
    gui.add_html(markup.framed(markup.command(_command(page))))


def _command(page: RobotPage) -> str:
    """Return the command that makes or shows the robot, and its derivation as a comment."""
    if page.uri.startswith(robot_uri.WORDS):
        return shlex.join(["morphgen", "compose", *page.uri.removeprefix(robot_uri.WORDS).split()])
    derivation = page.robot.provenance.get("derivation")
    comment = f"# {derivation}" if derivation else ""
    if ":" not in page.uri:
        return f"morphgen show {shlex.quote(page.uri)}\n{comment}".rstrip()
    if page.uri.startswith(robot_uri.UPLOAD):
        return f"# for the file that you uploaded: morphgen show FILE\n{comment}".rstrip()
    return comment
