"""The page of a folder of robots, and a split made of them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass

import viser

from morphgen.benchmark.split import REGIMES, Member
from morphgen.errors import BenchmarkError
from morphgen.tasks.registry import TASKS
from morphgen.viewer import gallery_grid, markup
from morphgen.viewer.address import Address
from morphgen.viewer.entries import Entry
from morphgen.viewer.gallery_grid import Gallery
from morphgen.viewer.new_split import member_of, save_split
from morphgen.viewer.robot_rows import folder_entries, subfolders
from morphgen.viewer.session import Session, later, notify, say, when


def show(session: Session) -> None:
    """The page of a folder of robots.

    Raises:
        UriError: If there is none.
    """
    place = session.address.subject
    entries = folder_entries(place, session.places)
    rows = Gallery(session, place, entries)
    below = [f"{place.rstrip('/')}/{name}" for name in subfolders(session.places.path(place))]
    links = " · ".join(markup.link(Address("gallery", (name,)), name) for name in below)
    gallery_grid.open_panels(rows, markup.crumbs((place, None)), links)
    gallery_grid.build(rows)
    _add_new_split(rows)


@dataclass(frozen=True, eq=False)
class _Wanted:
    """Controls of a new split."""

    name: viser.GuiTextHandle
    regime: viser.GuiDropdownHandle[str]
    task: viser.GuiDropdownHandle[str]
    obstacles: viser.GuiCheckboxHandle
    train: viser.GuiNumberHandle[int]
    test: viser.GuiNumberHandle[int]
    told: viser.GuiHtmlHandle


def sides_of(
    entries: list[Entry], passing: list[Entry], train: int, test: int
) -> tuple[list[Entry], list[Entry]]:
    """The first robots that pass the filter, to train on, and of those that do not, to test on.

    Raises:
        BenchmarkError: If there are not as many.
    """
    inside = {entry.place for entry in passing}
    outside = [entry for entry in entries if entry.place not in inside]
    if len(passing) < train or len(outside) < test:
        raise BenchmarkError(
            f"{len(passing)} robots pass the filter and {len(outside)} do not: too few for "
            f"{train} to train on and {test} to test on"
        )
    return passing[:train], outside[:test]


def _add_new_split(rows: Gallery) -> None:
    gui, session = rows.session.client.gui, rows.session
    with gui.add_folder("New split", expand_by_default=False):
        gui.add_html(markup.framed('<div class="dim">train: pass the filter; test: do not</div>'))
        wanted = _Wanted(
            gui.add_text("split name", ""),
            gui.add_dropdown("regime", REGIMES),
            gui.add_dropdown("task", tuple(TASKS)),
            gui.add_checkbox("obstacles", False),
            gui.add_number("to train on", 10, min=1, step=1),
            gui.add_number("to test on", 1, min=1, step=1),
            gui.add_html(""),
        )
        button = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)
    when(button, session, lambda: later(session, lambda: _save(rows, wanted)))


def _save(rows: Gallery, wanted: _Wanted) -> None:
    """Compose the robots in the workers, and write the split."""
    session = rows.session
    passing = gallery_grid.passing(rows)
    sides = sides_of(rows.entries, passing, wanted.train.value, wanted.test.value)
    train, test = (_members(session, side, wanted) for side in sides)
    say(session, "")
    regime = next(each for each in REGIMES if each == wanted.regime.value)
    path = save_split(wanted.name.value, regime, train, test, session.places)
    shown = path.relative_to(session.places.roots[0])
    wanted.told.content = markup.framed(
        markup.code(f"morphgen split audit {shlex.quote(str(shown))}")
    )
    notify(session, "Saved", str(shown))


def _members(session: Session, entries: list[Entry], wanted: _Wanted) -> list[Member]:
    task = wanted.task.value
    waiting = [
        session.workers.submit(
            member_of, entry.place, entry.category, task, wanted.obstacles.value, session.places
        )
        for entry in entries
    ]
    members = []
    for i, future in enumerate(waiting):
        say(session, f"composing {len(waiting)} robots", i / len(waiting))
        members.append(session.workers.result(future))
    return members
