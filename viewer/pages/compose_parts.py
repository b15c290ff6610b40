"""The tabs of the compose page with dropdowns of parts, and with sliders of their parameters."""

from __future__ import annotations

import functools
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import viser

from morphgen.errors import CompositionError, MorphgenError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest, Parameter, PartKind, parse_value
from morphgen.grammar.request import MAIN_PORTS, SLOTS, default_name, parse_request
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address
from morphgen.viewer.app.session import Session
from morphgen.viewer.pages.compose_grammar import ShowRobot
from morphgen.viewer.robot_tables import part_title, slider_step
from morphgen.viewer.robot_uri import DERIVATION, WORDS, resolve_words

NO_PART = "(none)"  # option of a dropdown that leaves a slot empty


@dataclass(frozen=True)
class PartChoice:
    """Parts by slot, and the parameters that differ from their defaults."""

    parts: Mapping[str, str]  # names of parts by slot, such as `left.arm`
    values: Mapping[str, float] = field(default_factory=dict)  # value of each `slot.parameter` [SI]

    @property
    def words(self) -> str:
        """The words of ``morphgen compose`` for the same robot."""
        parts = [f"{slot}={part}" for slot, part in self.parts.items() if part]
        return " ".join(
            [*parts, *(f"{key}={format_number(value)}" for key, value in self.values.items())]
        )


def parse_choice(words: Sequence[str], library: Library) -> PartChoice:
    """Parse words of ``morphgen compose``."""
    parts: dict[str, str] = {}
    texts: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals:
            raise CompositionError(f"{word!r} is not of the form key=value, such as arm=ur5")
        (parts if key.rpartition(".")[2] in SLOTS else texts)[key] = value
    parts = {"base": "fixed", **parts}
    for slot, part in parts.items():
        library.manifest(part, kind_of(slot))
    values = {}
    for key, text in texts.items():
        slot, _, name = key.rpartition(".")
        if slot not in parts:
            raise CompositionError(f"{key}: no part is chosen for {slot!r}{nearest(slot, parts)}")
        parameters = parameters_of(slot, library.manifest(parts[slot], kind_of(slot)))
        if name not in parameters:
            raise CompositionError(
                f"{key}: {parts[slot]!r} has no such parameter{nearest(name, parameters)}"
            )
        values[key] = parse_value(text, parameters[name], key)
    return PartChoice(parts, values)


def kind_of(slot: str) -> PartKind:
    """Return the kind of part that a slot takes."""
    last = slot.rpartition(".")[2]
    return next(kind for kind in SLOTS if kind == last)


def slots_of(choice: PartChoice, library: Library) -> list[str]:
    """Return the slots that the chosen parts offer, except the base's own slot.

    Every port of the base takes an arm with an end-effector on each of the arm's ports. Beside a
    main arm, an end-effector on another port of the base needs an arm there.
    """
    base = library.manifest(choice.parts["base"], "base")
    arm = choice.parts.get("arm")
    ports = list(library.manifest(arm, "arm").ports) if arm else [MAIN_PORTS["arm"]]
    slots = ["arm", *("ee" if port == MAIN_PORTS["arm"] else f"{port}.ee" for port in ports)]
    for port in base.ports:
        if port != MAIN_PORTS["base"]:
            slots.append(f"{port}.arm")
            if not arm or choice.parts.get(f"{port}.arm"):
                slots.append(f"{port}.ee")
    return list(dict.fromkeys(slots))


def part_options(slot: str, library: Library) -> list[str]:
    """Return the parts that fit a slot, after the option to leave it empty."""
    return [NO_PART, *(name for name in library.names(kind_of(slot)) if name != "none")]


def parameters_of(slot: str, manifest: Manifest) -> dict[str, Parameter]:
    """Return the parameters of a part in a slot: its own, and the rotation of its mount."""
    is_base = kind_of(slot) == "base"
    return dict(manifest.parameters if is_base else manifest.attached_parameters)


def choice_of(derivation: Derivation, library: Library) -> PartChoice | None:
    """Return the parts that give a derivation; None if words cannot describe it."""
    words = []
    for node in derivation.walk():
        limb, _, kind = node.label.rpartition("_")
        if kind not in SLOTS:
            return None
        slot = f"{limb}.{kind}" if limb else kind
        if node.part != "none":
            words.append(f"{slot}={node.part}")
        defaults = {
            name: parameter.default
            for name, parameter in parameters_of(slot, library.manifest(node.part)).items()
        }
        words += [
            f"{slot}.{name}={format_number(value)}"
            for name, value in node.parameters
            if format_number(value) != format_number(defaults[name])
        ]
    try:
        is_same = parse_request(words, library) == derivation
        return parse_choice(words, library) if is_same else None
    except MorphgenError:
        return None  # labels that only look like slots


def with_part(choice: PartChoice, slot: str, part: str, library: Library) -> PartChoice:
    """Return the choice with another part in a slot, without parts whose slot no longer exists."""
    chosen = {**choice.parts, slot: "" if part == NO_PART else part}
    parts = {key: name for key, name in chosen.items() if name}
    allowed = {"base", *slots_of(PartChoice(parts), library)}
    parts = {key: name for key, name in parts.items() if key in allowed}
    values = {
        key: value
        for key, value in choice.values.items()
        if key.rpartition(".")[0] in parts and key.rpartition(".")[0] != slot
    }
    return PartChoice(parts, values)


def with_value(choice: PartChoice, key: str, value: float, default: float) -> PartChoice:
    """Return the choice with another value of a parameter; default values are left out."""
    values = {other: number for other, number in choice.values.items() if other != key}
    if abs(value - default) > 1e-9:
        values[key] = float(format_number(value))
    return replace(choice, values=values)


@dataclass(eq=False)
class PartsTab:
    """Controls of the tab in one browser."""

    session: Session
    show_robot: ShowRobot
    choice: PartChoice
    fault: viser.GuiHtmlHandle
    folder: viser.GuiFolderHandle
    slots: list[viser.GuiFolderHandle] = field(default_factory=list)
    """Folders with the controls of each slot."""


def add_parts_tab(
    session: Session, tabs: viser.GuiTabGroupHandle, choice: PartChoice, show_robot: ShowRobot
) -> Callable[[], None]:
    """Add the tab of the base and its slots; return the function that shows the chosen robot."""
    gui = session.client.gui
    with tabs.add_tab("Parts", viser.Icon.PUZZLE):
        fault = gui.add_html("")
        bases = tuple(session.files.library.names("base"))
        base = gui.add_dropdown("base", bases, initial_value=choice.parts["base"])
        tab = PartsTab(session, show_robot, choice, fault, gui.add_folder(None))
    session.on_change(base, lambda: _choose_part(tab, "base", base.value))
    _add_slots(tab)
    return lambda: _show_choice(tab)


def _show_composed(
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
    _show_composed(
        session,
        tab.fault,
        words,
        lambda: resolve_words(words, session.files),
        lambda robot, derivation: tab.show_robot(robot, derivation, command, WORDS + words),
    )


def _add_slots(tab: PartsTab) -> None:
    """Add for each slot a dropdown of parts, and sliders of the chosen part's parameters."""
    gui, library = tab.session.client.gui, tab.session.files.library
    for folder in tab.slots:
        folder.remove()
    tab.slots.clear()
    for slot in ("base", *slots_of(tab.choice, library)):
        with tab.folder:
            folder = gui.add_folder(slot)
        tab.slots.append(folder)
        with folder:
            if slot != "base":
                _add_part_dropdown(tab, slot)
            if part := tab.choice.parts.get(slot):
                parameters = parameters_of(slot, library.manifest(part, kind_of(slot)))
                for name, parameter in parameters.items():
                    _add_choice_slider(tab, f"{slot}.{name}", name, parameter)


def _add_part_dropdown(tab: PartsTab, slot: str) -> None:
    names, chosen = part_options(slot, tab.session.files.library), tab.choice.parts.get(slot)
    dropdown = tab.session.client.gui.add_dropdown(
        kind_of(slot), tuple(names), initial_value=chosen if chosen in names else NO_PART
    )
    tab.session.on_change(dropdown, lambda: _choose_part(tab, slot, dropdown.value))


def _add_choice_slider(tab: PartsTab, key: str, name: str, parameter: Parameter) -> None:
    def change(value: float) -> None:
        tab.choice = with_value(tab.choice, key, value, parameter.default)
        _show_choice(tab)

    value = tab.choice.values.get(key, parameter.default)
    _add_slider(tab.session, name, parameter, value, key, change)


def _add_slider(
    session: Session,
    name: str,
    parameter: Parameter,
    value: float,
    key: str,
    change: Callable[[float], None],
) -> None:
    """Add the slider of a part's parameter."""
    low, high = parameter.minimum, parameter.maximum
    slider = session.client.gui.add_slider(
        name.replace("_", " ") + (f" ({parameter.unit})" if parameter.unit else ""),
        low,
        high,
        1.0 if parameter.integer else slider_step(low, high),
        min(max(value, low), high),
        hint=parameter.summary or name,
    )
    session.on_change(slider, lambda: change(slider.value), key)


def _choose_part(tab: PartsTab, slot: str, part: str) -> None:
    """Put a part into a slot, and show its controls and the robot."""
    tab.choice = with_part(tab.choice, slot, part, tab.session.files.library)
    _add_slots(tab)
    _show_choice(tab)


def add_parameters_tab(
    session: Session, tabs: viser.GuiTabGroupHandle, derivation: Derivation, show_robot: ShowRobot
) -> Callable[[], None]:
    """Add the tab with sliders for every part of any derivation; return what shows the robot."""
    gui, library, root = session.client.gui, session.files.library, derivation

    def show() -> None:
        """Show the robot, or why its values do not fit."""
        uri = f"{DERIVATION}{derivation}"
        _show_composed(
            session,
            fault,
            uri,
            lambda: (derivation, default_name(derivation, library)),
            lambda robot, _: show_robot(robot, derivation, f"# {derivation}", uri),
        )

    def change(label: str, name: str, value: float) -> None:
        nonlocal derivation
        derivation = with_parameter(derivation, label, name, value)
        show()

    with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
        fault = gui.add_html("")
        for node in root.walk():
            manifest, values = library.manifest(node.part), dict(node.parameters)
            parameters = manifest.parameters if node is root else manifest.attached_parameters
            if names := [name for name in parameters if name in values]:
                with gui.add_folder(part_title(node.label, node.part)):
                    for name in names:
                        set_value = functools.partial(change, node.label, name)
                        key = f"{node.label}.{name}"
                        _add_slider(session, name, parameters[name], values[name], key, set_value)
    return show


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
