"""The pages of a population: robots on one ground, selected together, or compared."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.encoding.similarity import MEASURES, features, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.progress import report
from morphgen.splits.split import split_id
from morphgen.typing import Array
from morphgen.viewer import markup, robot_uri
from morphgen.viewer.app.address import MAX_COMPARED, Address, parse_count
from morphgen.viewer.app.session import Session, bind, parse_value, set_value
from morphgen.viewer.app.workers import Workers
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.robot_files import robot_facts
from morphgen.viewer.robot_rows import Row, facts_line, source_rows, uri_rows
from morphgen.viewer.scene import stage
from morphgen.viewer.scene.population import (
    MAX_SHADOWS,
    Population,
    PopulationScene,
    ReadRobot,
    arrange,
    make_population,
    move_joints,
)
from morphgen.viewer.scene.robot import robot_bounds

MAX_ROBOTS = 1000  # largest population [robots]
_CHUNK = 20  # robots of one call of a worker


@dataclass(frozen=True)
class Source:
    """Robots that an address names."""

    rows: tuple[Row, ...]  # at most `MAX_ROBOTS`, with the facts that are known
    total: int  # number of robots that the address names
    stamp: str  # changes with the files of the robots or of the split


def find_source(subject: str, files: robot_uri.FileAccess) -> Source:
    """List the robots of a split or a folder."""
    rows = source_rows(subject, files)
    if not rows[0].role:
        return listed_source(rows, files)
    stamp = split_id(robot_uri.resolve_split(subject, files))
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp)


def listed_source(rows: Sequence[Row], files: robot_uri.FileAccess) -> Source:
    """Return the robots of rows."""
    stamp = "\n".join(robot_uri.content_hash(row.uri, files) for row in rows[:MAX_ROBOTS])
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp)


def load_population(
    source: Source, files: robot_uri.FileAccess, workers: Workers
) -> tuple[Population, list[tuple[str, str]]]:
    """Read the robots in the workers; return also the name and error of those that are broken."""
    chunks = [source.rows[i : i + _CHUNK] for i in range(0, len(source.rows), _CHUNK)]
    results: list[ReadRobot | tuple[str, str]] = []
    for call in [workers.submit(read_robots, chunk, files) for chunk in chunks]:
        read_chunk: list[ReadRobot | tuple[str, str]] = workers.result(call)
        results += read_chunk
        report(len(results), len(source.rows))
    faults = [result for result in results if not isinstance(result, ReadRobot)]
    read = [result for result in results if isinstance(result, ReadRobot)]
    if not read:
        raise robot_uri.UriError(f"no robot can be read; the first error: {faults[0][1]}")
    return make_population(read), faults


def read_robots(
    rows: Sequence[Row], files: robot_uri.FileAccess
) -> list[ReadRobot | tuple[str, str]]:
    """In a worker, read robots and measure them, or return the name and error of each."""
    results: list[ReadRobot | tuple[str, str]] = []
    for row in rows:
        try:
            robot = split_colours(robot_uri.read_robot_uri(row.uri, files))
            if row.dof is None or row.reach is None:
                row = row.completed(robot_facts(robot))
            results.append(ReadRobot(row, robot, np.array(robot_bounds(robot))))
        except MorphgenError as error:
            results.append((row.name, files.redact(error)))
    return results


PANEL_WIDTH = 340.0  # width of the panel [pixels]
ARRANGEMENTS = {
    "grid": "grid",
    "reach": "rows by reach",
    "mass": "rows by mass",
    "dof": "rows by DoF",
}
"""Labels of the arrangements by their key in the address."""
CAMERA_DIRECTION = (0.08, -0.8, 0.6)  # to the camera, which sees rows from left to right
_NUM_NAMED = 5  # selected robots that are listed
MIDDLE = 0.5  # position of a slider whose joints are at home
NONE_TO_COMPARE = (
    "<h2>Compare two to four robots</h2>Tick the box of cards in a gallery, or of a robot's page, "
    "and press <i>compare</i> below."
)


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        show_index(session)
        return
    subject = session.address.subject
    source = find_source(subject, session.files)
    page = "split" if source.rows[0].role else "gallery"
    _open(session, source, (subject, Address(page, (subject,))), ("population", None))


def show_compared(session: Session) -> None:
    """Build the page that compares few robots: their population, and how similar they are."""
    uris = tuple(filter(None, session.address.subjects))
    if len(uris) > MAX_COMPARED:
        raise robot_uri.UriError(f"{len(uris)} robots to compare: expected 2 to {MAX_COMPARED}")
    if uris:
        rows = uri_rows(uris, session.files)
        _open(session, listed_source(rows, session.files), ("compare", None))
        return
    session.open_panel(PANEL_WIDTH, markup.breadcrumbs(("compare", None)))
    session.client.gui.add_html(markup.framed(NONE_TO_COMPARE))
    session.show_address("compare")


def _open(session: Session, source: Source, *steps: tuple[str, Address | None]) -> None:
    """Open the panel, and show the robots when they are read."""
    crumbs = markup.breadcrumbs(*steps)
    session.open_panel(PANEL_WIDTH, crumbs, f"reading {len(source.rows)} robots")

    def load() -> None:
        """Read the robots, once for all browsers, and show them."""
        population, faults = session.cached(
            f"population {hash(source)}",
            lambda: load_population(source, session.files, session.workers),
            "reading {} robots",
        )
        session.enqueue(lambda: PopulationPage(session, source, population, faults))

    session.run_in_background(load)


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
        self._similarity = gui.add_html("")
        self._arrange = gui.add_dropdown("Arrange", tuple(ARRANGEMENTS.values()))
        home = gui.add_button("Home", icon=viser.Icon.HOME)
        bind(session, "arrange", self._arrange, tuple(ARRANGEMENTS))
        session.keep("select", lambda: format_selection(self.selected), self._apply_selection)
        self._moved: dict[int, float] = {}  # shares of their ranges, by the numbers of joints
        self._sliders: list[viser.GuiSliderHandle[float]] = []
        with gui.add_folder("Joints from the base to the tool"):
            for number in range(1, int(population.number.max(initial=0)) + 1):
                self._add_slider(number)
        self._selection = gui.add_html("")
        select = gui.add_button_group("Select", ("all", "none"))
        choose = gui.add_button(
            "Choose", icon=viser.Icon.CHECKBOX, hint="add them to the chosen robots"
        )
        session.on_change(self._arrange, self._show_arrangement, "arrange")
        session.on_change(home, self._go_home)
        session.on_change(
            select, lambda: self.select(np.full(len(population), select.value == "all"))
        )
        session.on_change(choose, self._choose)
        self._connect_pointer()
        session.set_status("")
        is_comparison = session.address.page == "compare"
        names = ", ".join(row.name for row in population.rows)
        session.title = f"compare {names}" if is_comparison else session.address.subject
        session.apply_state()
        self._show_arrangement()
        self.select(self.selected)
        if is_comparison:
            session.run_in_background(self._compare)

    def _compare(self) -> None:
        """Show how similar the robots are, or why they cannot be compared."""
        session, rows = self.session, self.population.rows
        lines = markup.dim("<br>".join(map(_row_line, rows)))
        try:
            with session.activity("comparing"):
                similarity = session.workers.call(
                    compare_robots, self.population.robots, session.files.library_folders
                )
            table = f"<h3>Similarity</h3>{similarity_table([row.name for row in rows], similarity)}"
        except MorphgenError as error:
            tag = markup.tag("cannot be compared", "warning")
            table = f"{tag}{escape(session.files.redact(error))}"
        self._similarity.content = markup.framed(lines, table)

    def select(self, selected: NDArray[np.bool_]) -> None:
        """Select robots by a mask (n,), in the scene, the panel and the address."""
        self.selected = selected
        self.scene.fade(selected, stage.background_colour(dark=self.session.dark))
        self._selection.content = markup.framed(selection_text(self._selected_rows))
        self.session.show_state()

    @property
    def _selected_rows(self) -> list[Row]:
        return [self.population.rows[i] for i in np.flatnonzero(self.selected)]

    def _apply_selection(self, text: str) -> None:
        self.selected = parse_selection(text, len(self.population))

    def _choose(self) -> None:
        if not self._selected_rows:
            raise robot_uri.UriError(
                "no robot is selected: drag a rectangle with the shift key held"
            )
        uris = (row.uri for row in self._selected_rows)
        self.session.choose((*self.session.chosen, *uris))

    def _add_slider(self, number: int) -> None:
        """Add the slider of a joint, which is in the middle while nobody has moved it."""
        session, moved = self.session, self._moved
        count = int((self.population.number == number).any(axis=1).sum())
        hint = f"share of its range, of {count} robots"
        slider = session.client.gui.add_slider(f"joint {number}", 0.0, 1.0, 0.01, MIDDLE, hint=hint)
        self._sliders.append(slider)

        def apply(text: str) -> None:
            """Take over a position of an address, unless it is invalid; the robots move later."""
            if (position := parse_value(slider, text)) is not None:
                moved[number] = position
                set_value(slider, position)

        def read() -> None:
            moved[number] = slider.value
            self._move()

        def write() -> str:
            return f"{moved[number]:g}" if number in moved else ""

        session.on_change(slider, read, f"move {number}")
        session.keep(f"joint{number}", write, apply)

    def _go_home(self) -> None:
        self._moved.clear()
        for slider in self._sliders:
            set_value(slider, MIDDLE)
        self._move()

    def _configurations(self) -> NDArray[np.float64]:
        """Return the configurations of all robots, shape (n, J) [rad or m]."""
        return move_joints(self.population, self.population.home, self._moved)

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
            stage.add_ground(client.scene, float(np.linalg.norm(high - low)))
            stage.look_at(client, low, high, CAMERA_DIRECTION)
        self.session.show_state()

    def _connect_pointer(self) -> None:
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
        corners = np.array([event.screen_min, event.screen_max])
        centres = self.population.home_bounds.mean(axis=1)
        centres[:, :2] += self.scene.positions
        points, depth = stage.project_points(self.session.client.camera, centres)
        inside = (points >= corners.min(axis=0)) & (points <= corners.max(axis=0))
        return np.asarray(inside.all(axis=1) & (depth > 0))


def summary(source: Source, population: Population, faults: Sequence[tuple[str, str]]) -> str:
    """Return the number of robots, what is missing, and how to use the pointer."""
    text = f"<h3>{len(population)} robot{'s' * (len(population) != 1)}</h3>"
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
    """Return the selected robots with links and facts as HTML."""
    if not rows:
        return markup.dim("no robot is selected")
    lines = [_row_line(row) for row in rows[:_NUM_NAMED]]
    if len(rows) > _NUM_NAMED:
        lines.append("...")
    return f"<b>{len(rows)} selected</b>{markup.dim('<br>'.join(lines))}"


def _row_line(row: Row) -> str:
    """Return a robot with a link, its facts and findings as HTML."""
    findings = escape(", ".join(row.findings or ()))
    link = markup.link(Address("robot", (row.uri,)), row.name)
    return f"{link} {escape(facts_line(row))} {findings}".rstrip()


def compare_robots(robots: Sequence[Robot], folders: Sequence[Path]) -> dict[str, Array]:
    """Return the similarity of every pair by measure, shape (n, n). Runs in a worker."""
    library = Library(folders)
    robots = [robot_uri.with_library_meshes(robot, library) for robot in robots]
    # Splits fix the number of links; here the largest robot does.
    max_links = default_max_links(len(robot.links) for robot in robots)
    compared = [
        features(robot, token_shapes(robot, folders), max_links=max_links) for robot in robots
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
