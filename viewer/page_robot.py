"""The page of one robot: moved, looked into, and taken away."""

from __future__ import annotations

from html import escape

import numpy as np
import viser

from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import CARD, file_findings, split_colours
from morphgen.model.kinematics import joint_limits, random_configurations, reach
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer import markup, robot_tables, scene_overlays
from morphgen.viewer.address import Address
from morphgen.viewer.robot_downloads import add_downloads
from morphgen.viewer.robot_rows import neighbours
from morphgen.viewer.robot_state import (
    RobotPage,
    parse_joints,
    set_configuration,
    show_moved,
    tell_address,
)
from morphgen.viewer.robot_toggles import add_toggles, toggle
from morphgen.viewer.robot_uri import MEMBER, name_of, read_robot_uri
from morphgen.viewer.scene_overlays import Overlays
from morphgen.viewer.scene_robot import (
    add_robot,
    look_at,
    paint_red,
    robot_bounds,
)
from morphgen.viewer.session import (
    Session,
    later,
    notify,
    post,
    say,
    set_value,
    when,
)

SIDE = 390.0
"""Width of the panel, pixels."""
TRIES = 500
"""Random configurations tested for a free one."""
_NO_LINK = "(none)"


def show(session: Session) -> None:
    """Build the page of the robot that the address names.

    Raises:
        UnsoundError: If its structure is broken.
        MorphgenError: If it cannot be read.
    """
    place = session.address.subject
    gui, scene = session.client.gui, session.client.scene
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(SIDE)
    gui.add_html(markup.STYLE + _way(session, place))
    session.status = gui.add_html(markup.status(f"reading {name_of(place)}"))
    robot = split_colours(read_robot_uri(place, session.places))
    low, high = robot_bounds(robot)
    add_floor(scene, float(np.linalg.norm(high - low)))
    look_at(session.client, low, high)
    view = add_robot(scene, robot, "/robot")
    page = RobotPage(session, place, robot, view, Overlays(view), np.array(robot.home))
    distance = reach(robot) if scene_overlays.has_tool(robot) and robot.dof else None
    gui.add_html(
        markup.framed(
            f"<h3>{escape(robot.name)}</h3>"
            f'<div class="dim">{robot_tables.summary(robot, distance)}{_plays(robot, place)}</div>'
        )
    )
    tabs = gui.add_tab_group()
    with tabs.add_tab("Move", viser.Icon.ARROWS_MOVE):
        _add_moves(page)
    with tabs.add_tab("Show", viser.Icon.EYE):
        add_toggles(page)
    with tabs.add_tab("Links", viser.Icon.BINARY_TREE):
        _add_links(page)
    with tabs.add_tab("Check", viser.Icon.STETHOSCOPE):
        page.texts["findings"] = gui.add_html("")
    with tabs.add_tab("Get", viser.Icon.DOWNLOAD):
        add_downloads(page)
    say(session, "")
    _apply_address(page)
    later(session, lambda: _examine(page))


def add_floor(scene: viser.SceneApi, size: float) -> None:
    """A grid on the ground: a cell is 10 cm, a section 1 m."""
    side = max(2.0, 2.0 * round(2 * size) / 2)
    scene.add_grid("/floor", width=side, height=side, cell_size=0.1, section_size=1.0)


def free_configuration(
    tested: SelfCollisionChecker, robot: Robot, rng: np.random.Generator
) -> Array | None:
    """A random configuration without self-collision; None if none is found."""
    for _ in range(TRIES // 10):
        q = random_configurations(robot, 10, rng)
        for row, found in zip(q, tested.penetrations(q), strict=True):
            if not found:
                return np.asarray(row)
    return None


def _way(session: Session, place: str) -> str:
    """Where a robot is from, with links to the one before and after it."""
    steps: list[tuple[str, Address | None]] = []
    if place.startswith(MEMBER):
        split = place.removeprefix(MEMBER).rpartition("@")[0]
        steps.append((split, Address("split", (split,))))
    elif ":" not in place and "/" in place.rstrip("/"):
        folder = place.rstrip("/").rpartition("/")[0]
        steps.append((folder, Address("gallery", (folder,))))
    before, after = neighbours(place, session.places)
    ways = [
        markup.link(Address("robot", (other,)), text)
        for other, text in ((before, "◂ previous"), (after, "next ▸"))
        if other
    ]
    beside = f'<div class="dim">{" · ".join(ways)}</div>' if ways else ""
    return markup.crumbs(*steps, (name_of(place), None)) + markup.framed(beside)


def _plays(robot: Robot, place: str) -> str:
    """Links to the pages on which a robot does its tasks; a robot without tool has none."""
    if not (scene_overlays.has_tool(robot) and robot.dof):
        return ""
    links = (markup.link(Address("play", (task,), robots=(place,)), task) for task in TASKS)
    return f"<br>see it {' · '.join(links)}"


def _add_moves(page: RobotPage) -> None:
    gui, session, robot = page.session.client.gui, page.session, page.robot
    buttons = gui.add_button_group("Go to", ("home", "zero", "random free"))
    when(buttons, session, lambda: _go(page, buttons.value))
    page.texts["collisions"] = gui.add_html("")
    page.sliders = []
    handles: dict[int, viser.GuiSliderHandle[float]] = {}
    limits = joint_limits(robot)
    for chain in robot_tables.chains(robot):
        with gui.add_folder(chain.title):
            for row in chain.rows:
                joint = robot.joints[robot.independent_joints[row]]
                low, high = (float(value) for value in limits[row])
                handles[row] = gui.add_slider(
                    robot_tables.short_name(joint, chain),
                    low,
                    max(high, low + 1e-9),
                    robot_tables.slider_step(low, high),
                    float(np.clip(page.q[row], low, high)),
                    hint=robot_tables.joint_hint(joint),
                )
    page.sliders = [handles[row] for row in range(robot.dof)]
    page.told = [slider.value for slider in page.sliders]
    for slider in page.sliders:
        when(slider, session, lambda: _slid(page), "move")


def _add_links(page: RobotPage) -> None:
    gui, names = page.session.client.gui, [link.name for link in page.robot.links]
    chosen = gui.add_dropdown("Link", (_NO_LINK, *names))
    page.texts["link"] = gui.add_html("")
    gui.add_html(markup.framed(robot_tables.link_table(page.robot)))
    when(chosen, page.session, lambda: _choose_link(page, chosen.value))


def _slid(page: RobotPage) -> None:
    """Take over what the user moved; the others keep their exact value."""
    for k, slider in enumerate(page.sliders):
        if slider.value != page.told[k]:
            page.q[k] = page.told[k] = slider.value
    show_moved(page)


def _apply_address(page: RobotPage) -> None:
    """Bring the page into the state that its address tells."""
    state = page.session.address.state
    shown = state.get("show", "visual").split(",")
    for name, box in page.toggles.items():
        if box.value != (name in shown):
            set_value(box, name in shown)
            toggle(page, name)
    q = parse_joints(state.get("q", ""), page.robot)
    if q is not None:
        set_configuration(page, q)
    else:
        tell_address(page)


def _go(page: RobotPage, where: str) -> None:
    if where == "random free":
        if page.tested is None:
            page.tested = SelfCollisionChecker(page.robot)
        q = free_configuration(page.tested, page.robot, np.random.default_rng())
        if q is None:
            notify(
                page.session, "No free configuration", f"{TRIES} random ones collide", error=True
            )
            return
    else:
        rest = np.array(page.robot.home) if where == "home" else np.zeros(page.robot.dof)
        q = np.clip(rest, *joint_limits(page.robot).T)
    set_configuration(page, q)


def _choose_link(page: RobotPage, name: str) -> None:
    if name == _NO_LINK:
        page.texts["link"].content = ""
        paint_red(page.view, ())
        return
    page.texts["link"].content = markup.framed(robot_tables.link_details(page.robot, name))
    paint_red(page.view, (name,))


def _examine(page: RobotPage) -> None:
    """Find what is wrong with the robot, and be ready to see collisions."""
    session = page.session
    say(session, "checking")
    findings = list(check(page.robot, tool_required=scene_overlays.has_tool(page.robot)))
    if ":" not in page.place and (folder := session.places.path(page.place)).is_dir():
        findings += file_findings(folder) if (folder / CARD).is_file() else ()
    page.texts["findings"].content = markup.framed(
        markup.findings_table(findings, session.places.told)
    )
    say(session, "")
    try:
        page.tested = SelfCollisionChecker(page.robot)
    except MorphgenError as error:
        why = escape(session.places.told(error))
        text = f'<div class="dim">collisions cannot be tested: {why}</div>'
        page.texts["collisions"].content = markup.framed(text)
        return
    post(session, lambda: show_moved(page), "move")
