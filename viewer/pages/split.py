"""The pages of a split, its robots, a map of their similarity and the audit, and of a new one."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from morphgen.benchmark.survey import (
    Audit,
    Fault,
    SurveyedRobot,
    audit_survey,
    compare_members,
    different_members,
    survey_robot,
)
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.similarity import MEASURES, classical_mds, to_distances
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.grammar.compose import compose
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import parse_derivation
from morphgen.splits.split import (
    COMPOSED,
    HOLD_OUT,
    REGIMES,
    SIDES,
    Member,
    Regime,
    Split,
    require_split_name,
    split_id,
    write_split,
)
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session, bind
from morphgen.viewer.app.workers import Workers
from morphgen.viewer.pages import gallery as gallery_page
from morphgen.viewer.robot_rows import Row, split_rows, uri_rows
from morphgen.viewer.robot_uri import (
    MEMBER,
    FileAccess,
    read_robot_uri,
    resolve_derivation,
    resolve_member,
    resolve_split,
    shorten,
)

PANEL_WIDTH = 520.0  # largest width of the controls [pixels]
PANEL_SHARE = 0.36  # largest share of the window for the controls: names on the map stay readable
MAX_ROBOTS = 60  # robots of which every pair is compared; a map of more could not be read


SIDE_COLOURS = {"train": "#1c7ed6", "test": "#f76707"}
_MAP_WIDTH, _MAP_CELL, _MAP_LABEL = 900.0, (100.0, 95.0), 18
"""Width of a map, width and height of a robot with its name, and letters of a name that fit."""
_MIN_COLUMNS, _MAP_ASPECT = 9, 2.5  # columns of a map of few robots, and columns by rows


@dataclass(frozen=True, eq=False)
class SplitStudy:
    """Survey of a split's robots."""

    audit: Audit
    sound: Sequence[int]  # indices of members that can be composed, train robots first
    matrices: Mapping[str, Array]  # similarity of their pairs by measure, shape (n, n)


@dataclass(eq=False)
class SplitPage:
    """A split in one browser."""

    session: Session
    split: Split
    gallery: gallery_page.Gallery
    measure: viser.GuiDropdownHandle[str]
    map: viser.GuiHtmlHandle
    audit: viser.GuiHtmlHandle
    study: SplitStudy | None = None

    @property
    def studied_rows(self) -> list[Row]:
        """Rows of the robots that can be composed."""
        return [self.gallery.rows[i] for i in self.study.sound] if self.study else []


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        gallery_page.show_index(session)
        return
    name = session.address.subject
    split = resolve_split(name, session.files)
    gallery = gallery_page.Gallery(session, split.name, split_rows(name, split), SIDES)
    gui = session.client.gui
    header = _description(split) + markup.link(
        Address("population", (name,)), "see all on one ground"
    )
    width = min(PANEL_WIDTH, PANEL_SHARE * session.width)
    panel = gallery_page.open_panels(gallery, markup.breadcrumbs((split.name, None)), header, width)
    tabs = gui.add_tab_group()
    with tabs.add_tab("Robots", viser.Icon.ROBOT):
        gallery_page.add_controls(gallery)
    with panel.add_tab("Map", viser.Icon.MAP):
        panel.visible = True  # on a narrow window, too
        measure = gui.add_dropdown("measure", tuple(MEASURES), initial_value="tree")
        similarity_map = gui.add_html(markup.framed(markup.dim("the robots are being compared")))
    with tabs.add_tab("Audit", viser.Icon.STETHOSCOPE):
        audit = gui.add_html("")
    page = SplitPage(session, split, gallery, measure, similarity_map, audit)
    session.on_change(measure, lambda: _draw_map(page))
    session.run_in_background(lambda: _study(page))


def audit_text(audit: Audit) -> str:
    """Return the audit's findings, and the accepted ones with reasons."""
    text = "<h3>Findings</h3>" + markup.findings_table(audit.findings)
    if audit.accepted:
        rows = [
            (f"<code>{escape(finding.code)}</code>", escape(finding.where), escape(reason))
            for finding, reason in audit.accepted
        ]
        text += "<h3>Accepted</h3>" + markup.table(("code", "where", "why"), rows)
    return text


def _description(split: Split) -> str:
    reference = f"<br>{escape(split.reference)}" if split.reference else ""
    details = f"{split.regime} · id {split_id(split)}{reference}"
    return escape(split.summary) + markup.dim(details)


def _study(page: SplitPage) -> None:
    """Study the split in the worker processes, once for all browsers, and show the results."""
    session = page.session
    folders = session.files.library_folders
    page.study = session.cached(
        f"study {split_id(page.split)}",
        lambda: study_split(page.split, folders, session.workers),
        "comparing {} robots",
    )
    page.audit.content = markup.framed(audit_text(page.study.audit))
    _draw_map(page)
    gallery_page.load_pictures(page.gallery, page.studied_rows)
    _draw_map(page)


def _draw_map(page: SplitPage) -> None:
    if page.study is None or not page.study.sound:
        return
    measure = MEASURES[page.measure.value]
    plane = classical_mds(to_distances(page.study.matrices[measure.name], measure.name))
    page.map.content = markup.framed(
        markup.dim(
            f"{measure.meaning}; {plane.kept:.0%} of the variation shown; "
            f"{markup.tag('train', 'train')}{markup.tag('test', 'test')} click a robot"
        ),
        map_svg(plane.points, page.studied_rows, page.gallery.thumbnails),
    )


def study_split(split: Split, folders: tuple[Path, ...], workers: Workers) -> SplitStudy:
    """Measure and compare a split's robots in worker processes."""
    members = [*split.train, *split.test]
    if len(members) > MAX_ROBOTS:
        raise BenchmarkError(
            f"{len(members)} robots are too many to compare all pairs (at most {MAX_ROBOTS}); "
            "use morphgen split audit and morphgen split stats"
        )
    measure = partial(survey_robot, Library(folders), split.max_links)
    robots = list(workers.map(measure, different_members(split)))
    return workers.call(conclude_study, split, robots, folders)


def conclude_study(
    split: Split, robots: Sequence[SurveyedRobot | Fault], folders: tuple[Path, ...]
) -> SplitStudy:
    """Compare measured robots, and audit the split. Runs in a worker."""
    survey = compare_members(split, robots, all_pairs=True)
    sound = [i for i, each in enumerate(survey.robots) if isinstance(each, SurveyedRobot)]
    return SplitStudy(
        audit_survey(survey, Library(folders)),
        sound,
        {
            name: survey.similarity[np.ix_(sound, sound, [k])][..., 0]
            for k, name in enumerate(MEASURES)
        },
    )


def map_svg(points: Array, robots: Sequence[Row], pictures: Mapping[str, str]) -> str:
    """Return a map of robots at points (n, 2), which show their side; a click opens one."""
    cells = map_cells(points)
    columns, rows = (cells.max(axis=0) + 1).tolist()
    # Many robots make the pictures smaller, never the map larger.
    width = _MAP_WIDTH / max(columns, _MIN_COLUMNS)
    height = width * _MAP_CELL[1] / _MAP_CELL[0]
    inner, label = 0.94 * width, min(13.0, 0.13 * width)
    marks = []
    for (x, y), row in zip(cells.tolist(), robots, strict=True):
        query, colour = escape(Address("robot", (row.uri,)).query), SIDE_COLOURS[row.role]
        box = f'width="{inner:.1f}" height="{0.75 * inner:.1f}"'
        at = f'x="{x * width:.1f}" y="{y * height:.1f}"'
        picture = f'<image {at} {box} href="{pictures[row.uri]}"/>' if pictures.get(row.uri) else ""
        marks.append(
            f'<a href="{query}"><g><title>{escape(row.name)} ({row.role})</title>'
            f'<rect class="point" {at} {box} rx="4" fill="#fff"/>{picture}'
            f'<rect {at} {box} rx="4" fill="none" stroke="{colour}" stroke-width="2"/>'
            f'<text x="{x * width + inner / 2:.1f}" text-anchor="middle" font-size="{label:.1f}" '
            f'y="{y * height + 0.75 * inner + 1.1 * label:.1f}" fill="{colour}">'
            f"{escape(row.name[:_MAP_LABEL])}</text></g></a>"
        )
    return (
        f'<svg viewBox="0 0 {_MAP_WIDTH:.0f} {rows * height + label:.0f}" width="100%" '
        f'style="font-family:inherit">{"".join(marks)}</svg>'
    )


def map_cells(points: Array) -> NDArray[np.intp]:
    """Return a cell (column, row) of its own near each point (n, 2); a fifth stay free."""
    n = len(points)
    columns = max(_MIN_COLUMNS, round(math.sqrt(_MAP_ASPECT * n)))
    rows = max(math.ceil(1.25 * n / columns), round(columns / _MAP_ASPECT))
    span = np.maximum(np.ptp(points, axis=0), 1e-9)
    wanted = (points - points.min(axis=0)) / span * (columns - 1, 1 - rows) + (0, rows - 1)
    cells = np.stack(np.divmod(np.arange(rows * columns), columns)[::-1], axis=1)
    _, chosen = linear_sum_assignment(cdist(wanted, cells, "sqeuclidean"))
    return np.asarray(cells[chosen])


NONE_CHOSEN = (
    "No robot is chosen: tick the box of cards in a gallery, or select robots of a population."
)


def show_chosen(session: Session) -> None:
    """Build the page of the chosen robots, which become the two sides of a new split."""
    if not session.chosen:
        raise MorphgenError(NONE_CHOSEN)
    rows = uri_rows(session.chosen, session.files)
    gallery = gallery_page.Gallery(session, "Chosen robots", rows, SIDES)
    header = "The first robots that you chose are to train on, the others to test on."
    gallery_page.open_panels(
        gallery, markup.breadcrumbs(("chosen robots", None)), markup.dim(header)
    )
    num_train = session.client.gui.add_slider("to train on", 0, len(rows), 1, max(len(rows) - 1, 1))
    bind(session, "train", num_train)
    session.apply_state()
    _set_sides(gallery.rows, num_train.value)

    def divide() -> None:
        _set_sides(gallery.rows, num_train.value)
        gallery_page.show_page(gallery, 1)

    def sides() -> tuple[list[Row], list[Row]]:
        return gallery.rows[: num_train.value], gallery.rows[num_train.value :]

    def leave_out() -> None:
        address = replace(session.address, subjects=session.chosen or ("",))
        session.open_address(address, instead=True)

    gallery_page.add_controls(gallery)
    add_split_form(session, sides)
    session.on_change(num_train, divide, "sides")
    session.on_choice = leave_out


def _set_sides(rows: list[Row], num_train: int) -> None:
    rows[:] = [replace(row, role=SIDES[int(i >= num_train)]) for i, row in enumerate(rows)]


REGIMES_TO_SAVE = tuple(regime for regime in REGIMES if regime != HOLD_OUT)
"""Regimes of splits that the viewer saves; it has no controls for what a hold-out split says."""
MAX_NAME = 200  # longest name of a split [characters]


def make_member(task: str, obstacles: bool, files: FileAccess, row: Row) -> Member:
    """Return the robot of a row as a member of a split. Runs in a worker."""
    uri = row.uri
    if uri.startswith(MEMBER):
        return replace(resolve_member(uri, files), task=task, obstacles=obstacles)
    robot = read_robot_uri(uri, files)
    derivation = str(resolve_derivation(uri, files) or robot.provenance.get("derivation", ""))
    if not derivation:
        raise BenchmarkError(f"{uri} was imported: a split names robots by their derivations")
    composed = compose(parse_derivation(derivation), files.library, robot.name)
    hash_ = robot_hash(composed)
    return Member(robot.name, row.category or COMPOSED, derivation, task, obstacles, hash_)


def save_split(
    name: str, regime: Regime, train: Sequence[Member], test: Sequence[Member], files: FileAccess
) -> Path:
    """Write a split's file into ``splits/`` of the folder where the viewer was started."""
    require_split_name(name)
    if not train or not test:
        raise BenchmarkError(
            f"{len(train)} train and {len(test)} test robots: at least one of each is needed"
        )
    if len(name) > MAX_NAME:
        raise BenchmarkError(f"name {shorten(name)!r}: at most {MAX_NAME} characters")
    path = files.roots[0] / gallery_page.SPLITS / f"{name}.yaml"
    if path.exists():
        raise BenchmarkError(f"{path} exists; choose another name")
    summary = f"{len(train)} robots to train on, {len(test)} to test on, chosen in the viewer"
    write_split(Split(name, regime, summary, tuple(train), tuple(test)), path)
    return path


def add_split_form(
    session: Session, choose_sides: Callable[[], tuple[list[Row], list[Row]]]
) -> None:
    """Add controls that save a new split of two sides, and show the command that audits it."""
    gui = session.client.gui
    with gui.add_folder("New split"):
        name = gui.add_text("split name", "")
        regime = gui.add_dropdown("regime", REGIMES_TO_SAVE)
        task = gui.add_dropdown("task", tuple(TASKS))
        obstacles = gui.add_checkbox("obstacles", False)
        text = gui.add_html("")
        button = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)

    def save() -> None:
        make = partial(make_member, task.value, obstacles.value, session.files)
        with session.activity("composing {} robots"):
            train, test = (list(session.workers.map(make, rows)) for rows in choose_sides())
        path = save_split(name.value, regime.value, train, test, session.files)
        shown = str(path.relative_to(session.files.roots[0]))
        text.content = markup.framed(markup.code(f"morphgen split audit {shlex.quote(shown)}"))
        session.notify("Saved", shown)

    session.on_press(button, save)
