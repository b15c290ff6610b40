"""The page of a population: many robots on one ground, arranged, moved and selected together."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.viewer import markup
from morphgen.viewer.app.address import Address, parse_count
from morphgen.viewer.app.session import Session
from morphgen.viewer.controls import RoleSliders, bind
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.population import (
    MAX_SHADOWS,
    NUM_SAMPLED,
    Population,
    PopulationScene,
    Source,
    arrange,
    find_source,
    load_population,
    move_roles,
)
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


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        show_index(session)
        return
    subject, state = session.address.subject, session.address.state
    seed = parse_count(state.get("seed", ""), 0)
    number = parse_count(state.get("number", ""), NUM_SAMPLED)
    source = find_source(subject, session.files, seed, number)
    for key in ("seed", "number") if source.grammar else ():
        session.keep(key)
    crumbs = markup.breadcrumbs((subject, _gallery_address(subject, source)), ("population", None))
    session.open_panel(PANEL_WIDTH, crumbs, f"reading {len(source.rows)} robots")

    def load() -> None:
        """Read the robots, once for all browsers, and show them."""
        population, faults = session.cached(
            f"population {source.key}",
            lambda: load_population(source, session.files, session.workers),
            "reading {} robots",
        )
        session.enqueue(lambda: PopulationPage(session, source, population, faults))

    session.run_in_background(load)


def _gallery_address(subject: str, source: Source) -> Address:
    if source.grammar:
        return Address("compose", (source.grammar,))
    split = subject.rpartition("@")[0] or subject
    return Address("split" if source.rows[0].role else "gallery", (split,))


class PopulationPage:
    """A population in one browser."""

    def __init__(
        self,
        session: Session,
        source: Source,
        population: Population,
        faults: Sequence[tuple[str, str]],
    ) -> None:
        """Draw the robots, add the controls, and apply the address."""
        client, gui = session.client, session.client.gui
        session.set_status("sending the shapes to the browser")
        self.session, self.population = session, population
        self.scene = PopulationScene(client, population)
        self.selected = np.zeros(len(population), np.bool_)  # mask of the selected robots
        self._labels: list[viser.LabelHandle] = []
        gui.add_html(markup.framed(summary(source, population, faults)))
        self._arrange = gui.add_dropdown("Arrange", tuple(ARRANGEMENTS.values()))
        home = gui.add_button("Home", icon=viser.Icon.HOME)
        bind(session, "arrange", self._arrange, tuple(ARRANGEMENTS))
        session.keep("select", lambda: format_selection(self.selected), self._apply_selection)
        self._sliders = RoleSliders(session, 0.0, self._move)
        self._add_sliders()
        self._selection = gui.add_html("")
        select = gui.add_button_group("Select", ("all", "none", "invert"))
        choose = gui.add_button(
            "Choose", icon=viser.Icon.CHECKBOX, hint="add them to the chosen robots"
        )
        session.on_change(self._arrange, self._show_arrangement, "arrange")
        session.on_change(home, lambda: self._sliders.set({}))
        session.on_change(select, lambda: self._change_selection(select.value))
        session.on_change(choose, self._choose)
        self._connect_pointer()
        session.set_status("")
        session.title = session.address.subject
        session.apply_state()
        self._show_arrangement()
        self.select(self.selected)

    def select(self, selected: NDArray[np.bool_]) -> None:
        """Select robots by a mask (n,), in the scene, the panel and the address."""
        self.selected = selected
        self.scene.fade(selected, background_colour(dark=self.session.dark))
        self._selection.content = markup.framed(selection_text(self._selected_rows))
        self.session.show_state()

    @property
    def _selected_rows(self) -> list[Row]:
        return [self.population.rows[i] for i in np.flatnonzero(self.selected)]

    def _apply_selection(self, text: str) -> None:
        self.selected = parse_selection(text, len(self.population))

    def _change_selection(self, action: str) -> None:
        everything = np.full(len(self.population), action == "all")
        self.select(~self.selected if action == "invert" else everything)

    def _choose(self) -> None:
        """Put the selected robots into the tray."""
        if not self._selected_rows:
            raise UriError("no robot is selected: drag a rectangle with the shift key held")
        uris = (row.uri for row in self._selected_rows)
        self.session.choose((*self.session.chosen, *uris))

    def _add_sliders(self) -> None:
        """Add a slider for each role of joints."""
        gui, roles, role = self.session.client.gui, self.population.roles, self.population.role
        for title, initial in (
            ("Joints from the base to the tool", "j"),
            ("Fingers and others", "f"),
        ):
            if names := [name for name in roles if name[0] == initial]:
                with gui.add_folder(title, expand_by_default=initial == "j"):
                    for name in names:
                        count = int((role == roles.index(name)).any(axis=1).sum())
                        self._sliders.add(name, MIDDLE, f"share of its range, of {count} robots")

    def _configurations(self) -> NDArray[np.float64]:
        """Return the configurations of all robots, shape (n, J) [rad or m]."""
        return move_roles(self.population, self.population.home, self._sliders.moved)

    def _move(self) -> None:
        self.scene.move(self.scene.positions, self._configurations())
        self.session.show_state_later()

    def _show_arrangement(self) -> None:
        """Move the robots to their places, with labels and the camera in front of them."""
        client, bounds = self.session.client, self.population.home_bounds
        fact = next(key for key, label in ARRANGEMENTS.items() if label == self._arrange.value)
        positions, labels = arrange(self.population, "" if fact == "grid" else fact)
        roots = np.pad(positions, ((0, 0), (0, 1)))
        points = np.array([(*position, 0.0) for _, position in labels]).reshape(-1, 3)
        low = np.concatenate([bounds[:, 0] + roots, points]).min(axis=0)
        high = np.concatenate([bounds[:, 1] + roots, points]).max(axis=0)
        with client.atomic():
            for handle in self._labels:
                handle.remove()
            self.scene.move(positions, self._configurations())
            self._labels = [
                client.scene.add_label(f"/labels/{i}", text, position=(*position, 0.0))
                for i, (text, position) in enumerate(labels)
            ]
            add_ground(client.scene, float(np.linalg.norm(high - low)))
            add_scale_bar(client.scene, low, high, CAMERA_DIRECTION)
            look_at(client, low, high, CAMERA_DIRECTION)
        self.session.show_state()

    def _connect_pointer(self) -> None:
        """Let clicks and rectangles select robots."""
        session, robots = self.session, np.arange(len(self.population))

        def click(part: slice, event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
            index, shift = event.instance_index, event.modifier == "shift"
            if index is not None and 0 <= index < part.stop - part.start:  # browsers may send any
                clicked = robots == self.population.instances.robot[part.start + index]
                session.enqueue(lambda: self.select(self.selected ^ clicked if shift else clicked))

        for handle, part in self.scene.parts():
            for modifier in (None, "shift"):
                handle.on_click(modifier=modifier)(functools.partial(click, part))
        session.client.scene.on_rect_select(modifier="shift")(
            lambda event: session.enqueue(lambda: self.select(self._inside(event)))
        )

    def _inside(self, event: viser.SceneRectSelectEvent) -> NDArray[np.bool_]:
        """Return which robots have their middle inside a rectangle of the picture, shape (n,)."""
        view = camera_view(self.session.client)
        corners = np.array([event.screen_min, event.screen_max]) * (view.aspect, 1.0)
        centres = self.population.home_bounds.mean(axis=1)
        centres[:, :2] += self.scene.positions
        points, depth = project_points(view, centres)
        inside = (points >= corners.min(axis=0)) & (points <= corners.max(axis=0))
        return np.asarray(inside.all(axis=1) & (depth > 0))


def summary(source: Source, population: Population, faults: Sequence[tuple[str, str]]) -> str:
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
