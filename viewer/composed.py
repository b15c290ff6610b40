"""The robot that the compose page shows, what is said of it, and how to get it."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path

import viser

from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import bundle_folder, split_colours, write_bundle
from morphgen.grammar.derivation import Derivation
from morphgen.model.kinematics import reach
from morphgen.model.robot import Robot
from morphgen.viewer import markup, robot_tables
from morphgen.viewer.address import Address
from morphgen.viewer.downloads import robot_files, zipped
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.scene_overlays import has_tool
from morphgen.viewer.scene_robot import RobotView, add_robot, look_at, robot_bounds
from morphgen.viewer.session import Session, in_worker, later, notify, say, when

ROBOTS = "robots"
"""Folder below which bundles are written."""


@dataclass(eq=False)
class Composed:
    """The robot in one browser, and where its texts stand."""

    session: Session
    summary: viser.GuiHtmlHandle
    findings: viser.GuiHtmlHandle | None = None
    command: viser.GuiHtmlHandle | None = None
    robot: Robot | None = None
    view: RobotView | None = None


def add_check_tab(composed: Composed, tabs: viser.GuiTabGroupHandle) -> None:
    """Add what the checks find."""
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        composed.findings = composed.session.client.gui.add_html("")


def add_get_tab(composed: Composed, tabs: viser.GuiTabGroupHandle) -> None:
    """Add how to write, download or repeat the robot."""
    gui, session = composed.session.client.gui, composed.session
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        name = gui.add_text("name", "", hint="by default from its parts")
        write = gui.add_button(f"Write to {ROBOTS}/", icon=viser.Icon.DEVICE_FLOPPY)
        pack = gui.add_button("Bundle (.zip)", icon=viser.Icon.DOWNLOAD)
        composed.command = gui.add_html("")
    when(write, session, lambda: later(session, lambda: _write(composed, name.value)))
    when(pack, session, lambda: later(session, lambda: _send(composed, name.value)))


def show_robot(
    composed: Composed, robot: Robot, derivation: Derivation, command: str, place: str
) -> None:
    """Show a robot in place of the last one, and have it checked.

    Args:
        composed: Where.
        robot: Which.
        derivation: What it was composed from.
        command: That gives the same on the command line.
        place: Under which its own page is.
    """
    client = composed.session.client
    robot = split_colours(robot)
    first = composed.view is None
    with client.atomic():
        if composed.view is not None:
            composed.view.base.remove()
        composed.view = add_robot(client.scene, robot, "/robot")
    composed.robot = robot
    if first:
        look_at(client, *robot_bounds(robot))
    distance = reach(robot) if has_tool(robot) and robot.dof else None
    own = markup.link(Address("robot", (place,)), "open its page")
    composed.summary.content = markup.framed(
        f"<h3>{escape(robot.name)}</h3>"
        f'<div class="dim">{robot_tables.summary(robot, distance)} · {own}</div>'
    )
    if composed.command is not None:
        composed.command.content = markup.framed(
            "<h3>The same on the command line</h3>",
            markup.code(command),
            "<h3>Derivation</h3>",
            markup.code(str(derivation)),
        )
    later(composed.session, lambda: _check(composed), "check")


def fault(error: MorphgenError, places: FileAccess) -> str:
    """Why there is no robot."""
    return markup.framed(markup.tag("error", "error"), f" {escape(places.told(error))}")


def _check(composed: Composed) -> None:
    robot = composed.robot
    if robot is None or composed.findings is None:
        return
    findings = check(robot, tool_required=has_tool(robot))
    told = composed.session.places.told
    if robot is composed.robot:
        composed.findings.content = markup.framed(markup.findings_table(findings, told))


def _write(composed: Composed, name: str) -> None:
    robot, session = composed.robot, composed.session
    if robot is None:
        return
    folder = bundle_folder(session.places.roots[0] / ROBOTS, name or robot.name)
    say(session, f"writing {ROBOTS}/{folder.name}")
    in_worker(session, _bundle, robot, folder)
    say(session, "")
    notify(session, "Written", f"{ROBOTS}/{folder.name}")


def _bundle(robot: Robot, folder: Path) -> None:
    """Write a bundle with its picture; for a worker, where drawing disturbs nobody."""
    write_bundle(robot, folder, check(robot))


def _send(composed: Composed, name: str) -> None:
    robot, session = composed.robot, composed.session
    if robot is None:
        return
    say(session, "packing the bundle")
    files = in_worker(session, robot_files, robot)
    name = bundle_folder(Path(), name or robot.name or "robot").name
    session.client.send_file_download(f"{name}.zip", zipped(name, files), save_immediately=True)
    say(session, "")
