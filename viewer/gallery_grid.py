"""A grid of thumbnails that is searched, filtered, sorted and paged by controls beside it."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import dataclass, field, replace
from html import escape
from pathlib import Path
from typing import Any

import viser

from morphgen.formats.bundle import PICTURE
from morphgen.viewer import figures, markup, robot_rows
from morphgen.viewer.address import Address, parse_count
from morphgen.viewer.robot_files import (
    Thumbnail,
    make_thumbnail,
    measure_picture,
    thumbnail_of_picture,
)
from morphgen.viewer.session import Session
from morphgen.viewer.workers import WorkerDied

REFRESH_INTERVAL = 0.6
"""Time after which a gallery shows the thumbnails that were drawn meanwhile [s]."""
CONTROLS_WIDTH = 330.0
"""Width of the controls [pixels]."""
CANVAS_WIDTH = 120.0
"""Width that viser keeps free for its scene between the panels [pixels]."""
SCALES = ("common", "own")
"""Scales of pictures: the same for all robots, or for each one that fills its picture."""
_ALL = "all"
_PAGE_BUTTONS: Mapping[str, Callable[[int], int]] = {
    "first": lambda number: 1,
    "prev": lambda number: number - 1,
    "next": lambda number: number + 1,
    "last": lambda number: 10**9,  # clipped to the last page
}
_RANGE_LABELS = {"dof": "DoF", "reach": "Reach (m)", "mass": "Mass (kg)"}
_SORT_KEYS = {
    label: key
    for name in robot_rows.SORTS
    for label, key in ((name, name), (f"{name}, largest first", f"-{name}"))
}
"""Keys of ``sort_rows`` by their label in the dropdown."""


@dataclass(eq=False)
class Gallery:
    """A gallery in one browser."""

    session: Session
    title: str
    rows: list[robot_rows.Row]
    """All robots, shown or not."""
    columns: tuple[str, ...] = ()
    """Roles that are shown in a column each; without any, all robots are in one grid."""
    scale: str = SCALES[1]
    """Scale of the pictures, one of ``SCALES``, unless the user chooses the other."""
    thumbnails: dict[str, str] = field(default_factory=dict)
    """Thumbnails drawn so far, by URI."""
    faults: dict[str, str] = field(default_factory=dict)
    """Errors of robots that cannot be read, by URI."""
    controls: dict[str, Any] = field(default_factory=dict)
    """Controls by their key in the address."""
    histograms: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    """Distributions of the facts above their sliders."""
    grid: viser.GuiHtmlHandle | None = None
    summary: str = ""
    """Number of robots that pass the filter, and of the page."""
    page_rows: list[robot_rows.Row] = field(default_factory=list)
    """Robots on the current page."""
    page_number: int = 1


def open_panels(
    gallery: Gallery, breadcrumbs: str, header: str, width: float = CONTROLS_WIDTH
) -> viser.PanelHandle:
    """Open the panel of thumbnails at the left and the panel of controls at the right.

    Args:
        gallery: The gallery.
        breadcrumbs: HTML of the path to the page.
        header: HTML above the controls.
        width: Width of the controls [pixels].

    Returns:
        The panel at the left.
    """
    client = gallery.session.client
    gui = client.gui
    gallery.session.open_panel(width, breadcrumbs + (markup.framed(header) if header else ""))
    panel = gui.add_panel()
    with panel.add_tab(gallery.title, viser.Icon.LAYOUT_GRID):
        gallery.grid = gui.add_html("")
    panel.dock_left()
    panel.set_width(max(gallery.session.width - width - CANVAS_WIDTH, 400.0))
    return panel


def add_controls(gallery: Gallery) -> None:
    """Add the controls, in the state that the address gives, and show the first robots."""
    gui, state = gallery.session.client.gui, gallery.session.address.state
    controls = gallery.controls

    def add_dropdown(key: str, label: str, options: Sequence[str], value: str) -> None:
        initial = value if value in options else options[0]
        controls[key] = gui.add_dropdown(label, tuple(options), initial_value=initial)

    controls["search"] = gui.add_text("Search", state.get("search", ""))
    scales = (gallery.scale, *(name for name in SCALES if name != gallery.scale))
    add_dropdown("scale", "Scale", scales, state.get("scale", ""))
    labels = {key: label for label, key in _SORT_KEYS.items()}
    add_dropdown("sort", "Sort by", list(_SORT_KEYS), labels.get(state.get("sort", ""), ""))
    is_filtered = not state.keys().isdisjoint(
        {"category", "role", "findings", "size", *robot_rows.NUMBERS}
    )
    with gui.add_folder("Filter", expand_by_default=is_filtered):
        for key, label in (("category", "Category"), ("role", "Role")):
            if len(options := robot_rows.fact_choices(gallery.rows, key)) > 1:
                add_dropdown(key, label, [_ALL, *options], state.get(key, _ALL))
        findings = [_ALL, "with", "without"]
        add_dropdown("findings", "Findings", findings, state.get("findings", _ALL))
        for fact in robot_rows.NUMBERS:
            _add_range(gallery, fact)
        add_dropdown(
            "size", "On a page", list(map(str, robot_rows.PAGE_SIZES)), state.get("size", "")
        )
    gallery.page_number = parse_count(state.get("n", ""), 1)
    buttons = gui.add_button_group("Page", tuple(_PAGE_BUTTONS))

    def turn_page() -> None:
        show_page(gallery, _PAGE_BUTTONS[buttons.value](gallery.page_number))

    for control in controls.values():
        gallery.session.on_change(control, lambda: show_page(gallery, 1), "filter")
    gallery.session.on_change(buttons, turn_page)
    show_page(gallery, gallery.page_number)


def passing_rows(gallery: Gallery) -> list[robot_rows.Row]:
    """Return the robots that pass the filter, on all pages, in the order of the set."""
    return robot_rows.sort_rows(filter(_current_filter(gallery).passes, gallery.rows), "order")


def shown_rows(gallery: Gallery) -> list[robot_rows.Row]:
    """Return the robots that pass the filter, on all pages, in the order that is shown."""
    sort = _SORT_KEYS[gallery.controls["sort"].value]
    return robot_rows.sort_rows(filter(_current_filter(gallery).passes, gallery.rows), sort)


def show_saved(session: Session, path: Path, text: viser.GuiHtmlHandle) -> None:
    """Show that a split was written, and the command that audits it."""
    name = str(path.relative_to(session.files.roots[0]))
    text.content = markup.framed(markup.code(f"morphgen split audit {shlex.quote(name)}"))
    session.notify("Saved", name)


def card(row: robot_rows.Row, thumbnail: str, fault: str, share: float = 1.0) -> str:
    """Return a robot's card in the grid: a link to its page, and a check box that chooses it.

    Args:
        row: The robot.
        thumbnail: Its picture as a ``data:`` URL; empty while there is none.
        fault: Why it cannot be read; else empty.
        share: Size of the picture within the card, at most 1.
    """
    shrunk = f' style="transform:scale({share:.3f})"' if share < 1 else ""
    image = f'<div class="picture"><img alt="" src="{thumbnail}"{shrunk}></div>'
    if not thumbnail:
        image = f'<div class="empty">{"broken" if fault else "…"}</div>'
    tags = markup.tag(row.role, row.role) if row.role else ""
    if row.task:
        tags += markup.tag(row.task)
    if row.findings:
        tags += markup.tag(", ".join(row.findings[:2]), "error" if fault else "warning")
    facts = robot_rows.facts_line(row) or escape(row.category)
    query = escape(Address("robot", (row.uri,)).query)
    return (
        f'<div class="cell"><a class="card" href="{query}" title="{escape(fault or row.uri)}">'
        f'{image}<div class="text"><div class="name">{escape(row.name)}</div>'
        f"{markup.dim(facts)}{tags}</div></a>{'' if fault else markup.choose_box(row.uri)}</div>"
    )


def shares(gallery: Gallery, rows: Iterable[robot_rows.Row]) -> tuple[list[float], float]:
    """Return the size of each picture, and the height that a whole card shows [m].

    Args:
        gallery: The gallery; at its own scale every size is 1, and the height NaN.
        rows: Robots of the gallery; those of unknown size get 1.
    """
    heights = [row.picture_height or math.nan for row in rows]
    known = [row.picture_height for row in gallery.rows if row.picture_height]
    if gallery.controls["scale"].value == "own" or not known:
        return [1.0] * len(heights), math.nan
    tallest = max(known)
    return [1.0 if math.isnan(height) else height / tallest for height in heights], tallest


def show_page(gallery: Gallery, number: int) -> None:
    """Show a page of the robots that pass the filter, and request missing thumbnails."""
    session, controls, rows = gallery.session, gallery.controls, shown_rows(gallery)
    sort = _SORT_KEYS[controls["sort"].value]
    size = int(controls["size"].value)
    gallery.page_rows, gallery.page_number, count = robot_rows.select_page(rows, number, size)
    state = {key: str(control.value) for key, control in controls.items()}
    state |= {fact: _range_text(gallery, fact) for fact in robot_rows.NUMBERS if fact in controls}
    state |= {"sort": sort, "n": str(gallery.page_number)}
    defaults = {
        "sort": "order",
        "n": "1",
        "size": str(robot_rows.PAGE_SIZES[0]),
        "scale": gallery.scale,
    }
    for key, value in state.items():
        if value == defaults.get(key, _ALL) and key != "search":
            state[key] = ""
    session.update_address(gallery.title, **state)
    total = "" if len(rows) == len(gallery.rows) else f" of {len(gallery.rows)}"
    gallery.summary = f"{len(rows)}{total} robots · page {gallery.page_number} of {count}"
    _load_bundle_pictures(gallery, gallery.page_rows)
    _show_histograms(gallery)
    _draw_grid(gallery)
    session.run_in_background(lambda: _draw_missing(gallery), "thumbnails")


def _current_filter(gallery: Gallery) -> robot_rows.Filter:
    """Return the filter that the controls are set to."""
    values = {
        key: "" if control.value == _ALL and key != "search" else control.value
        for key, control in gallery.controls.items()
        if key not in robot_rows.NUMBERS
    }
    ranges = {}
    for fact in robot_rows.NUMBERS:
        if fact in gallery.controls and _range_text(gallery, fact):
            low, high = gallery.controls[fact].value
            ranges[fact] = (low - 1e-9, high + 1e-9)  # browsers round
    return robot_rows.Filter(
        values["search"],
        values.get("category", ""),
        values.get("role", ""),
        values["findings"],
        ranges,
    )


def _draw_grid(gallery: Gallery) -> None:
    """Draw the cards of the current page, in a column for each role if there are columns."""
    if gallery.grid is None:
        return
    columns: dict[str, list[str]] = {role: [] for role in gallery.columns}
    sizes, height = shares(gallery, gallery.page_rows)
    for row, share in zip(gallery.page_rows, sizes, strict=True):
        thumbnail, fault = gallery.thumbnails.get(row.uri, ""), gallery.faults.get(row.uri, "")
        role = row.role if gallery.columns else ""
        columns.setdefault(role, []).append(card(row, thumbnail, fault, share))
    html = [
        f"<div>{f'<h3>{role} ({len(cards)})</h3>' if role else ''}"
        f'<div class="grid">{"".join(cards)}</div></div>'
        for role, cards in columns.items()
    ]
    scale = "" if math.isnan(height) else f" · a card is {height:.2g} m high"
    summary = f'<div class="dim" style="padding:.6em 0">{gallery.summary}{scale}</div>'
    if not gallery.page_rows:
        html = [markup.dim("No robot passes the filter: change the search, or widen the ranges.")]
    gallery.grid.content = markup.framed(summary, f'<div class="columns">{"".join(html)}</div>')


def load_pictures(gallery: Gallery, rows: Sequence[robot_rows.Row]) -> None:
    """Load or draw the pictures of rows that have none yet, and measure their scale if needed."""
    _load_bundle_pictures(gallery, rows)
    _request_missing(gallery, rows, lambda: True)


def _load_bundle_pictures(gallery: Gallery, rows: Iterable[robot_rows.Row]) -> None:
    """Load the pictures that bundles have, for robots whose facts are known."""
    for row in rows:
        if row.uri in gallery.thumbnails or ":" in row.uri:
            continue
        path = gallery.session.files.path(row.uri) / PICTURE
        thumbnail = thumbnail_of_picture(path) if path.is_file() else ""
        if thumbnail and row.dof is not None:
            gallery.thumbnails[row.uri] = thumbnail


def _draw_missing(gallery: Gallery) -> None:
    """Let the workers draw the page's missing thumbnails; retry once if a worker dies."""
    rows = gallery.page_rows

    def is_current() -> bool:
        """Return whether the page still shows these robots; otherwise thumbnails can wait."""
        return gallery.page_rows is rows

    try:
        _request_missing(gallery, rows, is_current)
    except WorkerDied:
        gallery.session.notify("A worker died", "another one continues with the thumbnails")
        _request_missing(gallery, rows, is_current)


def _request_missing(
    gallery: Gallery, rows: Sequence[robot_rows.Row], is_wanted: Callable[[], bool]
) -> None:
    """Draw missing thumbnails in the workers, and show them as they arrive."""
    session, workers = gallery.session, gallery.session.workers
    pending = {}
    for row in rows:
        if row.uri in gallery.faults:
            continue
        if row.uri not in gallery.thumbnails:
            pending[row.uri] = workers.submit(make_thumbnail, row.uri, session.files)
        elif row.picture_height is None and gallery.controls["scale"].value == "common":
            pending[row.uri] = workers.submit(measure_picture, row.uri, session.files)
    total = len(pending)
    while pending and not session.closed.is_set() and is_wanted():
        session.set_status(f"drawing {total} robots", (total - len(pending)) / total)
        wait(pending.values(), timeout=REFRESH_INTERVAL, return_when=FIRST_COMPLETED)
        for uri in [uri for uri, future in pending.items() if future.done()]:
            _store_thumbnail(gallery, uri, workers.result(pending.pop(uri)))
        _draw_grid(gallery)
    for future in pending.values():
        future.cancel()
    session.set_status("")


def _store_thumbnail(gallery: Gallery, uri: str, thumbnail: Thumbnail) -> None:
    if thumbnail.error:
        gallery.faults[uri] = thumbnail.error
    elif thumbnail.image:
        gallery.thumbnails[uri] = thumbnail.image
    facts: dict[str, Any] = thumbnail.facts
    for rows in (gallery.rows, gallery.page_rows):
        rows[:] = [replace(row, **facts) if row.uri == uri else row for row in rows]


def _add_range(gallery: Gallery, fact: str) -> None:
    """Add a slider with two ends for a fact that varies."""
    limits = robot_rows.fact_range(gallery.rows, fact)
    if limits is None:
        return
    step = 1.0 if fact == "dof" else 0.001
    low, high = limits[0] - limits[0] % step, limits[1] + (-limits[1]) % step
    text = gallery.session.address.state.get(fact, "")
    gallery.histograms[fact] = gallery.session.client.gui.add_html("")
    gallery.controls[fact] = gallery.session.client.gui.add_multi_slider(
        _RANGE_LABELS[fact], low, high, step, _parse_range(text, low, high)
    )


def _show_histograms(gallery: Gallery) -> None:
    """Show how many robots have each value of a fact; those that the slider lets pass stand out."""
    for fact, handle in gallery.histograms.items():
        values = [float(v) for row in gallery.rows if (v := getattr(row, fact)) is not None]
        control = gallery.controls[fact]
        low, high = control.value
        svg = figures.histogram_svg(values, (control.min, control.max), (low, high))
        handle.content = markup.framed(svg)


def _parse_range(text: str, low: float, high: float) -> tuple[float, float]:
    """Parse ``LOW..HIGH``, clipped to limits; invalid text gives the limits."""
    first, dots, last = text.partition("..")
    try:
        ends = (float(first), float(last)) if dots else (low, high)
    except ValueError:
        ends = (low, high)
    start, end = (min(max(value, low), high) for value in ends)
    return (start, max(start, end))


def _range_text(gallery: Gallery, fact: str) -> str:
    """Return a range slider's value for the address; empty if it lets every known value pass."""
    low, high = gallery.controls[fact].value
    limits = robot_rows.fact_range(gallery.rows, fact)
    if limits is None or (low <= limits[0] and high >= limits[1]):
        return ""
    return f"{low:g}..{high:g}"
