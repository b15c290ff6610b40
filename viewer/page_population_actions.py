"""The actions on the selected robots of a population: compare, export, save a split, delete."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import viser

from morphgen.benchmark.split import SIDES
from morphgen.errors import BenchmarkError
from morphgen.grammar.robot_set import remove_robots
from morphgen.viewer.address import MAX_COMPARED, Address
from morphgen.viewer.page_population_show import PopulationPage, selected_rows, show_selection
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.robot_uri import UriError, owned_set
from morphgen.viewer.split_form import ChooseSides, add_split_form
from morphgen.viewer.tray import send_bundles

_SELECT = ("all", "none", "invert")


def add_actions(page: PopulationPage) -> None:
    """Add the text of the selection and the controls of what can be done with it."""
    gui, session = page.session.client.gui, page.session
    with gui.add_folder("Selection"):
        page.texts["selection"] = gui.add_html("")
        select = gui.add_button_group("Select", _SELECT)
        compare = gui.add_button("Compare", icon=viser.Icon.ARROWS_LEFT_RIGHT)
        choose = gui.add_button("Choose", icon=viser.Icon.CHECKBOX, hint="add them to the tray")
        export = gui.add_button("Export bundles (.zip)", icon=viser.Icon.DOWNLOAD)
        add_split_form(session, lambda: _add_choice(page))
        if _is_owned_set(page):
            delete = gui.add_button("Delete from the set", icon=viser.Icon.TRASH, color="red")
            session.on_change(delete, lambda: _confirm_delete(page))
    session.on_change(select, lambda: _select(page, select.value))
    session.on_change(compare, lambda: _compare(page))
    session.on_change(choose, lambda: _choose(page))
    session.on_change(export, lambda: _export(page))


def _is_owned_set(page: PopulationPage) -> bool:
    try:
        owned_set(page.session.address.subject, page.session.files)
    except UriError:
        return False
    return True


def _select(page: PopulationPage, choice: str) -> None:
    if choice == "invert":
        page.selected = ~page.selected
    else:
        page.selected = np.full(len(page.population), choice == "all")
    show_selection(page)


def _require_selection(page: PopulationPage) -> list[Row]:
    """Return the selected robots.

    Raises:
        UriError: If there are none.
    """
    if rows := selected_rows(page):
        return rows
    raise UriError("no robot is selected: drag a rectangle with the shift key held")


def _compare(page: PopulationPage) -> None:
    rows = _require_selection(page)
    if not 2 <= len(rows) <= MAX_COMPARED:
        raise UriError(f"{len(rows)} selected robots to compare; expected 2 to {MAX_COMPARED}")
    page.session.open_address(Address("compare", tuple(row.uri for row in rows)))


def _export(page: PopulationPage) -> None:
    uris = [row.uri for row in _require_selection(page)]
    page.session.run_in_background(lambda: send_bundles(page.session, uris))


def _choose(page: PopulationPage) -> None:
    """Add the selected robots to the tray."""
    rows = _require_selection(page)
    page.session.choose((*page.session.chosen, *(row.uri for row in rows)))


def _add_choice(page: PopulationPage) -> ChooseSides:
    """Add the side of the selected robots; the others are on the other side."""
    side = page.session.client.gui.add_dropdown(
        "selected robots", SIDES, initial_value="test", hint="the others are on the other side"
    )

    def choose_sides() -> tuple[list[Row], list[Row]]:
        chosen = _require_selection(page)
        rows = zip(page.population.rows, page.selected, strict=True)
        others = [row for row, is_selected in rows if not is_selected]
        if not others:
            raise BenchmarkError("all robots are selected: none is left for the other side")
        return (chosen, others) if side.value == "train" else (others, chosen)

    return choose_sides


def _confirm_delete(page: PopulationPage) -> None:
    """Ask before the selected robots are deleted."""
    rows, subject = _require_selection(page), page.session.address.subject
    owned_set(subject, page.session.files)  # refuses before it asks
    gui = page.session.client.gui
    with gui.add_modal(f"Delete {len(rows)} robots?") as modal:
        names = ", ".join(row.name for row in rows[:5]) + (", ..." if len(rows) > 5 else "")
        gui.add_markdown(f"Their folders in `{subject}` are removed for good: {names}")
        delete = gui.add_button(f"Delete {len(rows)} robots", color="red")
        keep = gui.add_button("Keep them")

    def answer(action: Callable[[], object]) -> None:
        modal.close()
        action()

    page.session.on_change(keep, lambda: answer(lambda: None))
    page.session.on_change(delete, lambda: answer(lambda: _delete(page, rows)))


def _delete(page: PopulationPage, rows: list[Row]) -> None:
    session = page.session
    remove_robots(owned_set(session.address.subject, session.files), [row.name for row in rows])
    session.open_address(session.address.with_state(select=""))
