"""The page that composes robots, from chosen parts or from a grammar."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import viser

from morphgen.checks import check
from morphgen.errors import CompositionError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.grammar_file import SUFFIX
from morphgen.grammar.request import known_grammars
from morphgen.grammar.robot_set import GRAMMAR
from morphgen.model.inertia import box_corners
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.pages.compose_tabs import (
    ComposingTab,
    GrammarTab,
    ParametersTab,
    PartsTab,
    Shown,
    split_words,
    words_of,
)
from morphgen.viewer.pages.robot import PANEL_WIDTH, summary
from morphgen.viewer.robot_files import new_bundle_files, zip_files
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    DERIVATION,
    MEMBER,
    UPLOAD,
    FileAccess,
    UriError,
    parent_folder,
    read_robot_uri,
    resolve_derivation,
    shorten,
)
from morphgen.viewer.scene.robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene.stage import (
    CAMERA_DIRECTION,
    add_ground,
    camera_view,
    look_at,
    project_points,
)

ROBOTS = "robots"  # folder in which bundles are written
DEFAULT_GRAMMAR = "arm3"


def show(session: Session) -> None:
    """Build the page."""
    files, subject = session.files, session.address.subject.strip() or DEFAULT_WORDS
    derivation, name = subject_derivation(subject, files), subject.split()[0]
    is_grammar = derivation is None and "=" not in name  # the subject is a grammar's name
    text = DEFAULT_WORDS if is_grammar else subject
    words = words_of(derivation, files.library) if derivation else split_words(text)
    session.open_panel(PANEL_WIDTH + 30, markup.breadcrumbs(("compose", None)))
    page = ComposePage(session)
    tabs = session.client.gui.add_tab_group()
    source = name if is_grammar else set_grammar(subject, files) if derivation else DEFAULT_GRAMMAR
    add_grammar = functools.partial(GrammarTab, session, tabs, source, page.show)
    add_parts: Callable[[], ComposingTab]
    if derivation and words is None:
        add_parts = functools.partial(ParametersTab, session, tabs, derivation, page.show)
    else:
        add_parts = functools.partial(PartsTab, session, tabs, words or {}, page.show)
    # The tab that the address asks for comes first.
    order = (add_grammar, add_parts) if is_grammar else (add_parts, add_grammar)
    first, _ = [add_tab() for add_tab in order]
    page.add_tabs(tabs)
    session.apply_state()
    first.show()


def set_grammar(subject: str, files: FileAccess) -> str:
    """Return the file of the grammar that gave a robot of a set, or else the default grammar."""
    folder = parent_folder(subject)
    is_in_set = bool(folder) and (files.path(folder) / GRAMMAR).is_file()
    return f"{folder}/{GRAMMAR}" if is_in_set else DEFAULT_GRAMMAR


def subject_derivation(subject: str, files: FileAccess) -> Derivation | None:
    """Return the derivation of the robot that an address names by its URI; None for words."""
    if subject.startswith((DERIVATION, MEMBER)):
        return resolve_derivation(subject, files)
    first = subject.split()[0]
    is_path = subject.startswith(UPLOAD) or ("=" not in first and not first.endswith(SUFFIX))
    if not is_path or first in known_grammars(files.library):
        return None
    if not subject.startswith(UPLOAD) and "/" not in subject and not _exists(subject, files):
        return None  # the name of a grammar that does not exist
    text = read_robot_uri(subject, files).provenance.get("derivation")
    if not text:
        raise UriError(f"{shorten(subject)} was imported: only composed robots can be edited")
    return parse_derivation(str(text))


def _exists(subject: str, files: FileAccess) -> bool:
    try:
        files.path(subject)
    except UriError:
        return False
    return True


class ComposePage:
    """The composed robot in one browser, and the texts about it."""

    def __init__(self, session: Session) -> None:
        """Prepare the scene and the text above the tabs."""
        self.shown: Shown | None = None
        self._session, self._view = session, ComposeView(session)
        self._summary = session.client.gui.add_html("")
        self._findings: viser.GuiHtmlHandle
        self._command: viser.GuiHtmlHandle

    def add_tabs(self, tabs: viser.GuiTabGroupHandle) -> None:
        """Add the tabs of all robots: findings, and files to write or download."""
        gui, session = self._session.client.gui, self._session
        with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
            self._findings = gui.add_html("")
        with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
            name = gui.add_text("name", "", hint="by default from its parts")
            write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
            download = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
            self._command = gui.add_html("")
        session.on_press(write, lambda: self._write_bundle(name.value))
        session.on_press(download, lambda: self._send_bundle(name.value))

    def show(self, shown: Shown) -> None:
        """Show a robot in place of the previous one, and check it in the background."""
        session, self.shown = self._session, shown
        change = self._view.replace_robot(shown.robot)
        self._summary.content = summary(
            shown.robot,
            f" · {markup.link(Address('robot', (shown.uri,)), 'open its page')} · "
            + markup.choose_box(shown.uri, "choose")
            + (f"<br>changed: {escape(change)}" if change else ""),
        )
        self._command.content = markup.framed(
            markup.command(shown.command), "<h3>Derivation</h3>", markup.code(str(shown.derivation))
        )
        session.address = replace(session.address, subjects=(shown.subject,))
        session.title = f"compose {shown.robot.name}"
        session.show_state()
        session.run_in_background(self._check, "check")

    def _check(self) -> None:
        """Check the current robot, and show the findings unless another robot has replaced it."""
        if (shown := self.shown) is not None:
            findings = check(shown.robot, tool_required=has_tool(shown.robot))
            if shown is self.shown:
                table = markup.findings_table(findings, self._session.files.redact)
                self._findings.content = markup.framed(table)

    def _named_robot(self, name: str) -> Robot:
        """Return the robot that the page shows under a name, by default its own."""
        if self.shown is None:
            raise CompositionError("no robot is shown: choose parts that fit, or draw one")
        robot = self.shown.robot
        return replace(robot, name=name or robot.name or "robot")

    def _write_bundle(self, name: str) -> None:
        """Write the robot's bundle with findings and picture below ``robots/``."""
        session, robot = self._session, self._named_robot(name)
        folder = bundle_folder(session.files.roots[0] / ROBOTS, robot.name)
        target = str(folder.relative_to(session.files.roots[0]))
        with session.activity(f"writing {target}"):
            session.run_in_worker(_write_checked, robot, folder)
        session.notify("Written", target)

    def _send_bundle(self, name: str) -> None:
        """Send a zip of the robot's bundle to the browser."""
        session, robot = self._session, self._named_robot(name)
        folder = bundle_folder(Path(), robot.name).name  # validates the name
        with session.activity("packing the bundle"):
            files = session.run_in_worker(new_bundle_files, robot)
            session.send_file(f"{folder}.zip", zip_files(folder, files))


def _write_checked(robot: Robot, folder: Path) -> None:
    """Write a bundle with findings and picture. Runs in a worker, which may use OpenGL."""
    write_bundle(robot, folder, check(robot))


GHOST_OPACITY = 0.16  # opacity of the previous robot
GESTURE_TIME = 1.0  # changes that follow each other faster, as of a slider, count as one [s]
_EDGE = 0.02  # share of the picture at its edges into which a robot may not reach


class ComposeView:
    """The robot in the scene of one browser, and the ghost of the one before."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._shown: RobotView | None = None
        self._ghost: RobotView | None = None
        self._changed_at = -np.inf  # time of the last change by `time.monotonic` [s]
        self._count = 0  # number of robots shown so far; names the nodes of the scene

    def replace_robot(self, robot: Robot) -> str:
        """Show a robot; the one before becomes the ghost, unless both belong to one gesture.

        Return what changed from the ghost to the robot; an empty text if there is no ghost.
        """
        client, previous, robot = self._session.client, self._shown, split_colours(robot)
        is_gesture = time.monotonic() - self._changed_at < GESTURE_TIME
        with client.atomic():
            self._count += 1
            self._shown = add_robot(client.scene, robot, f"/robot{self._count}")
            if previous is not None and is_gesture and self._ghost is not None:
                previous.base.remove()
            elif previous is not None:
                if self._ghost is not None:
                    self._ghost.base.remove()
                self._ghost = previous
                previous.set_opacity(GHOST_OPACITY)
                previous.cast_no_shadow()
        low, high = robot_bounds(robot)
        add_ground(client.scene, float(np.linalg.norm(high - low)))
        if previous is None:
            look_at(client, low, high)
        elif not self._is_in_picture(low, high):
            x, y, z = (client.camera.position - client.camera.look_at).tolist()
            look_at(client, low, high, (x, y, z) if np.hypot(x, y) > 1e-6 else CAMERA_DIRECTION)
        self._changed_at = time.monotonic()
        return change_text(self._ghost.robot, robot) if self._ghost else ""

    def _is_in_picture(self, low: Array, high: Array) -> bool:
        """Return whether the camera sees all corners of a box."""
        picture = camera_view(self._session.client)
        points, depths = project_points(picture, box_corners(low, high))
        shares = points / (picture.aspect, 1.0)
        return bool((depths > 0).all() and (abs(shares - 0.5) <= 0.5 - _EDGE).all())


def change_text(before: Robot, after: Robot) -> str:
    """Return what differs between two robots, such as ``reach 1.08 to 1.68 m, mass +0.24 kg``."""
    parts = []
    if before.dof != after.dof:
        parts.append(f"{before.dof} to {after.dof} DoF")
    if all(has_tool(robot) and robot.dof for robot in (before, after)):
        old, new = (f"{arm_reach(robot):.2f}" for robot in (before, after))
        if old != new:
            parts.append(f"reach {old} to {new} m")
    if abs(difference := after.mass - before.mass) >= 0.005:
        parts.append(f"mass {difference:+.2f} kg")
    return ", ".join(parts)
