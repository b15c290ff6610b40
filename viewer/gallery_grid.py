"""Galleries: thumbnails of robots to filter, sort and open."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from dataclasses import dataclass, field
from html import escape
from typing import Any

import viser

from morphgen.formats.bundle import PICTURE
from morphgen.viewer import markup
from morphgen.viewer.address import Address, whole_number
from morphgen.viewer.entries import (
    NUMBERS,
    PAGE_SIZES,
    SORTS,
    Entry,
    Filter,
    choices,
    extent,
    facts_line,
    filtered,
    ordered,
    paged,
    with_facts,
)
from morphgen.viewer.robot_files import Portrait, ask, thumbnail_of_picture
from morphgen.viewer.session import Session, later, notify, say, show_state, when
from morphgen.viewer.workers import WorkerDied, Workers

REFRESH = 0.6
"""How often a gallery shows the portraits that were made since, seconds."""
SIDE = 330.0
"""Width of the controls, pixels."""
CANVAS = 120.0
"""Width that viser keeps for its scene, pixels."""
_ALL = "all"
_STEPS: Mapping[str, Callable[[int], int]] = {
    "first": lambda n: 1,
    "prev": lambda n: n - 1,
    "next": lambda n: n + 1,
    "last": lambda n: 10**9,
}
_UNITS = {"dof": "DoF", "reach": "Reach (m)", "mass": "Mass (kg)"}


@dataclass(eq=False)
class Gallery:
    """A gallery in one browser."""

    session: Session
    title: str
    entries: list[Entry]
    portraits: dict[str, str] = field(default_factory=dict)
    """Thumbnails that are known, by place."""
    faults: dict[str, str] = field(default_factory=dict)
    """Why there is no robot, by place."""
    controls: dict[str, Any] = field(default_factory=dict)
    grid: viser.GuiHtmlHandle | None = None
    about: str = ""
    """How many robots pass the filter, and which of them are shown."""
    shown: list[Entry] = field(default_factory=list)
    number: int = 1
    columns: tuple[str, ...] = ()
    """Roles that are shown beside each other; by default all robots are in one grid."""


def open_panels(gallery: Gallery, crumbs: str, about: str, side: float = SIDE) -> None:
    """The thumbnails at the left, the controls at the right.

    Args:
        gallery: What is shown.
        crumbs: The way to the page.
        about: HTML that stands above the controls.
        side: Width of the controls, pixels.
    """
    client = gallery.session.client
    gui = client.gui
    gui.set_panel_label("morphgen")
    gui.main_panel.dock_right()
    gui.main_panel.set_width(side)
    gui.add_html(markup.STYLE + crumbs + (markup.framed(about) if about else ""))
    gallery.session.status = gui.add_html("")
    panel = gui.add_panel()
    with panel.add_tab(gallery.title, viser.Icon.LAYOUT_GRID):
        gallery.grid = gui.add_html("")
    panel.dock_left()
    panel.set_width(max(client.camera.image_width - side - CANVAS, 400.0))


def build(gallery: Gallery) -> None:
    """Add a gallery's controls and thumbnails to the panel."""
    gui, state = gallery.session.client.gui, gallery.session.address.state
    controls = gallery.controls
    controls["search"] = gui.add_text("Search", state.get("search", ""))
    first = _sort_label(state.get("sort", "order"))
    controls["sort"] = _dropdown(gui, "Sort by", list(_SORT_KEYS), first)
    with gui.add_folder("Filter", expand_by_default=_is_filtered(state)):
        for key, label in (("category", "Category"), ("role", "Role")):
            options = choices(gallery.entries, key)
            if len(options) > 1:
                options = [_ALL, *options]
                controls[key] = _dropdown(gui, label, options, state.get(key, _ALL))
        options = [_ALL, "with", "without"]
        controls["findings"] = _dropdown(gui, "Findings", options, state.get("findings", _ALL))
        for fact in NUMBERS:
            _add_range(gallery, fact)
        sizes = [str(size) for size in PAGE_SIZES]
        controls["size"] = _dropdown(gui, "On a page", sizes, state.get("size", sizes[0]))
    gallery.number = whole_number(state.get("n", ""), 1)
    turn = gui.add_button_group("Page", tuple(_STEPS))
    for control in controls.values():
        when(control, gallery.session, lambda: _refilter(gallery), "filter")
    when(turn, gallery.session, lambda: _turn(gallery, turn.value))
    refresh(gallery)


def refresh(gallery: Gallery) -> None:
    """Show the rows that the controls ask for, and have missing portraits made."""
    session, controls = gallery.session, gallery.controls
    sort = _SORT_KEYS[controls["sort"].value]
    rows = ordered(filtered(gallery.entries, wanted(gallery)), sort)
    size = int(controls["size"].value)
    gallery.shown, gallery.number, count = paged(rows, gallery.number, size)
    state = {
        key: "" if str(control.value) == _ALL else str(control.value)
        for key, control in controls.items()
        if key not in NUMBERS
    }
    state |= {"sort": "" if sort == "order" else sort, "n": str(gallery.number)}
    state |= {fact: _range_text(gallery, fact) for fact in NUMBERS if fact in controls}
    if state["n"] == "1":
        state["n"] = ""
    if state["size"] == str(PAGE_SIZES[0]):
        state["size"] = ""
    show_state(session, gallery.title, **state)
    all_of = "" if len(rows) == len(gallery.entries) else f" of {len(gallery.entries)}"
    gallery.about = f"{len(rows)}{all_of} robots · page {gallery.number} of {count}"
    _take_pictures(gallery)
    _draw(gallery)
    later(session, lambda: _have_portraits_made(gallery), "portraits")


def passing(gallery: Gallery) -> list[Entry]:
    """The rows that pass the filter, on all pages."""
    return ordered(filtered(gallery.entries, wanted(gallery)), "order")


def wanted(gallery: Gallery) -> Filter:
    """The filter that the controls ask for."""
    values = {
        key: "" if control.value == _ALL else control.value
        for key, control in gallery.controls.items()
        if key not in NUMBERS
    }
    ranges: dict[str, tuple[float, float]] = {}
    for fact in NUMBERS:
        whole = extent(gallery.entries, fact)
        if whole is None or fact not in gallery.controls:
            continue
        low, high = gallery.controls[fact].value
        if not _is_whole((low, high), whole):
            ranges[fact] = (low - 1e-9, high + 1e-9)
    return Filter(
        values["search"],
        values.get("category", ""),
        values.get("role", ""),
        values["findings"],
        ranges,
    )


def card(entry: Entry, thumbnail: str, fault: str) -> str:
    """A robot in the grid, a link to its page."""
    picture = f'<img alt="" src="{thumbnail}">'
    if not thumbnail:
        picture = f'<div class="empty">{"broken" if fault else "…"}</div>'
    tags = markup.tag(entry.role, entry.role) if entry.role else ""
    if entry.task:
        tags += markup.tag(entry.task)
    if entry.findings:
        kind = "error" if fault else "warning"
        tags += markup.tag(", ".join(entry.findings[:2]), kind)
    about = facts_line(entry) or escape(entry.category)
    address = Address("robot", (entry.place,))
    return (
        f'<a class="card" href="{escape(address.query)}" title="{escape(fault or entry.place)}">'
        f'{picture}<div class="text"><div class="name">{escape(entry.name)}</div>'
        f'<div class="dim">{about}</div>{tags}</div></a>'
    )


def _draw(gallery: Gallery) -> None:
    if gallery.grid is None:
        return
    cards = [
        card(entry, gallery.portraits.get(entry.place, ""), gallery.faults.get(entry.place, ""))
        for entry in gallery.shown
    ]
    about = f'<div class="dim" style="padding:.6em 0">{gallery.about}</div>'
    groups: dict[str, list[str]] = {role: [] for role in gallery.columns}
    for entry, text in zip(gallery.shown, cards, strict=True):
        groups.setdefault(entry.role if gallery.columns else "", []).append(text)
    columns = [
        f"<div>{f'<h3>{role} ({len(grid)})</h3>' if role else ''}"
        f'<div class="grid">{"".join(grid)}</div></div>'
        for role, grid in groups.items()
    ]
    gallery.grid.content = markup.framed(about, f'<div class="columns">{"".join(columns)}</div>')


def _take_pictures(gallery: Gallery) -> None:
    """Thumbnails of bundles that have a picture."""
    for entry in gallery.shown:
        if entry.place in gallery.portraits or ":" in entry.place:
            continue
        path = gallery.session.places.path(entry.place) / PICTURE
        thumbnail = thumbnail_of_picture(path) if path.is_file() else ""
        if thumbnail and entry.dof is not None:
            gallery.portraits[entry.place] = thumbnail


def _have_portraits_made(gallery: Gallery) -> None:
    """Let the workers draw what is missing of the rows shown; once more if one of them dies."""
    try:
        _ask_for_missing(gallery)
    except WorkerDied:
        notify(gallery.session, "A worker died", "another one goes on with the thumbnails")
        _ask_for_missing(gallery)


def _ask_for_missing(gallery: Gallery) -> None:
    """Have thumbnails drawn; what is done is shown meanwhile."""
    session = gallery.session
    rows = gallery.shown
    known = gallery.portraits.keys() | gallery.faults.keys()
    missing = [entry for entry in rows if entry.place not in known]
    waiting = {entry.place: ask(session.workers, entry.place, session.places) for entry in missing}
    total = len(waiting)
    while waiting and not session.closed.is_set() and gallery.shown is rows:
        say(session, f"drawing {total} robots", (total - len(waiting)) / total)
        for place, found in _collected(session.workers, waiting).items():
            _keep(gallery, place, found)
        _draw(gallery)
    for future in waiting.values():
        future.cancel()
    say(session, "")


def _collected(workers: Workers, waiting: dict[str, Future[Portrait]]) -> dict[str, Portrait]:
    """Wait a while for portraits; those that are done are taken out."""
    wait(waiting.values(), timeout=REFRESH, return_when=FIRST_COMPLETED)
    done = [place for place, future in waiting.items() if future.done()]
    return {place: workers.result(waiting.pop(place)) for place in done}


def _keep(gallery: Gallery, place: str, found: Portrait) -> None:
    if found.error:
        gallery.faults[place] = found.error
    else:
        gallery.portraits[place] = found.thumbnail

    def updated(entry: Entry) -> Entry:
        return with_facts(entry, found.facts) if entry.place == place else entry

    gallery.entries[:] = map(updated, gallery.entries)
    gallery.shown[:] = map(updated, gallery.shown)


def _refilter(gallery: Gallery) -> None:
    gallery.number = 1
    refresh(gallery)


def _turn(gallery: Gallery, where: str) -> None:
    gallery.number = _STEPS[where](gallery.number)
    refresh(gallery)


def _sort_label(key: str) -> str:
    name = key.removeprefix("-")
    return f"{name}, largest first" if key != name else name


_SORT_KEYS = {_sort_label(key): key for name in SORTS for key in (name, f"-{name}")}


def _dropdown(
    gui: viser.GuiApi, label: str, options: Sequence[str], value: str
) -> viser.GuiDropdownHandle[str]:
    chosen = value if value in options else options[0]
    return gui.add_dropdown(label, tuple(options), initial_value=chosen)


def _add_range(gallery: Gallery, fact: str) -> None:
    """A slider with two ends, where there is a range at all."""
    whole = extent(gallery.entries, fact)
    if whole is None:
        return
    step = 1.0 if fact == "dof" else 0.001
    low, high = whole[0] - whole[0] % step, whole[1] + (-whole[1]) % step
    chosen = _parse_range(gallery.session.address.state.get(fact, ""), (low, high))
    gallery.controls[fact] = gallery.session.client.gui.add_multi_slider(
        _UNITS[fact], low, high, step, chosen
    )


def _parse_range(text: str, whole: tuple[float, float]) -> tuple[float, float]:
    low, dots, high = text.partition("..")
    try:
        found = (float(low), float(high)) if dots else whole
    except ValueError:
        return whole
    low_value, high_value = (min(max(value, whole[0]), whole[1]) for value in found)
    return (low_value, max(low_value, high_value))


def _range_text(gallery: Gallery, fact: str) -> str:
    low, high = gallery.controls[fact].value
    whole = extent(gallery.entries, fact)
    if whole is None or _is_whole((low, high), whole):
        return ""
    return f"{low:g}..{high:g}"


def _is_whole(chosen: tuple[float, ...], whole: tuple[float, float]) -> bool:
    return chosen[0] <= whole[0] and chosen[1] >= whole[1]


def _is_filtered(state: object) -> bool:
    keys = {"category", "role", "findings", "size", *NUMBERS}
    return isinstance(state, dict) and bool(keys & state.keys())
