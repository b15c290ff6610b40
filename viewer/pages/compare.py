"""The page that compares robots side by side: joints and similarity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np
import viser

from morphgen.encoding.similarity import MEASURES, features, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import controls, markup
from morphgen.viewer.app.address import MAX_COMPARED, Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.robot_uri import UriError, read_robot_uri, uri_name, with_library_meshes
from morphgen.viewer.scene import robot as scene_robot
from morphgen.viewer.scene import stage as scene_stage

PANEL_WIDTH = 520.0  # width of the panel [pixels]
EMPTY = (
    "<h2>Compare two to four robots</h2>Pick them here, or tick the box of cards in a gallery and "
    "press <i>compare</i> below."
)
ONE_ROBOT = "Add a second robot to see how similar they are."
GAP = 0.35  # distance between the bounding boxes of two robots [m]
_CAMERA_DIRECTION = (0.74, 0.09, 0.28)  # robots along y are seen from left to right


@dataclass(eq=False)
class ComparePage:
    """Robots in one browser."""

    session: Session
    uris: tuple[str, ...]
    robots: list[Robot]
    views: list[scene_robot.RobotView]
    sliders: controls.RoleSliders = field(init=False)
    similarity: viser.GuiHtmlHandle = field(init=False)


def show(session: Session) -> None:
    """Build the page."""
    uris = tuple(filter(None, session.address.subjects))
    if len(uris) > MAX_COMPARED:
        raise UriError(f"{len(uris)} robots to compare: expected 2 to {MAX_COMPARED}")
    header = markup.breadcrumbs(("compare", None))
    if not uris:
        session.open_panel(PANEL_WIDTH, header)
        session.client.gui.add_html(markup.framed(EMPTY))
        _add_picker(session, uris)
        session.show_address("compare")
        return
    session.open_panel(PANEL_WIDTH, header, f"reading {len(uris)} robots")
    robots = [split_colours(read_robot_uri(uri, session.files)) for uri in uris]
    page = ComparePage(session, uris, robots, _add_robots(session, robots))
    gui = session.client.gui
    tabs = gui.add_tab_group()
    with tabs.add_tab("Robots", viser.Icon.ROBOT):
        _add_robots_tab(page)
    with tabs.add_tab("Move", viser.Icon.ARROWS_MOVE):
        _add_move_tab(page)
    session.set_status("")
    session.title = "compare " + ", ".join(robot.name for robot in robots)
    session.apply_state()
    _move(page)
    session.show_state()
    session.run_in_background(lambda: _compare(page))


def _add_robots(session: Session, robots: Sequence[Robot]) -> list[scene_robot.RobotView]:
    """Draw robots in a row along y, the first at the left as the camera sees it."""
    scene = session.client.scene
    views, corners, edge = [], [], 0.0
    for i, robot in enumerate(robots):
        low, high = scene_robot.robot_bounds(robot)
        y = edge - float(low[1])
        edge = y + float(high[1]) + GAP
        views.append(scene_robot.add_robot(scene, robot, f"/robot{i}", (0.0, y, 0.0)))
        above = (0.0, y, float(high[2]) + 0.12)
        scene.add_label(f"/label{i}", robot.name, position=above, anchor="bottom-center")
        corners += [corner + np.array([0.0, y, 0.0]) for corner in (low, high)]
    lowest, highest = np.min(corners, axis=0), np.max(corners, axis=0)
    scene_stage.add_ground(scene, float(np.linalg.norm(highest - lowest)))
    scene_stage.look_at(session.client, lowest, highest, _CAMERA_DIRECTION)
    return views


def _add_robots_tab(page: ComparePage) -> None:
    """Add a table of the robots with links that remove one, and controls that add one."""
    gui = page.session.client.gui
    rows = [
        (
            markup.link(Address("robot", (uri,)), robot.name or uri_name(uri)),
            str(len(robot.links)),
            str(robot.dof),
            f"{robot.mass:.3g}",
            markup.choose_box(uri),
            markup.link(Address("compare", _without(page.uris, i)), "remove"),
        )
        for i, (uri, robot) in enumerate(zip(page.uris, page.robots, strict=True))
    ]
    header = ("robot", "links", "DoF", "kg", "choose", "")
    gui.add_html(markup.framed(markup.table(header, rows, (1, 2, 3))))
    if len(page.uris) < MAX_COMPARED:
        _add_picker(page.session, page.uris)
    page.similarity = gui.add_html("")


def _without(uris: tuple[str, ...], i: int) -> tuple[str, ...]:
    return (*uris[:i], *uris[i + 1 :]) or ("",)


def _add_picker(session: Session, uris: tuple[str, ...]) -> None:
    lists = controls.robot_lists(uris[0] if uris else "", session.files, {})
    with session.client.gui.add_folder("Add a robot"):
        picker = controls.RobotPicker(session, lists, lambda: uris[0] if uris else "")
        button = session.client.gui.add_button("Add", icon=viser.Icon.PLUS)

    def add() -> None:
        session.open_address(Address("compare", (*uris, picker.picked_uri())))

    session.on_change(picker.robot, add)
    session.on_change(button, add)


def _add_move_tab(page: ComparePage) -> None:
    """Add a slider for each role of joints, and buttons that move all of them."""
    session = page.session
    buttons = session.client.gui.add_button_group("Go to", ("home", "middle"))
    sliders = page.sliders = controls.RoleSliders(session, -1.0, lambda: _move(page))
    roles = controls.all_roles(page.robots)

    def go_to_target() -> None:
        sliders.set({} if buttons.value == "home" else dict.fromkeys(roles, 0.0))

    session.on_change(buttons, go_to_target)
    for role in roles:
        names = ", ".join(
            robot.name for robot in page.robots if role in controls.joint_roles(robot)
        )
        hint = f"-1 is the lower limit, 1 the upper; of {names}"
        sliders.add(role, _home_value(page, role), hint)


def _home_value(page: ComparePage, role: str) -> float:
    """Return a role's normalized home position of the first robot that has the role."""
    robot = next(robot for robot in page.robots if role in controls.joint_roles(robot))
    home = controls.normalized_positions(robot, np.array(robot.home))
    return float(np.clip(home[controls.joint_roles(robot).index(role)], -1, 1))


def _move(page: ComparePage) -> None:
    """Move every robot: moved roles to their positions, other joints to their home."""
    with page.session.client.atomic():
        for robot, view in zip(page.robots, page.views, strict=True):
            q = controls.with_roles(robot, np.array(robot.home), page.sliders.moved)
            view.set_configuration(q)
    page.session.show_state_later()


def _compare(page: ComparePage) -> None:
    """Show how similar the robots are, or why they cannot be compared."""
    session, names = page.session, [robot.name for robot in page.robots]
    if len(names) == 1:
        page.similarity.content = markup.framed(markup.dim(ONE_ROBOT))
        return
    try:
        folders = session.files.library_folders
        with session.activity("comparing"):
            similarity = session.workers.call(compare_robots, page.robots, folders)
        content = f"<h3>Similarity</h3>{similarity_table(names, similarity)}"
    except MorphgenError as error:
        tag = markup.tag("cannot be compared", "warning")
        content = f"{tag}{escape(session.files.redact(error))}"
    page.similarity.content = markup.framed(content)


def compare_robots(robots: Sequence[Robot], folders: Sequence[Path]) -> dict[str, Array]:
    """Return the similarity of every pair by measure, shape (n, n). Runs in a worker."""
    library = Library(folders)
    shapes = [token_shapes(with_library_meshes(robot, library), folders) for robot in robots]
    # Splits fix the number of links; here the largest robot does.
    max_links = default_max_links(len(robot.links) for robot in robots)
    compared = [
        features(robot, shape, max_links=max_links)
        for robot, shape in zip(robots, shapes, strict=True)
    ]
    return {name: similarity_matrix(compared, name) for name in MEASURES}


def similarity_table(names: Sequence[str], similarity: Mapping[str, Array]) -> str:
    """Return a table with a row for each pair of robots and a column for each measure."""
    header = [""]
    for name, measure in MEASURES.items():
        direction = "larger" if measure.larger_is_more_alike else "smaller"
        header.append(f"{name} ({direction} is more similar)")
    rows = [
        (
            f"{escape(names[i])} and {escape(names[j])}",
            *(f"{similarity[name][i, j]:.3f}" for name in MEASURES),
        )
        for i, j in combinations(range(len(names)), 2)
    ]
    return markup.table(header, rows, range(1, len(header)))
