"""Pictures of a gallery's robots: those that bundles have, and those that workers draw."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from dataclasses import replace
from typing import Any

from morphgen.formats.bundle import PICTURE
from morphgen.viewer.gallery_cards import Gallery, draw_cards
from morphgen.viewer.robot_files import (
    Thumbnail,
    make_thumbnail,
    measure_picture,
    thumbnail_of_picture,
)
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.workers import WorkerDied

REFRESH_INTERVAL = 0.6
"""Time after which a gallery shows the thumbnails that were drawn meanwhile [s]."""


def load_pictures(gallery: Gallery, rows: Sequence[Row]) -> None:
    """Load or draw the pictures of rows that have none yet, and measure their scale if needed."""
    load_bundle_pictures(gallery, rows)
    _request_missing(gallery, rows, lambda: True)


def load_bundle_pictures(gallery: Gallery, rows: Iterable[Row]) -> None:
    """Load the pictures that bundles have, for robots whose facts are known."""
    for row in rows:
        if row.uri in gallery.thumbnails or ":" in row.uri:
            continue
        path = gallery.session.files.path(row.uri) / PICTURE
        thumbnail = thumbnail_of_picture(path) if path.is_file() else ""
        if thumbnail and row.dof is not None:
            gallery.thumbnails[row.uri] = thumbnail


def draw_missing(gallery: Gallery) -> None:
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


def _request_missing(gallery: Gallery, rows: Sequence[Row], is_wanted: Callable[[], bool]) -> None:
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
        rows[:] = [replace(row, **facts) if row.uri == uri else row for row in rows]
