"""The form that saves robots of a page as a new split."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path

import viser

from morphgen.tasks.registry import TASKS
from morphgen.viewer import markup
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.session import Session
from morphgen.viewer.splits import SAVED_REGIMES, make_members, save_split

ChooseSides = Callable[[], tuple[list[Row], list[Row]]]
"""Function that returns the robots to train on and those to test on."""


def add_split_form(
    session: Session,
    add_choice: Callable[[], ChooseSides],
    hint: str = "",
    *,
    expanded: bool = False,
) -> None:
    """Add controls that save a new split.

    Args:
        session: The browser.
        add_choice: Adds the controls that choose the sides; returns the function that reads them.
        hint: Text above the controls.
        expanded: Whether the controls are shown before the user opens their folder.
    """
    gui = session.client.gui
    with gui.add_folder("New split", expand_by_default=expanded):
        if hint:
            gui.add_html(markup.framed(markup.dim(hint)))
        name = gui.add_text("split name", "")
        regime = gui.add_dropdown("regime", SAVED_REGIMES)
        task = gui.add_dropdown("task", tuple(TASKS))
        obstacles = gui.add_checkbox("obstacles", False)
        choose_sides = add_choice()
        text = gui.add_html("")
        button = gui.add_button("Save", icon=viser.Icon.DEVICE_FLOPPY)

    def save() -> None:
        """Compose the robots in the worker processes, and write the split."""
        train, test = (
            make_members(
                rows,
                task.value,
                obstacles.value,
                session.files,
                session.workers,
                lambda done, total: session.set_status(f"composing {total} robots", done / total),
            )
            for rows in choose_sides()
        )
        session.set_status("")
        path = save_split(name.value, regime.value, train, test, session.files)
        show_saved(session, path, text)

    session.on_change(button, lambda: session.run_in_background(save))


def show_saved(session: Session, path: Path, text: viser.GuiHtmlHandle) -> None:
    """Show that a split was written, and the command that audits it."""
    name = str(path.relative_to(session.files.roots[0]))
    text.content = markup.framed(markup.code(f"morphgen split audit {shlex.quote(name)}"))
    session.notify("Saved", name)
