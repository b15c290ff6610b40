"""The page of a population: many robots on one ground, arranged, moved and selected together."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.errors import BenchmarkError
from morphgen.splits.split import SIDES
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address, parse_count
from morphgen.viewer.app.session import Session
from morphgen.viewer.comparison import RoleSliders
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.population import (
    MAX_SHADOWS,
    NUM_SAMPLED,
    Population,
    PopulationScene,
    Source,
    add_population,
    fade,
    find_source,
    grid,
    load_population,
    move,
    move_roles,
    rows_by_fact,
)
from morphgen.viewer.robot_files import send_bundles
from morphgen.viewer.robot_rows import UNITS, Row, facts_line
from morphgen.viewer.robot_uri import UriError
from morphgen.viewer.scene.stage import (
    add_ground,
    add_scale_bar,
    background_colour,
    camera_view,
    look_at,
    project_points,
)
from morphgen.viewer.splits import ChooseSides, add_split_form

PANEL_WIDTH = 340.0  # width of the panel [pixels]
ARRANGEMENTS = {
    "grid": "grid",
    "reach": "rows by reach",
    "mass": "rows by mass",
    "dof": "rows by DoF",
}
"""Labels of the arrangements by their key in the address."""
MIDDLE = 0.5  # position of a slider whose joints are at home
CAMERA_DIRECTION = (0.08, -0.8, 0.6)  # to the camera, which sees rows from left to right
_NUM_NAMED = 5  # selected robots that are listed


@dataclass(eq=False)
class PopulationPage:
    """A population in one browser."""

    session: Session
    population: Population
    scene: PopulationScene
    arrange: viser.GuiDropdownHandle[str]
    selected: NDArray[np.bool_]  # mask of the selected robots, shape (n,)
    sliders: RoleSliders = field(init=False)  # sliders of the joints' shares of their ranges
    selection: viser.GuiHtmlHandle = field(init=False)

    @property
    def arrangement(self) -> str:
        """Key of the chosen arrangement."""
        return next(key for key, label in ARRANGEMENTS.items() if label == self.arrange.value)

    @property
    def rows(self) -> list[Row]:
        """Rows of the selected robots."""
        return [self.population.rows[i] for i in np.flatnonzero(self.selected)]

    def apply_selection(self, text: str) -> None:
        """Select the robots that an address names."""
        self.selected = parse_selection(text, len(self.population))


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        show_index(session)
        return
    subject, state = session.address.subject, session.address.state
    seed = parse_count(state.get("seed", ""), 0)
    number = parse_count(state.get("number", ""), NUM_SAMPLED)
    source = find_source(subject, session.files, seed, number)
    crumbs = markup.breadcrumbs((subject, _gallery_address(subject, source)), ("population", None))
    session.open_panel(PANEL_WIDTH, crumbs, f"reading {len(source.rows)} robots")
    session.run_in_background(lambda: _load(session, source))


def _gallery_address(subject: str, source: Source) -> Address:
    if source.grammar:
        return Address("compose", (source.grammar,))
    split = subject.rpartition("@")[0] or subject
    return Address("split" if source.rows[0].role else "gallery", (split,))


def _load(session: Session, source: Source) -> None:
    """Read the robots, once for all browsers, and show them."""
    population, faults = session.cached(
        f"population {source.key}",
        lambda: load_population(source, session.files, session.workers),
        "reading {} robots",
    )
    if not session.closed.is_set():
        session.enqueue(lambda: _show_population(session, source, population, faults))


def _show_population(
    session: Session, source: Source, population: Population, faults: list[tuple[str, str]]
) -> None:
    """Draw the robots, add the controls, and apply the address."""
    client, gui = session.client, session.client.gui
    session.set_status("sending the shapes to the browser")
    positions = grid(population.home_bounds).positions
    scene = add_population(client, population, positions, population.home)
    gui.add_html(markup.framed(_summary(source, population, faults)))
    arrange = gui.add_dropdown("Arrange", tuple(ARRANGEMENTS.values()))
    home = gui.add_button("Home", icon=viser.Icon.HOME)
    page = PopulationPage(session, population, scene, arrange, np.zeros(len(population), np.bool_))
    session.keep_choice("arrange", arrange, tuple(ARRANGEMENTS))
    session.keep("select", lambda: format_selection(page.selected), page.apply_selection)
    page.sliders = RoleSliders(session, 0.0, lambda: _move(page))
    _add_sliders(page)
    page.selection = gui.add_html("")
    _add_actions(page)
    session.on_change(arrange, lambda: _arrange(page), "arrange")
    session.on_change(home, lambda: page.sliders.set({}))
    _connect_pointer(page)
    session.set_status("")
    session.title = session.address.subject
    session.apply_state()
    _arrange(page)
    _show_selection(page)


def _summary(source: Source, population: Population, faults: list[tuple[str, str]]) -> str:
    """Return the number of robots, what is missing, and how to use the pointer."""
    text = f"<h3>{len(population)} robots</h3>"
    if source.total > len(source.rows):
        text += markup.dim(f"the first {len(source.rows)} of {source.total}")
    if faults:
        lines = "<br>".join(f"{escape(name)}: {escape(error)}" for name, error in faults[:5])
        text += f"{markup.tag(f'{len(faults)} cannot be read', 'error')}{markup.dim(lines)}"
    if len(population) > MAX_SHADOWS:
        text += markup.dim(f"without shadows: more than {MAX_SHADOWS} robots")
    return text + markup.dim(
        "Click a robot to select it, with the shift key to add or remove it. Shift and drag "
        "selects a rectangle."
    )


def _add_sliders(page: PopulationPage) -> None:
    """Add a slider for each role of joints."""
    population = page.population
    for title, initial in (("Joints from the base to the tool", "j"), ("Fingers and others", "f")):
        roles = [role for role in population.roles if role[0] == initial]
        if not roles:
            continue
        with page.session.client.gui.add_folder(title, expand_by_default=initial == "j"):
            for role in roles:
                number = int((population.role == population.roles.index(role)).any(axis=1).sum())
                page.sliders.add(role, MIDDLE, f"share of its range, of {number} robots")


def _arrange(page: PopulationPage) -> None:
    """Move the robots to their places, with labels and the camera in front of them."""
    scene, client, population = page.scene, page.session.client, page.population
    layout = grid(population.home_bounds)
    if page.arrangement != "grid":
        layout = rows_by_fact(population.rows, page.arrangement, population.home_bounds)
    roots = np.pad(layout.positions, ((0, 0), (0, 1)))
    labels = np.array([(*position, 0.0) for _, position in layout.labels]).reshape(-1, 3)
    low = np.concatenate([population.home_bounds[:, 0] + roots, labels]).min(axis=0)
    high = np.concatenate([population.home_bounds[:, 1] + roots, labels]).max(axis=0)
    with client.atomic():
        for handle in scene.labels:
            handle.remove()
        move(scene, layout.positions, _configurations(page))
        scene.labels = [
            client.scene.add_label(f"/labels/{i}", text, position=(*position, 0.0))
            for i, (text, position) in enumerate(layout.labels)
        ]
        add_ground(client.scene, float(np.linalg.norm(high - low)))
        add_scale_bar(client.scene, low, high, CAMERA_DIRECTION)
        look_at(client, low, high, CAMERA_DIRECTION)
    page.session.show_state()


def _configurations(page: PopulationPage) -> NDArray[np.float64]:
    """Return the configurations of all robots, shape (n, J) [rad or m]."""
    return move_roles(page.population, page.population.home, page.sliders.moved)


def _move(page: PopulationPage) -> None:
    move(page.scene, page.scene.positions, _configurations(page))
    page.session.show_state_later()


def format_selection(selected: NDArray[np.bool_]) -> str:
    """Return the indices of selected robots as ranges, such as ``0-4,9``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], selected, [False]]).astype(int)))
    pairs = edges.reshape(-1, 2).tolist()
    return ",".join(f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in pairs)


def parse_selection(text: str, n: int) -> NDArray[np.bool_]:
    """Return the mask of robots that ranges select, shape (n,); what is invalid selects nothing."""
    selected = np.zeros(n, dtype=np.bool_)
    for part in text.split(","):
        first, dash, last = part.partition("-")
        start = parse_count(first, n)
        selected[start : (parse_count(last, -1) if dash else start) + 1] = True
    return selected


def selection_text(rows: Sequence[Row]) -> str:
    """Return the selected robots with links, and the ranges of their facts, as HTML."""
    if not rows:
        return markup.dim("no robot is selected")
    lines = [
        f"{markup.link(Address('robot', (row.uri,)), row.name)} {escape(facts_line(row))}"
        + (f" {escape(', '.join(row.findings))}" if row.findings else "")
        for row in rows[:_NUM_NAMED]
    ]
    if len(rows) > _NUM_NAMED:
        lines.append("...")
    for fact in ("reach", "mass", "dof") if len(rows) > 1 else ():
        values = [value for row in rows if (value := getattr(row, fact)) is not None]
        if values:
            low, high = min(values), max(values)
            numbers = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            lines.append(f"{'' if fact == 'dof' else fact + ' '}{numbers} {UNITS[fact]}")
    return f"<b>{len(rows)} selected</b>{markup.dim('<br>'.join(lines))}"


def _select(page: PopulationPage, selected: NDArray[np.bool_]) -> None:
    page.selected = selected
    _show_selection(page)


def _show_selection(page: PopulationPage) -> None:
    """Show which robots are selected, in the scene, the panel and the address."""
    background = background_colour(dark=page.session.dark)
    fade(page.scene, page.selected, background)
    page.selection.content = markup.framed(selection_text(page.rows))
    page.session.show_state()


def _connect_pointer(page: PopulationPage) -> None:
    """Let clicks and rectangles select robots."""
    session, instances = page.session, page.population.instances

    def click(part: slice, event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
        index, shift = event.instance_index, event.modifier == "shift"
        if index is not None and 0 <= index < part.stop - part.start:  # a browser may send any
            robot = instances.robot[part.start + index]
            clicked = np.arange(len(page.population)) == robot
            session.enqueue(lambda: _select(page, page.selected ^ clicked if shift else clicked))

    for prototype, part in instances.prototypes.items():
        for modifier in (None, "shift"):
            page.scene.handles[prototype].on_click(modifier=modifier)(
                functools.partial(click, part)
            )
    session.client.scene.on_rect_select(modifier="shift")(
        lambda event: session.enqueue(lambda: _select(page, _inside(page, event)))
    )


def _inside(page: PopulationPage, event: viser.SceneRectSelectEvent) -> NDArray[np.bool_]:
    """Return which robots have their middle inside a rectangle of the picture, shape (n,)."""
    view = camera_view(page.session.client)
    corners = np.array([event.screen_min, event.screen_max]) * (view.aspect, 1.0)
    centres = page.population.home_bounds.mean(axis=1)
    centres[:, :2] += page.scene.positions
    points, depth = project_points(view, centres)
    inside = (points >= corners.min(axis=0)) & (points <= corners.max(axis=0))
    return np.asarray(inside.all(axis=1) & (depth > 0))


def _add_actions(page: PopulationPage) -> None:
    """Add the controls that change the selection, and what can be done with it."""
    gui, session = page.session.client.gui, page.session
    with gui.add_folder("Selection"):
        select = gui.add_button_group("Select", ("all", "none", "invert"))
        choose = gui.add_button("Choose", icon=viser.Icon.CHECKBOX, hint="add them to the tray")
        export = gui.add_button("Export bundles (.zip)", icon=viser.Icon.DOWNLOAD)
        add_split_form(session, lambda: _add_choice(page))

    def change_selection() -> None:
        everything = np.full(len(page.population), select.value == "all")
        _select(page, ~page.selected if select.value == "invert" else everything)

    def choose_robots() -> None:
        session.choose((*session.chosen, *(row.uri for row in _require_selection(page))))

    def export_robots() -> None:
        uris = [row.uri for row in _require_selection(page)]  # of now, whatever work is waiting
        session.run_in_background(lambda: send_bundles(session, uris))

    session.on_change(select, change_selection)
    session.on_change(choose, choose_robots)
    session.on_change(export, export_robots)


def _require_selection(page: PopulationPage) -> list[Row]:
    """Return the selected robots."""
    if page.rows:
        return page.rows
    raise UriError("no robot is selected: drag a rectangle with the shift key held")


def _add_choice(page: PopulationPage) -> ChooseSides:
    """Add the side of the selected robots; the others are on the other side."""
    side = page.session.client.gui.add_dropdown(
        "selected robots", SIDES, initial_value="test", hint="the others are on the other side"
    )

    def choose_sides() -> tuple[list[Row], list[Row]]:
        chosen = _require_selection(page)
        rows = zip(page.population.rows, page.selected, strict=True)
        others = [row for row, is_selected in rows if not is_selected]
        if not others:
            raise BenchmarkError("all robots are selected: none is left for the other side")
        return (chosen, others) if side.value == "train" else (others, chosen)

    return choose_sides
