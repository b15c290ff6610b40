"""The cards of a gallery: pictures and facts of robots, at a common scale or each at its own."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from html import escape
from typing import Any

import viser

from morphgen.viewer import markup, robot_rows
from morphgen.viewer.address import Address
from morphgen.viewer.session import Session

SCALES = ("common", "own")
"""Scales of pictures: the same for all robots, or for each one that fills its picture."""


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
    noun: str = "robot"
    """Singular word for what a row of ``rows`` shows: a robot, or a part of the library."""
    thumbnails: dict[str, str] = field(default_factory=dict)
    """Thumbnails drawn so far, by URI."""
    faults: dict[str, str] = field(default_factory=dict)
    """Errors of robots that cannot be read, by URI."""
    controls: dict[str, Any] = field(default_factory=dict)
    """Controls by their key in the address."""
    histograms: dict[str, viser.GuiHtmlHandle] = field(default_factory=dict)
    """Distributions of the facts above their sliders."""
    panel_width: float = 0.0
    """Width of the panel of thumbnails [pixels]."""
    coordinates: viser.GuiHtmlHandle | None = None
    """Parallel coordinates, if at least two facts vary."""
    notices: list[str] = field(default_factory=list)
    """Messages about values of the address that were left out; cleared when a control changes."""
    empty: str = ""
    """HTML in place of the cards if no robot passes the filter."""
    grid: viser.GuiHtmlHandle | None = None
    summary: str = ""
    """Number of robots that pass the filter, and of the page."""
    page_rows: list[robot_rows.Row] = field(default_factory=list)
    """Robots on the current page."""
    page_number: int = 1


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


def draw_cards(gallery: Gallery) -> None:
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
    content = f'<div class="columns">{"".join(html)}</div>' if gallery.page_rows else gallery.empty
    notices = [
        f"<div>{markup.tag('address', 'warning')} {escape(notice)}</div>"
        for notice in gallery.notices
    ]
    gallery.grid.content = markup.framed(*notices, summary, content)
