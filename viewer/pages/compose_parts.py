"""The tab of the compose page on which parts are chosen for the base, arms and end-effectors."""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import viser

from morphgen.errors import MorphgenError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.request import default_name
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.pages import part_choice
from morphgen.viewer.pages.compose_grammar import ShowRobot
from morphgen.viewer.pages.part_choice import Control, node_controls
from morphgen.viewer.robot_tables import part_title
from morphgen.viewer.robot_uri import DERIVATION, WORDS, resolve_words


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
    """Show a robot and its address, or why it cannot be composed; then the last robot stays."""
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


@dataclass(eq=False)
class ParametersTab:
    """Controls of the tab in one browser."""

    session: Session
    show_robot: ShowRobot
    derivation: Derivation
    fault: viser.GuiHtmlHandle


def add_parameters_tab(
    session: Session,
    tabs: viser.GuiTabGroupHandle,
    derivation: Derivation,
    show_robot: ShowRobot,
) -> Callable[[], None]:
    """Add the tab with a folder of sliders for every part.

    derivation: Derivation of the robot, of any shape.

    Returns:
        Function that shows the robot.
    """
    gui = session.client.gui
    with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
        tab = ParametersTab(session, show_robot, derivation, gui.add_html(""))
        for node in derivation.walk():
            controls = node_controls(node, session.files.library, is_root=node is derivation)
            if controls:
                with gui.add_folder(part_title(node.label, node.part)):
                    for control in controls:
                        _add_parameter_slider(tab, node, control)
    return lambda: _show(tab)


def with_parameter(derivation: Derivation, label: str, name: str, value: float) -> Derivation:
    """Return a derivation with another value of a parameter of the part with a label."""
    parameters = derivation.parameters
    if derivation.label == label:
        values = {**dict(parameters), name: value}
        parameters = tuple(values.items())
    children = tuple(
        (port, with_parameter(child, label, name, value)) for port, child in derivation.children
    )
    return replace(derivation, parameters=parameters, children=children)


def _add_parameter_slider(tab: ParametersTab, node: Derivation, control: Control) -> None:
    slider = tab.session.client.gui.add_slider(
        control.label,
        control.low,
        control.high,
        control.step,
        min(max(dict(node.parameters)[control.key], control.low), control.high),
        hint=control.hint,
    )

    def change() -> None:
        tab.derivation = with_parameter(tab.derivation, node.label, control.key, slider.value)
        _show(tab)

    tab.session.on_change(slider, change, f"{node.label}.{control.key}")


def _show(tab: ParametersTab) -> None:
    """Show the robot, or why its values do not fit."""
    derivation, library = tab.derivation, tab.session.files.library
    uri = f"{DERIVATION}{derivation}"
    show_composed(
        tab.session,
        tab.fault,
        uri,
        lambda: (derivation, default_name(derivation, library)),
        lambda robot, _: tab.show_robot(robot, derivation, f"# {derivation}", uri),
    )
