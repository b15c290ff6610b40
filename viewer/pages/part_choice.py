"""The parts chosen on the compose page, as words of ``morphgen compose`` and as controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from morphgen.errors import CompositionError, MorphgenError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest, Parameter, PartKind, parse_value
from morphgen.grammar.request import MAIN_PORTS, SLOTS, parse_request
from morphgen.viewer.robot_tables import slider_step

NO_PART = "(none)"
"""Option of a dropdown that leaves a slot empty."""


@dataclass(frozen=True)
class PartChoice:
    """Parts by slot, and the parameters that differ from their defaults."""

    parts: Mapping[str, str]
    """Names of parts by slot, such as ``left.arm``."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Parameters by ``slot.parameter``, in SI units."""

    @property
    def words(self) -> str:
        """The words of ``morphgen compose`` for the same robot."""
        parts = [f"{slot}={part}" for slot, part in self.parts.items() if part]
        return " ".join(
            [*parts, *(f"{key}={format_number(value)}" for key, value in self.values.items())]
        )


@dataclass(frozen=True)
class Control:
    """A slider for a parameter."""

    key: str
    """Slot and parameter, such as ``ee.size``."""
    label: str
    low: float
    high: float
    step: float
    default: float
    hint: str


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

    Every port of the base takes an arm with an end-effector; an arm with several ports takes an
    end-effector on each. If there is a main arm, an end-effector on another port of the base needs
    an arm there.
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


def controls_of(slot: str, manifest: Manifest) -> list[Control]:
    """Return a slider for every parameter of a part in a slot."""
    return [
        _control(f"{slot}.{name}", name, parameter)
        for name, parameter in parameters_of(slot, manifest).items()
    ]


def node_controls(node: Derivation, library: Library, *, is_root: bool) -> list[Control]:
    """Return a slider for every parameter of a part of a derivation; the keys are their names."""
    manifest = library.manifest(node.part)
    parameters = manifest.parameters if is_root else manifest.attached_parameters
    names = dict(node.parameters)
    return [
        _control(name, name, parameter) for name, parameter in parameters.items() if name in names
    ]


def _control(key: str, name: str, parameter: Parameter) -> Control:
    return Control(
        key,
        name.replace("_", " ") + (f" ({parameter.unit})" if parameter.unit else ""),
        parameter.minimum,
        parameter.maximum,
        1.0 if parameter.integer else slider_step(parameter.minimum, parameter.maximum),
        parameter.default,
        parameter.summary or name,
    )


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


def with_value(choice: PartChoice, control: Control, value: float) -> PartChoice:
    """Return the choice with another value of a parameter; default values are left out."""
    values = {key: other for key, other in choice.values.items() if key != control.key}
    if abs(value - control.default) > 1e-9:
        values[control.key] = float(format_number(value))
    return replace(choice, values=values)


def first_parts(derivation: Derivation, n: int) -> Derivation:
    """Return a derivation of only the first ``n`` parts (at least 1), in order of attachment."""
    kept_ids = {id(node) for node in list(derivation.walk())[: max(n, 1)]}

    def prune(node: Derivation) -> Derivation:
        children = ((port, prune(child)) for port, child in node.children if id(child) in kept_ids)
        return replace(node, children=tuple(children))

    return prune(derivation)
