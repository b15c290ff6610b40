"""The page of a folder of robots, from which a new split can be made."""

from __future__ import annotations

from morphgen.errors import BenchmarkError
from morphgen.grammar.robot_set import INDEX
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.gallery import (
    Gallery,
    add_controls,
    add_sheet_buttons,
    open_panels,
    passing_rows,
)
from morphgen.viewer.pages.index import show_index
from morphgen.viewer.robot_rows import Row, folder_rows, robot_subfolders
from morphgen.viewer.splits import ChooseSides, add_split_form


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        show_index(session)
        return
    folder = session.address.subject
    rows = folder_rows(folder, session.files)
    is_set = (session.files.path(folder) / INDEX).is_file()
    gallery = Gallery(session, folder, rows, scale="common" if is_set else "own")
    names = robot_subfolders(session.files.path(folder))
    below = [f"{folder.rstrip('/')}/{name}" for name in names]
    links = " · ".join(markup.link(Address("gallery", (path,)), path) for path in below)
    population = markup.link(Address("population", (folder,)), "see all on one ground")
    header = population + (f"<br>{links}" if links else "")
    panel = open_panels(gallery, markup.breadcrumbs((folder, None)), header)
    add_controls(gallery, panel)
    add_sheet_buttons(gallery)
    hint = "train: pass the filter; test: do not"
    add_split_form(session, lambda: _add_choice(gallery), hint)


def choose_sides(
    rows: list[Row], passing: list[Row], num_train: int, num_test: int
) -> tuple[list[Row], list[Row]]:
    """Return the first rows that pass the filter (train) and the first that do not (test)."""
    uris = {row.uri for row in passing}
    failing = [row for row in rows if row.uri not in uris]
    if len(passing) < num_train or len(failing) < num_test:
        raise BenchmarkError(
            f"{len(passing)} robots pass the filter and {len(failing)} do not: too few for "
            f"{num_train} to train on and {num_test} to test on"
        )
    return passing[:num_train], failing[:num_test]


def _add_choice(gallery: Gallery) -> ChooseSides:
    """Add the numbers of robots on the sides: those that pass the filter, and the others."""
    gui = gallery.session.client.gui
    num_train = gui.add_number("to train on", 10, min=1, step=1)
    num_test = gui.add_number("to test on", 1, min=1, step=1)
    return lambda: choose_sides(
        gallery.rows, passing_rows(gallery), num_train.value, num_test.value
    )
