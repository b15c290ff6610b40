"""A grid of thumbnails that is searched, filtered, sorted and paged by controls beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import viser

from morphgen.viewer import markup, robot_rows
from morphgen.viewer.address import parse_count
from morphgen.viewer.gallery_cards import Gallery, draw_cards
from morphgen.viewer.gallery_filter import (
    add_filter,
    brush,
    clear_filter,
    control_state,
    empty_text,
    show_coordinates,
    show_histograms,
    shown_rows,
)
from morphgen.viewer.gallery_pictures import draw_missing, load_bundle_pictures

CONTROLS_WIDTH = 330.0
"""Width of the controls [pixels]."""
CANVAS_WIDTH = 120.0
"""Width that viser keeps free for its scene between the panels [pixels]."""
_PAGE_BUTTONS: Mapping[str, Callable[[int], int]] = {
    "first": lambda number: 1,
    "prev": lambda number: number - 1,
    "next": lambda number: number + 1,
    "last": lambda number: 10**9,  # clipped to the last page
}


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
    gallery.panel_width = max(gallery.session.width - width - CANVAS_WIDTH, 400.0)
    panel.set_width(gallery.panel_width)
    return panel


def add_controls(gallery: Gallery, panel: viser.PanelHandle) -> None:
    """Add the controls, in the state that the address gives, and show the first robots.

    Args:
        gallery: The gallery.
        panel: Panel of the thumbnails, which gets a tab for the parallel coordinates.
    """
    session = gallery.session
    add_filter(gallery)
    if len(gallery.histograms) > 1:
        with panel.add_tab("Parallel coordinates", viser.Icon.CHART_LINE):
            gallery.coordinates = session.client.gui.add_html("")
    gallery.page_number = parse_count(session.address.state.get("n", ""), 1)
    buttons = session.client.gui.add_button_group("Page", tuple(_PAGE_BUTTONS))

    def turn_page() -> None:
        show_page(gallery, _PAGE_BUTTONS[buttons.value](gallery.page_number))

    def changed() -> None:
        gallery.notices.clear()
        show_page(gallery, 1)

    def clear(key: str) -> None:
        clear_filter(gallery, key)
        changed()

    def choose_range(text: str) -> None:
        brush(gallery, text)
        changed()

    for control in gallery.controls.values():
        session.on_change(control, changed, "filter")
    session.on_change(buttons, turn_page)
    session.actions |= {"clear filter": clear, "brush": choose_range}
    show_page(gallery, gallery.page_number)


def show_page(gallery: Gallery, number: int) -> None:
    """Show a page of the robots that pass the filter, and request missing thumbnails."""
    session, rows, state = gallery.session, shown_rows(gallery), control_state(gallery)
    size = int(gallery.controls["size"].value)
    gallery.page_rows, gallery.page_number, count = robot_rows.select_page(rows, number, size)
    page = "" if gallery.page_number == 1 else str(gallery.page_number)
    session.update_address(gallery.title, n=page, **state)
    total = "" if len(rows) == len(gallery.rows) else f" of {len(gallery.rows)}"
    noun = gallery.noun if len(gallery.rows) == 1 else f"{gallery.noun}s"
    gallery.summary = f"{len(rows)}{total} {noun} · page {gallery.page_number} of {count}"
    gallery.empty = "" if rows else empty_text(gallery)
    load_bundle_pictures(gallery, gallery.page_rows)
    show_histograms(gallery)
    show_coordinates(gallery)
    draw_cards(gallery)
    session.run_in_background(lambda: draw_missing(gallery), "thumbnails")
