"""The tabs of the compose page with dropdowns of parts, and with sliders of their parameters."""

from __future__ import annotations

import functools
import shlex
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import viser

from morphgen.errors import CompositionError, MorphgenError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import Choices
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest, Parameter, PartKind, parse_value
from morphgen.grammar.request import MAIN_PORTS, SLOTS, default_name, parse_request
from morphgen.model.robot import Robot
from morphgen.viewer import markup
from morphgen.viewer.app.session import Session
from morphgen.viewer.robot_tables import part_title, slider_step
from morphgen.viewer.robot_uri import DERIVATION, WORDS, resolve_words

NO_PART = "(none)"  # option of a dropdown that leaves a slot empty


@dataclass(frozen=True, eq=False)
class Shown:
    """A robot that the page shows."""

    robot: Robot
    derivation: Derivation
    command: str  # command that makes the robot, or a comment with its derivation
    uri: str  # URI of the robot
    subject: str  # subject and state of the page's address that show the robot again
    state: Mapping[str, str] = field(default_factory=dict)
    choices: Choices | None = None  # choices that gave the robot, if a grammar did


ShowRobot = Callable[[Shown], None]


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


class _ComposingTab(ABC):
    """A tab whose controls compose a robot."""

    _fault: viser.GuiHtmlHandle  # reason why no robot can be composed, or empty

    def __init__(self, session: Session, show_robot: ShowRobot) -> None:
        """Prepare the tab; ``show_robot`` shows a composed robot."""
        self._session, self._library, self._show_robot = session, session.files.library, show_robot

    @abstractmethod
    def _compose(self) -> Shown:
        """Return the robot that the controls describe."""

    def show(self) -> None:
        """Show the robot, or why it cannot be composed; then the last robot stays."""
        try:
            shown = self._compose()
        except MorphgenError as error:
            self._fault.content = markup.error(self._session.files.redact(error))
            return
        self._fault.content = ""
        self._show_robot(shown)

    def _add_slider(
        self,
        name: str,
        parameter: Parameter,
        value: float,
        key: str,
        change: Callable[[float], None],
    ) -> None:
        """Add the slider of a part's parameter."""
        low, high = parameter.minimum, parameter.maximum
        slider = self._session.client.gui.add_slider(
            name.replace("_", " ") + (f" ({parameter.unit})" if parameter.unit else ""),
            low,
            high,
            1.0 if parameter.integer else slider_step(low, high),
            min(max(value, low), high),
            marks=tuple((end, f"{end:.3g}") for end in (low, high)),
            hint=parameter.summary or name,
        )
        self._session.on_change(slider, lambda: change(slider.value), key)


class PartsTab(_ComposingTab):
    """The tab with a dropdown of parts for the base and its slots, and sliders of parameters."""

    def __init__(
        self,
        session: Session,
        tabs: viser.GuiTabGroupHandle,
        choice: PartChoice,
        show_robot: ShowRobot,
    ) -> None:
        """Add the tab; ``show`` shows the chosen robot."""
        super().__init__(session, show_robot)
        gui, self._choice = session.client.gui, choice
        self._slots: list[viser.GuiFolderHandle] = []  # folders with the controls of each slot
        with tabs.add_tab("Parts", viser.Icon.PUZZLE):
            self._fault = gui.add_html("")
            bases = tuple(self._library.names("base"))
            base = gui.add_dropdown("base", bases, initial_value=choice.parts["base"])
            self._folder = gui.add_folder(None)
        session.on_change(base, lambda: self._choose("base", base.value))
        self._add_slots()

    def _compose(self) -> Shown:
        words = self._choice.words
        derivation, name = resolve_words(words, self._session.files)
        robot = compose(derivation, self._library, name)
        command = shlex.join(["morphgen", "compose", *words.split()])
        return Shown(robot, derivation, command, WORDS + words, words)

    def _add_slots(self) -> None:
        """Add for each slot a dropdown of parts, and sliders of the chosen part's parameters."""
        gui, choice = self._session.client.gui, self._choice
        for folder in self._slots:
            folder.remove()
        self._slots = []
        for slot in ("base", *slots_of(choice, self._library)):
            with self._folder:
                self._slots.append(folder := gui.add_folder(slot))
            with folder:
                if slot != "base":
                    self._add_part_dropdown(slot)
                if part := choice.parts.get(slot):
                    manifest = self._library.manifest(part, kind_of(slot))
                    for name, parameter in parameters_of(slot, manifest).items():
                        key = f"{slot}.{name}"
                        value = choice.values.get(key, parameter.default)
                        change = functools.partial(self._change, key, parameter.default)
                        self._add_slider(name, parameter, value, key, change)

    def _add_part_dropdown(self, slot: str) -> None:
        names, chosen = part_options(slot, self._library), self._choice.parts.get(slot)
        dropdown = self._session.client.gui.add_dropdown(
            kind_of(slot), tuple(names), initial_value=chosen if chosen in names else NO_PART
        )
        self._session.on_change(dropdown, lambda: self._choose(slot, dropdown.value))

    def _choose(self, slot: str, part: str) -> None:
        """Put a part into a slot, and show its controls and the robot."""
        self._choice = with_part(self._choice, slot, part, self._library)
        self._add_slots()
        self.show()

    def _change(self, key: str, default: float, value: float) -> None:
        self._choice = with_value(self._choice, key, value, default)
        self.show()


class ParametersTab(_ComposingTab):
    """The tab with sliders for every part of a derivation that words cannot describe."""

    def __init__(
        self,
        session: Session,
        tabs: viser.GuiTabGroupHandle,
        derivation: Derivation,
        show_robot: ShowRobot,
    ) -> None:
        """Add the tab; ``show`` shows the robot."""
        super().__init__(session, show_robot)
        gui, self._derivation = session.client.gui, derivation
        with tabs.add_tab("Parameters", viser.Icon.ADJUSTMENTS):
            self._fault = gui.add_html("")
            for node in derivation.walk():
                manifest, values = self._library.manifest(node.part), dict(node.parameters)
                is_root = node is derivation
                parameters = manifest.parameters if is_root else manifest.attached_parameters
                if names := [name for name in parameters if name in values]:
                    with gui.add_folder(part_title(node.label, node.part)):
                        for name in names:
                            change = functools.partial(self._change, node.label, name)
                            key = f"{node.label}.{name}"
                            self._add_slider(name, parameters[name], values[name], key, change)

    def _compose(self) -> Shown:
        derivation = self._derivation
        uri = f"{DERIVATION}{derivation}"
        robot = compose(derivation, self._library, default_name(derivation, self._library))
        return Shown(robot, derivation, f"# {derivation}", uri, uri)

    def _change(self, label: str, name: str, value: float) -> None:
        self._derivation = with_parameter(self._derivation, label, name, value)
        self.show()


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
