"""The tab of the compose page on which parts are chosen."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field

import viser

from morphgen.errors import MorphgenError
from morphgen.grammar.compose import compose
from morphgen.viewer.address import Address
from morphgen.viewer.choice import (
    NOTHING,
    Choice,
    Control,
    controls_of,
    kind_of,
    options,
    slots_of,
    with_part,
    with_value,
)
from morphgen.viewer.composed import Composed, fault, show_robot
from morphgen.viewer.robot_uri import WORDS, resolve_words
from morphgen.viewer.session import show_state, when


@dataclass(eq=False)
class PartsTab:
    """The tab in one browser."""

    composed: Composed
    choice: Choice
    fault: viser.GuiHtmlHandle
    parts: viser.GuiFolderHandle
    folders: dict[str, viser.GuiFolderHandle] = field(default_factory=dict)
    """Of every slot's controls."""


def add_parts_tab(composed: Composed, tabs: viser.GuiTabGroupHandle, choice: Choice) -> PartsTab:
    """Add the tab; ``show_choice`` shows the robot."""
    session = composed.session
    gui = session.client.gui
    with tabs.add_tab("Parts", viser.Icon.PUZZLE):
        why_not = gui.add_html("")
        bases = session.places.library.names("base")
        base = gui.add_dropdown("base", tuple(bases), initial_value=choice.parts["base"])
        tab = PartsTab(composed, choice, why_not, gui.add_folder(None))
    when(base, session, lambda: _choose(tab, "base", base.value))
    _add_slots(tab)
    return tab


def show_choice(tab: PartsTab) -> None:
    """Show the robot of the chosen parts, or why there is none."""
    session, words = tab.composed.session, tab.choice.words
    library = session.places.library
    try:
        derivation, name = resolve_words(words, session.places)
        robot = compose(derivation, library, name)
    except MorphgenError as error:
        tab.fault.content = fault(error, session.places)
        return
    tab.fault.content = ""
    session.address = Address("compose", (words,))
    show_state(session, f"compose {name}")
    show_robot(
        tab.composed,
        robot,
        derivation,
        shlex.join(["morphgen", "compose", *words.split()]),
        WORDS + words,
    )


def _add_slots(tab: PartsTab) -> None:
    """A dropdown a slot of the base, and controls of what is chosen."""
    gui, library = tab.composed.session.client.gui, tab.composed.session.places.library
    for old in tab.folders.values():
        old.remove()
    tab.folders.clear()
    with tab.parts:
        for slot in ("base", *slots_of(tab.choice, library)):
            folder = tab.folders[slot] = gui.add_folder(slot)
            with folder:
                if slot != "base":
                    _add_slot(tab, slot)
                if tab.choice.parts.get(slot):
                    _add_controls(tab, slot)


def _add_slot(tab: PartsTab, slot: str) -> None:
    session = tab.composed.session
    names = options(slot, session.places.library)
    chosen = tab.choice.parts.get(slot) or NOTHING
    box = session.client.gui.add_dropdown(
        kind_of(slot), tuple(names), initial_value=chosen if chosen in names else NOTHING
    )
    when(box, session, lambda: _choose(tab, slot, box.value))


def _add_controls(tab: PartsTab, slot: str) -> None:
    session = tab.composed.session
    manifest = session.places.library.manifest(tab.choice.parts[slot], kind_of(slot))
    for control in controls_of(slot, manifest):
        slider = session.client.gui.add_slider(
            control.label,
            control.low,
            control.high,
            control.step,
            tab.choice.values.get(control.key, control.default),
            hint=control.hint,
        )
        when(slider, session, _setter(tab, control, slider), control.key)


def _setter(
    tab: PartsTab, control: Control, slider: viser.GuiSliderHandle[float]
) -> Callable[[], None]:
    def set_value() -> None:
        tab.choice = with_value(tab.choice, control, slider.value)
        show_choice(tab)

    return set_value


def _choose(tab: PartsTab, slot: str, part: str) -> None:
    tab.choice = with_part(tab.choice, slot, part, tab.composed.session.places.library)
    _add_slots(tab)
    show_choice(tab)
