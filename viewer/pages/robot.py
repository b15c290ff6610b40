"""The page of a robot: move it, show its layers, links and findings, download it."""

from __future__ import annotations

import io
import shlex
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from PIL import Image

from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import CARD, MJCF, URDF, file_findings, split_colours
from morphgen.model.findings import Finding
from morphgen.model.kinematics import arm_reach
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.viewer import markup, robot_tables
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.app.web_page import robot_page
from morphgen.viewer.pages.robot_show import (
    NO_LINK,
    RobotPage,
    add_move_tab,
    add_toggles,
    connect_links,
    keep_state,
    select_link,
    set_findings,
    show_card,
    update_scene,
)
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
)
from morphgen.viewer.scene import robot as scene_robot
from morphgen.viewer.scene import stage as scene_stage
from morphgen.viewer.scene.overlays import Overlays
from morphgen.viewer.scene.robot import turntable

WEB_PAGE = "robot.html"
"""Name of the web page in a bundle."""
PANEL_WIDTH = 390.0
"""Width of the panel [pixels]."""
RENDER_TIMEOUT = 60.0
"""Time in which the browser has to send a screenshot [s]."""


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
        add_move_tab(page)
    with tabs.add_tab("Show", viser.Icon.EYE):
        add_toggles(page)
    with tabs.add_tab("Links", viser.Icon.BINARY_TREE):
        _add_links_tab(page)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.texts["findings"] = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        _add_downloads_tab(page)
    session.set_status("")
    connect_links(page)
    session.title = robot.name
    keep_state(page)
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
        choice, lambda: select_link(page, "" if choice.value == NO_LINK else choice.value)
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


def _show_findings(page: RobotPage, findings: list[Finding]) -> None:
    set_findings(page, findings)
    show_card(page)


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
        ("Turntable (.mp4)", lambda: _send_made(page, ".mp4", turntable, ".mp4")),
        ("Turntable (.gif)", lambda: _send_made(page, ".gif", turntable, ".gif")),
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
