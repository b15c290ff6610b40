"""The pages that are galleries: all parts (the first page), and a folder; indexes."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from contextlib import suppress
from dataclasses import dataclass, field
from html import escape
from typing import Any

import viser

from morphgen.formats.bundle import PICTURE
from morphgen.grammar.grammar_file import grammar_names
from morphgen.rl.demonstrations.lerobot import RECORDING
from morphgen.splits.split import (
    split_names,
)
from morphgen.viewer import markup, robot_rows
from morphgen.viewer.app.address import Address, AddressError, parse_count
from morphgen.viewer.app.frame import call
from morphgen.viewer.app.session import Session, bind, set_value
from morphgen.viewer.app.uploads import store_upload
from morphgen.viewer.robot_files import Thumbnail, make_thumbnail, thumbnail_of_picture
from morphgen.viewer.robot_uri import (
    DEFAULT_WORDS,
    FileAccess,
)


@dataclass(eq=False)
class Gallery:
    """A gallery in one browser."""

    session: Session
    title: str
    rows: list[robot_rows.Row]  # all robots, shown or not
    columns: tuple[str, ...] = ()  # roles in a column each; without any, there is one grid
    noun: str = "robot"  # what a row shows: a robot, or a part of the library
    thumbnails: dict[str, str] = field(default_factory=dict)  # thumbnails drawn so far, by URI
    faults: dict[str, str] = field(default_factory=dict)  # errors of unreadable robots, by URI
    controls: dict[str, Any] = field(default_factory=dict)  # controls by their key in the address
    grid: viser.GuiHtmlHandle | None = None
    summary: str = ""  # number of robots that pass the filter, and of the page
    page_rows: list[robot_rows.Row] = field(default_factory=list)  # robots on the current page
    page_number: int = 1


EMPTY = "<h3>No robot passes the filter</h3>"  # HTML in place of the cards


def card(row: robot_rows.Row, thumbnail: str, fault: str) -> str:
    """Return a robot's card in the grid: a link to its page, and a check box that chooses it."""
    image = f'<div class="picture"><img alt="" src="{thumbnail}"></div>'
    if not thumbnail:
        image = f'<div class="empty">{"broken" if fault else "…"}</div>'
    tags = markup.tag(row.role, row.role) if row.role else ""
    if row.task:
        tags += markup.tag(row.task)
    if row.findings:
        tags += markup.tag(", ".join(row.findings[:2]), "error" if fault else "warning")
    facts = robot_rows.facts_line(row) or escape(row.category)
    if row.licence:
        facts += f"<br>{escape(row.licence)}"
    query = escape(Address("robot", (row.uri,)).query)
    return (
        f'<div class="cell"><a class="card" href="{query}" title="{escape(fault or row.uri)}" '
        f'aria-keyshortcuts="Space">'
        f'{image}<div class="text"><div class="name">{escape(row.name)}</div>'
        f"{markup.dim(facts)}{tags}</div></a>{'' if fault else markup.choose_box(row.uri)}</div>"
    )


def draw_cards(gallery: Gallery) -> None:
    """Draw the cards of the current page, in a column for each role if there are columns."""
    if gallery.grid is None:
        return
    columns: dict[str, list[str]] = {role: [] for role in gallery.columns}
    for row in gallery.page_rows:
        thumbnail, fault = gallery.thumbnails.get(row.uri, ""), gallery.faults.get(row.uri, "")
        role = row.role if gallery.columns else ""
        columns.setdefault(role, []).append(card(row, thumbnail, fault))
    html = [
        f"<div>{f'<h3>{role} ({len(cards)})</h3>' if role else ''}"
        f'<div class="grid">{"".join(cards)}</div></div>'
        for role, cards in columns.items()
    ]
    summary = f'<div class="dim" style="padding:.6em 0">{gallery.summary}</div>'
    content = f'<div class="columns">{"".join(html)}</div>' if gallery.page_rows else EMPTY
    shown = markup.framed(summary, content)
    if gallery.session.width > NARROW:
        gallery.grid.content = shown
    else:
        gallery.session.run_script(call("cards", shown))


_ALL = "all"
_LABELS = {"dof": "DoF", "links": "Links", "reach": "Reach (m)", "mass": "Mass (kg)"}
_COUNTS = ("dof", "links")  # facts that are integers
_SORTS = [key for name in robot_rows.SORTS for key in (name, f"-{name}")]
"""Keys of the orders: ascending and descending."""


def add_filter(gallery: Gallery) -> None:
    """Add the controls; ``Session.apply_state`` gives them the values of the address."""
    session, gui = gallery.session, gallery.session.client.gui
    gallery.controls["search"] = gui.add_text("Search", "")
    bind(session, "search", gallery.controls["search"])
    _add_dropdown(gallery, "sort", "Sort by", _SORTS)
    is_filtered = not session.address.state.keys().isdisjoint(robot_rows.FILTERS[1:])
    with gui.add_folder("Filter", expand_by_default=is_filtered):
        for key in robot_rows.WORDS_OF_ROWS:
            choices = (_ALL, *robot_rows.fact_choices(gallery.rows, key))
            role = "kind of part" if gallery.noun == "part" else "side"
            label = role if key == "role" else key
            _add_dropdown(gallery, key, label.capitalize(), choices)
        _add_dropdown(gallery, "findings", "Findings", (_ALL, "with", "without"))
        for fact in robot_rows.NUMBERS:
            _add_range(gallery, fact)


def parse_range(fact: str, text: str, limits: tuple[float, float] | None) -> tuple[float, float]:
    """Parse ``LOW..HIGH`` of an address."""
    if limits is None:
        raise AddressError(f"{fact}={text[:40]} was left out: no robot here has a known {fact}")
    first, _, last = text.partition("..")
    with suppress(ValueError):
        low, high = max(float(first), limits[0]), min(float(last), limits[1])
        if low <= high + robot_rows.ROUNDING:
            return low, high
    ends = " to ".join(dict.fromkeys(f"{end:.4g}" for end in limits))
    raise AddressError(
        f"{fact}={text[:40]} was left out; expected LOW..HIGH that overlaps {ends} "
        f"{robot_rows.UNITS[fact]}"
    )


def _add_dropdown(gallery: Gallery, key: str, label: str, keys: Collection[str]) -> None:
    """Add a dropdown, which is shown if there is a choice; the first is the default."""
    gui, labels = gallery.session.client.gui, tuple(keys)
    if key == "sort":
        labels = tuple(map(_sort_label, keys))
    gallery.controls[key] = gui.add_dropdown(label, labels, visible=len(keys) > 1)
    bind(gallery.session, key, gallery.controls[key], tuple(keys))


def _sort_label(key: str) -> str:
    """Return the text of an order, such as ``reach, largest first``."""
    name = key.removeprefix("-")
    last = {"order": "last first", "name": "Z to A"}.get(name, "largest first")
    return f"{name}, {last}" if key != name else name


def _add_range(gallery: Gallery, fact: str) -> None:
    """Add a slider with two ends for a fact that varies."""
    session, gui = gallery.session, gallery.session.client.gui
    limits = robot_rows.fact_range(gallery.rows, fact)
    if limits is None or limits[0] == limits[1]:
        session.keep(fact, lambda: "", lambda text: parse_range(fact, text, limits))
        return
    step = 1.0 if fact in _COUNTS else 0.001
    low, high = limits[0] - limits[0] % step, limits[1] + (-limits[1]) % step
    slider = gui.add_multi_slider(_LABELS[fact], low, high, step, (low, high))
    gallery.controls[fact] = slider

    def write() -> str:
        """Return the range for the address; empty if it lets every known value pass."""
        low, high = slider.value
        known = robot_rows.fact_range(gallery.rows, fact) or limits
        return "" if low <= known[0] and high >= known[1] else f"{low:g}..{high:g}"

    def apply(text: str) -> None:
        first, last = parse_range(fact, text, limits)
        ends = low if first == limits[0] else first, high if last == limits[1] else last
        set_value(slider, ends)

    session.keep(fact, write, apply)


REFRESH_INTERVAL = 0.6  # time after which a gallery shows the thumbnails drawn meanwhile [s]


def load_bundle_pictures(gallery: Gallery, rows: Iterable[robot_rows.Row]) -> None:
    """Load the pictures that bundles have, for robots whose facts are known."""
    for row in rows:
        if row.uri in gallery.thumbnails or ":" in row.uri:
            continue
        path = gallery.session.files.path(row.uri) / PICTURE
        thumbnail = thumbnail_of_picture(path) if path.is_file() else ""
        if thumbnail and row.dof is not None:
            gallery.thumbnails[row.uri] = thumbnail


def load_pictures(
    gallery: Gallery, rows: Sequence[robot_rows.Row], is_wanted: Callable[[], bool] = lambda: True
) -> None:
    """Load pictures that rows lack, or draw them in the workers, and show them as they arrive."""
    load_bundle_pictures(gallery, rows)
    session, workers = gallery.session, gallery.session.workers
    pending = {}
    for row in rows:
        if row.uri not in gallery.faults and row.uri not in gallery.thumbnails:
            pending[row.uri] = workers.submit(make_thumbnail, row.uri, session.files)
    total = len(pending)
    while pending and not session.closed.is_set() and is_wanted():
        session.set_status(f"drawing {total} robots", (total - len(pending)) / total)
        wait(pending.values(), timeout=REFRESH_INTERVAL, return_when=FIRST_COMPLETED)
        for uri in [uri for uri, future in pending.items() if future.done()]:
            _store_thumbnail(gallery, uri, workers.result(pending.pop(uri)))
        draw_cards(gallery)
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
        rows[:] = [row.completed(facts) if row.uri == uri else row for row in rows]


CONTROLS_WIDTH = 330.0  # width of the controls [pixels]
CANVAS_WIDTH = 120.0  # width that viser keeps free for its scene between the panels [pixels]
MIN_WIDTH = 240.0  # width of the panel of cards at least [pixels]
NARROW = 576  # width of a window below which viser has one panel, at the bottom [pixels]
PAGE_SIZE = 24  # robots on a page


def open_panels(
    gallery: Gallery, breadcrumbs: str, header: str, width: float = CONTROLS_WIDTH
) -> viser.PanelHandle:
    """Open the panel of controls at the right, and return that of thumbnails at the left."""
    client = gallery.session.client
    gui = client.gui
    # The open panel of cards lies over the strip that viser keeps free for its scene.
    left = '[data-dock-region="left"]:not(:has([data-dock-column-rail]))'
    cover = (
        f"<style>{left}{{width:calc(100% - {width}px)!important}}"
        f"{left} :has(>[data-dock-column]){{width:100%!important}}</style>"
    )
    gallery.session.open_panel(width, breadcrumbs + markup.framed(header) + cover)
    panel = gui.add_panel()
    with panel.add_tab(gallery.title, viser.Icon.LAYOUT_GRID):
        gallery.grid = gui.add_html("")
    panel.dock_left()
    panel.set_width(max(gallery.session.width - width - CANVAS_WIDTH, MIN_WIDTH))
    panel.visible = gallery.session.width > NARROW
    return panel


def add_controls(gallery: Gallery) -> None:
    """Add the controls, in the state that the address gives, and show the first robots."""
    session = gallery.session
    add_filter(gallery)
    session.keep("n", lambda: "" if gallery.page_number == 1 else str(gallery.page_number))
    gallery.page_number = parse_count(session.address.state.get("n", ""), 1)
    session.title = gallery.title
    session.apply_state()
    buttons = session.client.gui.add_button_group("Page", ("first", "prev", "next", "last"))

    def turn_page() -> None:
        number = gallery.page_number
        targets = {"first": 1, "prev": number - 1, "next": number + 1, "last": len(gallery.rows)}
        show_page(gallery, targets[buttons.value])

    for control in gallery.controls.values():
        session.on_change(control, lambda: show_page(gallery, 1), "filter")
    session.on_change(buttons, turn_page)
    show_page(gallery, gallery.page_number)


def show_page(gallery: Gallery, number: int) -> None:
    """Show a page of the robots that pass the filter, and request missing thumbnails."""
    session, state = gallery.session, gallery.session.state()
    passing = (row for row in gallery.rows if robot_rows.passes(row, state))
    rows = robot_rows.sort_rows(passing, state.get("sort") or "order")
    count = max(math.ceil(len(rows) / PAGE_SIZE), 1)
    gallery.page_number = min(max(number, 1), count)
    gallery.page_rows = rows[(gallery.page_number - 1) * PAGE_SIZE :][:PAGE_SIZE]
    session.show_state()
    total = "" if len(rows) == len(gallery.rows) else f" of {len(gallery.rows)}"
    noun = gallery.noun if len(gallery.rows) == 1 else f"{gallery.noun}s"
    gallery.summary = f"{len(rows)}{total} {noun} · page {gallery.page_number} of {count}"
    load_bundle_pictures(gallery, gallery.page_rows)
    draw_cards(gallery)

    def draw_missing() -> None:
        """Draw what the page lacks while it is the current one; other thumbnails can wait."""
        shown = gallery.page_rows
        load_pictures(gallery, shown, lambda: gallery.page_rows is shown)

    session.run_in_background(draw_missing, "thumbnails")


_COMPOSE = Address("compose", (DEFAULT_WORDS,))
INTRODUCTION = (
    "<p>morphgen makes robots from a base, arms and end-effectors, and trains and tests policies "
    f'on many of them.</p><p><a class="button" href="{escape(_COMPOSE.query)}">'
    "Compose a robot</a></p>"
)
"""Text above the gallery of parts: the purpose of morphgen, and the link to Compose."""


def show_library(session: Session) -> None:
    """Build the first page: all parts, links to everything else, and the upload button."""
    gallery = Gallery(session, "Parts", robot_rows.part_rows(session.files.library), noun="part")
    open_panels(gallery, "", INTRODUCTION + section_links(session.files))
    upload = session.client.gui.add_upload_button(
        "Open a URDF, an MJCF or a zip", icon=viser.Icon.UPLOAD
    )

    async def uploaded(event: viser.GuiEvent[viser.GuiUploadButtonHandle]) -> None:
        file = event.target.value

        def open_upload() -> None:
            uri = store_upload(file.name, file.content, session.files)
            session.open_address(Address("robot", (uri,)))

        session.enqueue(open_upload)

    upload.on_upload(uploaded)
    add_controls(gallery)


def show(session: Session) -> None:
    """Build the page of a folder of robots."""
    if not session.address.subject:
        show_index(session)
        return
    folder = session.address.subject
    rows = robot_rows.folder_rows(folder, session.files)
    gallery = Gallery(session, folder, rows)
    names = robot_rows.robot_subfolders(session.files.path(folder))
    below = [f"{folder.rstrip('/')}/{name}" for name in names]
    links = " · ".join(markup.link(Address("gallery", (path,)), path) for path in below)
    population = markup.link(Address("population", (folder,)), "see all on one ground")
    header = population + (f"<br>{links}" if links else "")
    open_panels(gallery, markup.breadcrumbs((folder, None)), header)
    add_controls(gallery)


SPLITS = "splits"  # folder in which new splits are written
INDEX_WIDTH = 620.0  # width of the panel [pixels]
_TITLES = {
    "gallery": "Open the gallery of which robots?",
    "population": "Show which robots on one ground?",
    "split": "Open which split?",
    "demos": "Play which demonstrations?",
}


def show_index(session: Session) -> None:
    """Build the page that asks for the subject of another page, such as a gallery or a split."""
    page = session.address.page
    session.open_panel(INDEX_WIDTH, markup.breadcrumbs((page, None)), left=True)
    html = f"<h2>{_TITLES[page]}</h2>{section_links(session.files, page)}"
    session.client.gui.add_html(markup.framed(html))
    session.show_address(page)


def section_links(files: FileAccess, page: str = "library") -> str:
    """Return links to what a page can show: robots, splits with the user's first, and grammars."""
    root = files.roots[0]
    own = sorted(path.relative_to(root).as_posix() for path in (root / SPLITS).rglob("*.yaml"))

    def section(title: str, names: Sequence[str], targets: Sequence[str], empty: str = "") -> str:
        """Return links to the page, or else to the first target, or a text without any names."""
        target = page if page in targets else targets[0]
        text = " · ".join(markup.link(Address(target, (name,)), name) for name in names)
        return f"<h3>{title}</h3>{text or markup.dim(empty)}"

    html = ""
    if page in ("library", "demos"):
        recorded = sorted(path.parent.name for path in root.glob(f"*/{RECORDING}"))
        empty = "none yet: run <code>morphgen record</code>"
        html += section("Demonstrations in this folder", recorded, ("demos",), empty)
    if page == "demos":
        return html
    if page != "split":
        empty = (
            "none yet: compose a robot and write it to robots/, or run "
            "<code>morphgen sample arm3</code>"
        )
        robots = robot_rows.robot_folders(root)
        html += section("Robots in this folder", robots, ("gallery", "population"), empty)
    empty = "none yet: choose robots in a gallery, then press split"
    html += section("Splits", [*own, *split_names()], ("split", "population"), empty)
    if page == "library":
        html += section("Grammars", grammar_names(), ("compose",))
    return html
