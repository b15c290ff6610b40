"""The tab of the compose page that edits the parameters of a derivation, part by part."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import viser

from morphgen.grammar.derivation import Derivation
from morphgen.grammar.request import default_name
from morphgen.viewer.page_compose_grammar import ShowRobot
from morphgen.viewer.page_compose_parts import show_composed
from morphgen.viewer.part_choice import Control, node_controls
from morphgen.viewer.robot_tables import part_title
from morphgen.viewer.robot_uri import DERIVATION
from morphgen.viewer.session import Session


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

    Args:
        session: The browser.
        tabs: Group to which the tab is added.
        derivation: Derivation of the robot, of any shape.
        show_robot: Shows a robot on the page.

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
                        _add_slider(tab, node, control)
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


def _add_slider(tab: ParametersTab, node: Derivation, control: Control) -> None:
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
