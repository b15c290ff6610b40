"""The page on which robots stand side by side."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np
import viser

from morphgen.benchmark.similarity import MEASURES, features
from morphgen.benchmark.tokens import MAX_LINKS, tokens
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.formats.fits import are_primitives, read_stored_fits, stored_fit
from morphgen.grammar.library import Library
from morphgen.model.geometry import Shape
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer import browser, markup
from morphgen.viewer.address import Address
from morphgen.viewer.comparison import all_roles, roles, scaled, with_roles
from morphgen.viewer.figures import tokens_png
from morphgen.viewer.page_robot import add_floor
from morphgen.viewer.robot_uri import UriError, name_of, read_robot_uri, with_library_meshes
from morphgen.viewer.scene_robot import (
    Rgb,
    RobotView,
    add_robot,
    drop_layer,
    look_at,
    move,
    paint,
    robot_bounds,
    set_visible,
    show_layer,
)
from morphgen.viewer.session import Session, in_worker, later, say, set_value, show_state, when

MOST = 4
"""Robots that are compared at once."""
SIDE = 520.0
"""Width of the panel, pixels."""
GAP = 0.35
"""Between two robots, metres."""


@dataclass(eq=False)
class ComparePage:
    """Robots in one browser."""

    session: Session
    places: tuple[str, ...]
    robots: list[Robot]
    views: list[RobotView]
    q: list[Array]
    sliders: dict[str, viser.GuiSliderHandle[float]] = field(default_factory=dict)
    touched: dict[str, float] = field(default_factory=dict)
    """Roles that the user moved: the others stay at each robot's home."""
    texts: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Likeness:
    """What comparing found."""

    tables: tuple[Array, ...]
    """Tokens at home, shape (n_links, 48) each."""
    values: dict[str, Array]
    """Likeness of every pair by measure, shape (n, n)."""


def show(session: Session) -> None:
    """Build the page.

    Raises:
        UriError: If more than ``MOST`` robots are named.
        MorphgenError: If one of them cannot be read.
    """
    places = session.address.of
    if not 1 <= len(places) <= MOST:
        raise UriError(f"{len(places)} robots to compare: expected 2 to {MOST}")
    gui = session.client.gui
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(SIDE)
    gui.add_html(markup.STYLE + markup.crumbs(("compare", None)))
    session.status = gui.add_html(markup.status(f"reading {len(places)} robots"))
    robots = [split_colours(read_robot_uri(place, session.places)) for place in places]
    views = _stand_beside(session, robots)
    page = ComparePage(session, places, robots, views, [np.array(robot.home) for robot in robots])
    tabs = gui.add_tab_group()
    with tabs.add_tab("Robots", viser.Icon.ROBOT):
        _add_choice(page)
    with tabs.add_tab("Move", viser.Icon.ARROWS_MOVE):
        _add_sliders(page)
    with tabs.add_tab("Tokens", viser.Icon.GRID_DOTS):
        page.texts["tokens"] = gui.add_html("")
    with tabs.add_tab("Primitives", viser.Icon.CUBE):
        _add_primitives(page)
    say(session, "")
    show_state(session, "compare " + ", ".join(robot.name for robot in robots))
    later(session, lambda: _compare(page))


def parse_places(text: str) -> tuple[str, ...]:
    """The places in a text, one a line."""
    return tuple(line.strip() for line in text.splitlines() if line.strip())


def fit_qualities(
    robot: Robot, folders: Sequence[Path]
) -> dict[str, tuple[float, tuple[Shape, ...]]]:
    """How well stored primitives stand for links: their IoU, and themselves, by link.

    Links whose collision shapes are primitives stand for themselves, with 1; links of which nothing
    is stored are left out.
    """
    stored = read_stored_fits(folders)
    found = {}
    for link in with_library_meshes(robot, Library(folders)).links:
        if link.collisions and are_primitives(link.collisions):
            found[link.name] = (1.0, link.collisions)
        elif link.collisions and (fit := stored_fit(link.collisions, stored)):
            found[link.name] = (fit.collision_iou, fit.collision)
    return found


def heat(iou: float) -> Rgb:
    """Red for an IoU of a half and below, yellow between, green for 1."""
    share = min(max((iou - 0.5) / 0.5, 0.0), 1.0)
    stops = np.array([(224, 49, 49), (250, 200, 30), (47, 158, 68)])
    place = 2 * share
    low = min(int(place), 1)
    red, green, blue = (stops[low] + (place - low) * (stops[low + 1] - stops[low])).astype(int)
    return (int(red), int(green), int(blue))


def likeness(robots: Sequence[Robot], folders: Sequence[Path]) -> Likeness:
    """Tokens of robots, and how alike they are; seconds where primitives must be sought.

    Raises:
        BenchmarkError: If a robot has no tool, or no joint that moves it.
        MorphgenError: If a mesh cannot be read.
    """
    shapes = [
        token_shapes(with_library_meshes(robot, Library(folders)), folders) for robot in robots
    ]
    # What is compared here has no study around it; the largest robot says what fits.
    size = max(MAX_LINKS, *(len(robot.links) for robot in robots))
    tables = tuple(
        tokens(robot, each, max_links=size) for robot, each in zip(robots, shapes, strict=True)
    )
    known = [
        features(robot, each, max_links=size) for robot, each in zip(robots, shapes, strict=True)
    ]
    values = {
        name: np.array([[measure.function(a, b) for b in known] for a in known])
        for name, measure in MEASURES.items()
    }
    return Likeness(tables, values)


def _stand_beside(session: Session, robots: Sequence[Robot]) -> list[RobotView]:
    """Draw robots in a row along y, the first at the left as the camera sees it."""
    scene = session.client.scene
    extents = [robot_bounds(robot) for robot in robots]
    views, at = [], 0.0
    corners = []
    for i, (robot, (low, high)) in enumerate(zip(robots, extents, strict=True)):
        y = at - float(low[1])
        views.append(add_robot(scene, robot, f"/robot{i}", (0.0, y, 0.0)))
        label = (0.0, y, float(high[2]) + 0.12)
        scene.add_label(f"/label{i}", robot.name, position=label, anchor="bottom-center")
        shift = np.array([0.0, y, 0.0])
        corners += [low + shift, high + shift]
        at = y + float(high[1]) + GAP
    every = np.array(corners)
    add_floor(scene, float(np.linalg.norm(every.max(axis=0) - every.min(axis=0))))
    look_at(session.client, every.min(axis=0), every.max(axis=0), (0.74, 0.09, 0.28))
    return views


def _add_choice(page: ComparePage) -> None:
    gui, session = page.session.client.gui, page.session
    text = gui.add_text(
        "a robot a line",
        "\n".join(page.places),
        multiline=True,
        hint="places as in addresses: robots/ur5-plane, words:arm=ur5 ee=plane, ...",
    )
    button = gui.add_button("Compare these", icon=viser.Icon.ARROWS_LEFT_RIGHT)

    def compare() -> None:
        browser.go_to(session.client, Address("compare", parse_places(text.value)).query)

    when(button, session, compare)
    rows = [
        (
            markup.link(Address("robot", (place,)), robot.name or name_of(place)),
            str(len(robot.links)),
            str(robot.dof),
            f"{robot.mass:.3g}",
        )
        for place, robot in zip(page.places, page.robots, strict=True)
    ]
    gui.add_html(markup.framed(markup.table(("robot", "links", "DoF", "kg"), rows, (1, 2, 3))))
    page.texts["likeness"] = gui.add_html("")


def _add_sliders(page: ComparePage) -> None:
    gui, session = page.session.client.gui, page.session
    home = gui.add_button_group("Go to", ("home", "middle"))
    when(home, session, lambda: _go(page, home.value))
    for role in all_roles(page.robots):
        having = [robot.name for robot in page.robots if role in roles(robot)]
        value = _start_of(page, role)
        slider = gui.add_slider(role, -1.0, 1.0, 0.01, value, hint="of " + ", ".join(having))
        page.sliders[role] = slider
        when(slider, session, lambda: _slid(page), "move")


def _slid(page: ComparePage) -> None:
    for role, slider in page.sliders.items():
        if role in page.touched or slider.value != _start_of(page, role):
            page.touched[role] = slider.value
    _move(page)


def _start_of(page: ComparePage, role: str) -> float:
    """What a slider showed before anything was moved: the first robot's home."""
    for robot in page.robots:
        names = roles(robot)
        if role in names:
            value = scaled(robot, np.array(robot.home))[names.index(role)]
            return float(np.clip(value, -1, 1))
    raise ValueError(f"no robot has {role}")


def _go(page: ComparePage, where: str) -> None:
    page.touched = {} if where == "home" else dict.fromkeys(page.sliders, 0.0)
    for role, slider in page.sliders.items():
        set_value(slider, page.touched.get(role, _start_of(page, role)))
    _move(page)


def _move(page: ComparePage) -> None:
    with page.session.client.atomic():
        for i, (robot, view) in enumerate(zip(page.robots, page.views, strict=True)):
            page.q[i] = with_roles(robot, np.array(robot.home), page.touched)
            move(view, page.q[i])


def _add_primitives(page: ComparePage) -> None:
    gui, session = page.session.client.gui, page.session
    box = gui.add_checkbox("primitives in place of meshes, coloured by IoU", False)
    page.texts["fits"] = gui.add_html("")
    when(box, session, lambda: later(session, lambda: _show_fits(page, on=box.value)))


def _show_fits(page: ComparePage, *, on: bool) -> None:
    """Show how well the stored primitives stand for each link."""
    parts = []
    for robot, view in zip(page.robots, page.views, strict=True):
        set_visible(view, "visual", not on)
        drop_layer(view, "primitives")
        if not on:
            continue
        found = fit_qualities(robot, page.session.places.folders)
        show_layer(view, "primitives", [found.get(link.name, (0, ()))[1] for link in robot.links])
        paint(view, "primitives", {name: heat(iou) for name, (iou, _) in found.items()})
        parts.append(f"<h3>{escape(robot.name)}</h3>" + fit_table(robot, found))
    page.texts["fits"].content = markup.framed(*parts)


def fit_table(robot: Robot, found: dict[str, tuple[float, tuple[Shape, ...]]]) -> str:
    """A row a link: how many primitives, and their IoU."""
    rows = []
    for link in robot.links:
        if not link.collisions:
            continue
        iou, shapes = found.get(link.name, (None, ()))
        if iou is None:
            rows.append((escape(link.name), "", '<span class="dim">not fitted yet</span>'))
            continue
        red, green, blue = heat(iou)
        square = f'<span style="color:rgb({red},{green},{blue})">■</span>'
        rows.append((escape(link.name), str(len(shapes)), f"{square} {iou:.2f}"))
    return markup.table(("link", "primitives", "IoU"), rows, (1, 2))


def likeness_table(names: Sequence[str], found: Likeness) -> str:
    """A row a pair of robots, a column a measure."""
    header = [""]
    for name, measure in MEASURES.items():
        header.append(
            f"{name} ({'larger' if measure.larger_is_more_alike else 'smaller'} is alike)"
        )
    rows = [
        (
            f"{escape(names[i])} and {escape(names[j])}",
            *(f"{found.values[name][i, j]:.3f}" for name in MEASURES),
        )
        for i, j in combinations(range(len(names)), 2)
    ]
    return markup.table(header, rows, (1, 2, 3))


def _compare(page: ComparePage) -> None:
    session = page.session
    names = [robot.name for robot in page.robots]
    say(session, "comparing")
    try:
        made = in_worker(session, likeness, page.robots, session.places.folders)
    except MorphgenError as error:
        page.texts["likeness"].content = markup.framed(
            markup.tag("cannot be compared", "warning"), escape(session.places.told(error))
        )
        say(session, "")
        return
    text = "<h3>How alike</h3>" + likeness_table(names, made)
    links = [[link.name for link in robot.links] for robot in page.robots]
    picture = base64.b64encode(tokens_png(names, links, made.tables)).decode()
    page.texts["likeness"].content = markup.framed(text)
    page.texts["tokens"].content = markup.framed(
        '<div class="dim">48 numbers a link at home; blue is negative, red positive; a dot marks '
        "what differs from the first robot</div>"
        f'<img alt="tokens" style="width:100%" src="data:image/png;base64,{picture}">'
    )
    say(session, "")
