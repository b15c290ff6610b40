"""The pages that are galleries: all parts (the first page), a folder, chosen robots; indexes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import viser

from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.grammar.grammar_file import grammar_names
from morphgen.rl.demonstrations.lerobot import RECORDING
from morphgen.splits.split import SIDES
from morphgen.splits.split_file import split_names
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.app.uploads import store_upload
from morphgen.viewer.controls import bind
from morphgen.viewer.gallery import Gallery, add_controls, open_panels, passing_rows, show_page
from morphgen.viewer.robot_rows import (
    Row,
    folder_rows,
    part_rows,
    robot_folders,
    robot_subfolders,
    uri_rows,
)
from morphgen.viewer.robot_uri import DEFAULT_WORDS, FileAccess
from morphgen.viewer.splits import SPLITS, ChooseSides, add_split_form

_COMPOSE = Address("compose", (DEFAULT_WORDS,))
INTRODUCTION = (
    "<p>morphgen makes robots from a base, arms and end-effectors, and trains and tests policies "
    f"on many of them.</p><p>{markup.button_link(_COMPOSE, 'Compose a robot')}</p>"
)
"""Text above the gallery of parts: the purpose of morphgen, and the link to Compose."""
NONE_CHOSEN = (
    "No robot is chosen: tick the box of cards in a gallery, or select robots of a population."
)


def show_library(session: Session) -> None:
    """Build the first page: all parts, links to everything else, and the upload button."""
    gallery = Gallery(session, "Parts", part_rows(session.files.library), noun="part")
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
    """Build the page of a folder of robots, from which a new split can be made."""
    if not session.address.subject:
        show_index(session)
        return
    folder = session.address.subject
    rows = folder_rows(folder, session.files)
    gallery = Gallery(session, folder, rows)
    names = robot_subfolders(session.files.path(folder))
    below = [f"{folder.rstrip('/')}/{name}" for name in names]
    links = " · ".join(markup.link(Address("gallery", (path,)), path) for path in below)
    population = markup.link(Address("population", (folder,)), "see all on one ground")
    header = population + (f"<br>{links}" if links else "")
    open_panels(gallery, markup.breadcrumbs((folder, None)), header)
    add_controls(gallery)
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


def show_chosen(session: Session) -> None:
    """Build the page of the chosen robots, which become the two sides of a new split."""
    if not session.chosen:
        raise MorphgenError(NONE_CHOSEN)
    rows = uri_rows(session.chosen, session.files)
    gallery = Gallery(session, "Chosen robots", rows, SIDES)
    header = "The first robots that you chose are to train on, the others to test on."
    open_panels(gallery, markup.breadcrumbs(("chosen robots", None)), markup.dim(header))
    num_train = session.client.gui.add_slider("to train on", 0, len(rows), 1, max(len(rows) - 1, 1))
    bind(session, "train", num_train)
    session.apply_state()
    _set_sides(gallery.rows, num_train.value)

    def divide() -> None:
        _set_sides(gallery.rows, num_train.value)
        show_page(gallery, 1)

    def sides() -> tuple[list[Row], list[Row]]:
        return gallery.rows[: num_train.value], gallery.rows[num_train.value :]

    def leave_out() -> None:
        address = replace(session.address, subjects=session.chosen or ("",))
        session.open_address(address, instead=True)

    add_controls(gallery)
    add_split_form(session, lambda: sides, expanded=True)
    session.on_change(num_train, divide, "sides")
    session.on_choice = leave_out


def _set_sides(rows: list[Row], num_train: int) -> None:
    """Give rows their sides: the first ones are to train on."""
    rows[:] = [replace(row, role=SIDES[int(i >= num_train)]) for i, row in enumerate(rows)]


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
        robots = robot_folders(root)
        html += section("Robots in this folder", robots, ("gallery", "population"), empty)
    empty = "none yet: choose robots in a gallery, then press split"
    html += section("Splits", [*own, *split_names()], ("split", "population"), empty)
    if page in ("library", "population"):
        html += section("Grammars", grammar_names(), ("compose", "population"))
    return html
