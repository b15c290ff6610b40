"""The page of the chosen robots: they become a new split, some to train on and some to test on."""

from __future__ import annotations

from dataclasses import replace

from morphgen.benchmark.split import SIDES
from morphgen.errors import MorphgenError
from morphgen.viewer import markup
from morphgen.viewer.app.address import parse_count
from morphgen.viewer.app.session import Session
from morphgen.viewer.gallery import Gallery, add_controls, open_panels, show_page
from morphgen.viewer.robot_rows import Row, uri_rows
from morphgen.viewer.splits import ChooseSides, add_split_form

EMPTY = "No robot is chosen: tick the box of cards in a gallery, or select robots of a population."


def show(session: Session) -> None:
    """Build the page."""
    if not session.chosen:
        raise MorphgenError(EMPTY)
    rows = uri_rows(session.chosen, session.files)
    gallery = Gallery(session, "Chosen robots", rows, SIDES, "common")
    header = "The first robots that you chose are to train on, the others to test on."
    panel = open_panels(gallery, markup.breadcrumbs(("chosen robots", None)), markup.dim(header))
    gui, n = session.client.gui, len(rows)
    initial = min(parse_count(session.address.state.get("train", ""), max(n - 1, 1)), n)
    num_train = gui.add_slider("to train on", 0, n, 1, initial)

    def divide() -> None:
        gallery.rows[:] = with_sides(gallery.rows, num_train.value)
        session.address = session.address.with_state(train=str(num_train.value))
        show_page(gallery, 1)

    def choose_sides() -> tuple[list[Row], list[Row]]:
        return gallery.rows[: num_train.value], gallery.rows[num_train.value :]

    def add_choice() -> ChooseSides:
        return choose_sides

    def leave_out() -> None:
        session.open_address(
            replace(session.address, subjects=session.chosen or ("",)), instead=True
        )

    gallery.rows[:] = with_sides(rows, initial)
    add_controls(gallery, panel)
    add_split_form(session, add_choice, expanded=True)
    session.on_change(num_train, divide, "sides")
    session.on_choice = leave_out


def with_sides(rows: list[Row], num_train: int) -> list[Row]:
    """Return rows with their sides: the first ones are to train on."""
    return [
        replace(row, role=SIDES[0] if i < num_train else SIDES[1]) for i, row in enumerate(rows)
    ]
