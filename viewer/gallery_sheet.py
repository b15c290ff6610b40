"""The buttons of a gallery that download its robots as a contact sheet."""

from __future__ import annotations

import functools

import viser

from morphgen.errors import MorphgenError
from morphgen.viewer.contact_sheet import Cell, contact_sheet
from morphgen.viewer.gallery_cards import Gallery, shares
from morphgen.viewer.gallery_filter import shown_rows
from morphgen.viewer.gallery_pictures import load_pictures
from morphgen.viewer.robot_rows import facts_line

MAX_ROBOTS = 240
"""Robots of one sheet."""


def add_sheet_buttons(gallery: Gallery) -> None:
    """Add buttons for a PNG and a PDF of the robots that pass the filter, on all pages."""
    gui, session = gallery.session.client.gui, gallery.session
    with gui.add_folder("Contact sheet", expand_by_default=False):
        for suffix in ("png", "pdf"):
            button = gui.add_button(f"Download as {suffix.upper()}", icon=viser.Icon.DOWNLOAD)
            send = functools.partial(_send, gallery, suffix)
            session.on_change(button, functools.partial(session.run_in_background, send))


def _send(gallery: Gallery, suffix: str) -> None:
    session, rows = gallery.session, shown_rows(gallery)
    if not 1 <= len(rows) <= MAX_ROBOTS:
        raise MorphgenError(
            f"{len(rows)} robots for a contact sheet; expected 1 to {MAX_ROBOTS}: use the filter"
        )
    load_pictures(gallery, rows)
    rows = shown_rows(gallery)  # with the facts that were measured meanwhile
    sizes, height = shares(gallery, rows)
    cells = [
        Cell(gallery.thumbnails.get(row.uri, ""), row.name, facts_line(row), share)
        for row, share in zip(rows, sizes, strict=True)
    ]
    session.set_status("drawing the sheet")
    content = session.run_in_worker(contact_sheet, gallery.title, cells, height, suffix)
    name = f"{gallery.title.strip('/').replace('/', '-')}.{suffix}"
    session.client.send_file_download(name, content, save_immediately=True)
    session.set_status("")
