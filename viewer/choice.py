"""What the compose panel has chosen, as words of ``morphgen compose`` and as controls."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from morphgen.errors import CompositionError, nearest
from morphgen.formats.urdf_text import number
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest, PartKind
from morphgen.grammar.parameters import MOUNT_YAW, Parameter, parse_value
from morphgen.grammar.request import MAIN_PORTS, SLOTS
from morphgen.viewer.robot_tables import slider_step

NOTHING = "(none)"
"""Stands for no part in a dropdown."""


@dataclass(frozen=True)
class Choice:
    """Parts by slot, such as ``left.arm``, and parameters that are not at their default."""

    parts: Mapping[str, str]
    values: Mapping[str, float] = field(default_factory=dict)
    """By ``slot.parameter``, SI units."""

    @property
    def words(self) -> str:
        """The words of ``morphgen compose`` that say the same."""
        parts = [f"{slot}={part}" for slot, part in self.parts.items() if part]
        return " ".join([*parts, *(f"{key}={number(value)}" for key, value in self.values.items())])


@dataclass(frozen=True)
class Control:
    """A slider for a parameter."""

    key: str
    """Such as ``ee.size``."""
    label: str
    low: float
    high: float
    step: float
    default: float
    hint: str


def parse_choice(words: Sequence[str], library: Library) -> Choice:
    """What words of ``morphgen compose`` choose.

    Raises:
        CompositionError: If a word is none.
        PartError: If a part or parameter is unknown, or a value is wrong.
    """
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
        known = parameters_of(slot, library.manifest(parts[slot], kind_of(slot)))
        if name not in known:
            raise CompositionError(
                f"{key}: {parts[slot]!r} has no such parameter{nearest(name, known)}"
            )
        values[key] = parse_value(text, known[name], key)
    return Choice(parts, values)


def kind_of(slot: str) -> PartKind:
    """The kind of part that a slot takes."""
    last = slot.rpartition(".")[2]
    return next(kind for kind in SLOTS if kind == last)


def slots_of(choice: Choice, library: Library) -> list[str]:
    """The slots that chosen parts offer, besides the base's own.

    Every port of the base has an arm, and an end-effector on it; an arm of several ports has one
    on each. Where the main arm stands, an end-effector on another port of the base needs an arm.
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


def options(slot: str, library: Library) -> list[str]:
    """Parts that a slot can have, nothing first."""
    return [NOTHING, *(name for name in library.names(kind_of(slot)) if name != "none")]


def parameters_of(slot: str, manifest: Manifest) -> dict[str, Parameter]:
    """The parameters of a part in a slot: its own, and the turn of its mount."""
    own = dict(manifest.parameters)
    return own if kind_of(slot) == "base" else {**own, MOUNT_YAW.name: MOUNT_YAW}


def controls_of(slot: str, manifest: Manifest) -> list[Control]:
    """A slider for every parameter of a part."""
    return [
        Control(
            f"{slot}.{name}",
            name.replace("_", " ") + (f" ({parameter.unit})" if parameter.unit else ""),
            parameter.minimum,
            parameter.maximum,
            1.0 if parameter.integer else slider_step(parameter.minimum, parameter.maximum),
            parameter.default,
            parameter.summary or name,
        )
        for name, parameter in parameters_of(slot, manifest).items()
    ]


def with_part(choice: Choice, slot: str, part: str, library: Library) -> Choice:
    """The choice with another part; what cannot stand any more is left out.

    Args:
        choice: What was chosen.
        slot: Where.
        part: Its name, or ``NOTHING``.
        library: Where parts are.
    """
    chosen = {**choice.parts, slot: "" if part == NOTHING else part}
    parts = {key: name for key, name in chosen.items() if name}
    allowed = {"base", *slots_of(Choice(parts), library)}
    parts = {key: name for key, name in parts.items() if key in allowed}
    values = {
        key: value
        for key, value in choice.values.items()
        if key.rpartition(".")[0] in parts and key.rpartition(".")[0] != slot
    }
    return Choice(parts, values)


def with_value(choice: Choice, control: Control, value: float) -> Choice:
    """The choice with a parameter's value; a default is left out."""
    values = {key: old for key, old in choice.values.items() if key != control.key}
    if abs(value - control.default) > 1e-9:
        values[control.key] = float(number(value))
    return replace(choice, values=values)


def first_parts(derivation: Derivation, n: int) -> Derivation:
    """The derivation as far as its first parts, in the order in which they were attached.

    Args:
        derivation: All of it.
        n: How many parts, at least 1.
    """
    kept = {id(node) for node in list(derivation.walk())[: max(n, 1)]}

    def pruned(node: Derivation) -> Derivation:
        children = ((port, pruned(child)) for port, child in node.children if id(child) in kept)
        return replace(node, children=tuple(children))

    return pruned(derivation)
