"""The tab of the compose page on which parts are chosen for the base, arms and end-effectors."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field

import viser

from morphgen.errors import MorphgenError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.model.robot import Robot
from morphgen.viewer import markup, part_choice
from morphgen.viewer.address import Address
from morphgen.viewer.page_compose_grammar import ShowRobot
from morphgen.viewer.robot_uri import WORDS, resolve_words
from morphgen.viewer.session import Session


@dataclass(eq=False)
class PartsTab:
    """Controls of the tab in one browser."""

    session: Session
    show_robot: ShowRobot
    choice: part_choice.PartChoice
    fault: viser.GuiHtmlHandle
    folder: viser.GuiFolderHandle
    slots: dict[str, viser.GuiFolderHandle] = field(default_factory=dict)
    """Folders with the controls of each slot."""


def add_parts_tab(
    session: Session,
    tabs: viser.GuiTabGroupHandle,
    choice: part_choice.PartChoice,
    show_robot: ShowRobot,
) -> Callable[[], None]:
    """Add the tab with a dropdown for the base and the controls of its slots.

    Returns:
        Function that shows the robot of the chosen parts.
    """
    gui = session.client.gui
    with tabs.add_tab("Parts", viser.Icon.PUZZLE):
        fault = gui.add_html("")
        bases = tuple(session.files.library.names("base"))
        base = gui.add_dropdown("base", bases, initial_value=choice.parts["base"])
        tab = PartsTab(session, show_robot, choice, fault, gui.add_folder(None))
    session.on_change(base, lambda: _choose_part(tab, "base", base.value))
    _add_slots(tab)
    return lambda: _show_choice(tab)


def show_composed(
    session: Session,
    fault: viser.GuiHtmlHandle,
    subject: str,
    resolve: Callable[[], tuple[Derivation, str]],
    show: Callable[[Robot, Derivation], None],
) -> None:
    """Show a robot and its address, or why it cannot be composed; then the last robot stays.

    Args:
        session: The browser.
        fault: Text that says what is wrong.
        subject: Subject of the page's address.
        resolve: Returns the derivation and the name of the robot, or raises a MorphgenError.
        show: Shows the robot on the page.
    """
    try:
        derivation, name = resolve()
        robot = compose(derivation, session.files.library, name)
    except MorphgenError as error:
        fault.content = markup.error(session.files.redact(error))
        return
    fault.content = ""
    session.address = Address("compose", (subject,))
    session.show_address(f"compose {name}")
    show(robot, derivation)


def _show_choice(tab: PartsTab) -> None:
    """Show the robot of the chosen parts, or why they do not fit."""
    session, words = tab.session, tab.choice.words
    command = shlex.join(["morphgen", "compose", *words.split()])
    show_composed(
        session,
        tab.fault,
        words,
        lambda: resolve_words(words, session.files),
        lambda robot, derivation: tab.show_robot(robot, derivation, command, WORDS + words),
    )


def _add_slots(tab: PartsTab) -> None:
    """Add for each slot a dropdown of parts, and sliders of the chosen part's parameters."""
    session = tab.session
    gui, library = session.client.gui, session.files.library
    for folder in tab.slots.values():
        folder.remove()
    tab.slots.clear()
    with tab.folder:
        for slot in ("base", *part_choice.slots_of(tab.choice, library)):
            folder = tab.slots[slot] = gui.add_folder(slot)
            with folder:
                if slot != "base":
                    _add_part_dropdown(tab, slot)
                if part := tab.choice.parts.get(slot):
                    for control in part_choice.controls_of(
                        slot, library.manifest(part, part_choice.kind_of(slot))
                    ):
                        _add_slider(tab, control)


def _add_part_dropdown(tab: PartsTab, slot: str) -> None:
    session = tab.session
    names = part_choice.part_options(slot, session.files.library)
    chosen = tab.choice.parts.get(slot)
    dropdown = session.client.gui.add_dropdown(
        part_choice.kind_of(slot),
        tuple(names),
        initial_value=chosen if chosen in names else part_choice.NO_PART,
    )
    session.on_change(dropdown, lambda: _choose_part(tab, slot, dropdown.value))


def _add_slider(tab: PartsTab, control: part_choice.Control) -> None:
    """Add the slider of a part's parameter."""
    slider = tab.session.client.gui.add_slider(
        control.label,
        control.low,
        control.high,
        control.step,
        tab.choice.values.get(control.key, control.default),
        hint=control.hint,
    )

    def set_parameter() -> None:
        tab.choice = part_choice.with_value(tab.choice, control, slider.value)
        _show_choice(tab)

    tab.session.on_change(slider, set_parameter, control.key)


def _choose_part(tab: PartsTab, slot: str, part: str) -> None:
    """Put a part into a slot, and show its controls and the robot."""
    tab.choice = part_choice.with_part(tab.choice, slot, part, tab.session.files.library)
    _add_slots(tab)
    _show_choice(tab)
