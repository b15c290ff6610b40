"""Requests: ``arm=ur5 ee=plane left.ee.size=0.1`` to a derivation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from morphgen.errors import CompositionError, nearest
from morphgen.grammar.choosers import FirstChooser
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import derive
from morphgen.grammar.grammar_file import SUFFIX, find_grammar, grammar_names, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest, PartKind
from morphgen.grammar.parameters import MOUNT_YAW, parse_value, resolve_values
from morphgen.grammar.pinning import pin

SLOTS: tuple[PartKind, ...] = ("base", "arm", "ee")
"""Kinds of parts that a request may choose."""
MAIN_PORTS: Mapping[PartKind, str] = {"base": "top", "arm": "flange"}
"""Where the next part goes when no port is named."""


@dataclass
class _Slot:
    """A part asked for at one place: ``base``, ``arm``, ``left.ee`` ..."""

    kind: PartKind
    port: str
    """The limb, such as ``left``; empty for the main one."""
    part: str = ""
    values: dict[str, str] = field(default_factory=dict)

    @property
    def key(self) -> str:
        return f"{self.port}.{self.kind}" if self.port else self.kind


def parse_words(words: Sequence[str], library: Library) -> tuple[Derivation, str]:
    """Return the derivation that words describe, and a name for its robot.

    The words are one of: ``key=value`` words (see ``parse_request``); a grammar's name and what is
    pinned in it (see ``morphgen.grammar.pinning.pin``), of which the first alternatives, smallest
    counts and typical values are taken; or parts joined by dashes, each of which goes to the slot
    of its kind: ``ur5-plane`` is ``arm=ur5 ee=plane``.

    Raises:
        MorphgenError: If the words name what does not exist or does not fit.
    """
    if not words:
        raise CompositionError(
            "no robot is named; expected one such as ur5-plane or arm=ur5 ee=plane"
        )
    first = words[0]
    grammars = known_grammars(library)
    if first in grammars or first.endswith(SUFFIX):
        grammar = load_grammar(find_grammar(first, library.folders), library.folders)
        derivation = derive(pin(grammar, words[1:], library), library, FirstChooser())
        return derivation, "-".join([grammar.name, *([derivation.digest[:8]] if words[1:] else [])])
    if "=" not in first and len(words) > 1 and first not in library.paths:
        raise CompositionError(
            f"robot {' '.join(words)!r}: {first!r} is neither a grammar nor of the form key=value"
            + nearest(first, grammars)
        )
    if "=" not in first and len(words) == 1:
        words = [_slot_word(part, first, library) for part in first.split("-")]
    derivation = parse_request(words, library)
    return derivation, default_name(derivation, library)


def known_grammars(library: Library) -> set[str]:
    """Return the names of morphgen's grammars and of those in the user's folders."""
    own = (path.stem for folder in library.folders for path in folder.rglob(f"*{SUFFIX}"))
    return {*grammar_names(), *own}


def _slot_word(part: str, text: str, library: Library) -> str:
    """The part with its slot, such as ``arm=ur5``."""
    if part not in library.paths:
        names = {name for kind in SLOTS for name in library.names(kind)} | known_grammars(library)
        raise CompositionError(
            f"robot {text!r}: there is no such bundle or URDF, and {part!r} is no part"
            + nearest(part, names)
        )
    kind = library.manifest(part).kind
    if kind not in SLOTS:
        raise CompositionError(
            f"robot {text!r}: {part!r} is a {kind}, which only a grammar can place"
            + nearest(part, known_grammars(library))
        )
    return f"{kind}={part}"


def parse_request(words: Sequence[str], library: Library) -> Derivation:
    """Read ``key=value`` words into a derivation.

    ``base``, ``arm`` and ``ee`` choose parts (the base is ``fixed`` unless named). A limb on a
    named port is written before them: ``left.arm=ur5``. Anything else is a parameter of a part:
    ``ee.size=80mm``, ``left.ee.mount_yaw=45deg``.

    Args:
        words: The words, in any order.
        library: Where the parts are.

    Raises:
        CompositionError: If a word is malformed or given twice, a parameter belongs to no part,
            a port does not exist, or nothing stands on the base.
        PartError: If a part or parameter is unknown, or a value is wrong.
    """
    slots = _slots(words)
    base = slots.pop("base", _Slot("base", "", "fixed"))
    if not slots:
        raise CompositionError(
            "nothing to compose: name at least an arm or an ee, such as arm=ur5 ee=plane"
        )
    manifests = {key: library.manifest(slot.part, slot.kind) for key, slot in slots.items()}
    children = _limbs(slots, manifests, library)
    base_manifest = library.manifest(base.part, "base")
    for port, child in children:
        _require_port(base_manifest, port, child.label)
    ports = list(base_manifest.ports)
    children.sort(key=lambda limb: ports.index(limb[0]))
    return _node(base, base_manifest, tuple(children))


def default_name(derivation: Derivation, library: Library) -> str:
    """A name for a robot: its parts, and a short hash if a parameter is not at its default."""
    words = []
    changed = False
    labels = {node.label for node in derivation.walk()}
    for node in derivation.walk():
        defaults = {p.name: p.default for p in library.manifest(node.part).parameters.values()}
        changed |= dict(node.parameters) != defaults
        if node.part in ("fixed", "none"):
            continue
        limb, _, kind = node.label.rpartition("_")
        begins = limb and (kind == "arm" or f"{limb}_arm" not in labels)
        words.append(f"{limb}-{node.part}" if begins else node.part)
    if changed:
        words.append(derivation.digest[:8])
    return "-".join(words)


def _slots(words: Sequence[str]) -> dict[str, _Slot]:
    slots: dict[str, _Slot] = {}
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key or not value:
            raise CompositionError(f"{word!r} is not of the form key=value, such as arm=ur5")
        *port, last = key.split(".")
        if last not in SLOTS:
            if key in values:
                raise CompositionError(f"{key} is given twice")
            values[key] = value
            continue
        if len(port) > 1 or port == [""] or (port and last == "base"):
            raise CompositionError(
                f"{key}: a part is named base, arm, ee, PORT.arm or PORT.ee, such as left.arm"
            )
        if key in slots:
            raise CompositionError(f"{key} is given twice: {slots[key].part} and {value}")
        slots[key] = _Slot(last, port[0] if port else "", value)
    if any(key != "base" for key in slots):
        slots.setdefault("base", _Slot("base", "", "fixed"))
    for key, value in values.items():
        owner, _, name = key.rpartition(".")
        if owner not in slots:
            raise CompositionError(_unknown_key(key, value, owner, slots))
        slots[owner].values[name] = value
    return slots


def _unknown_key(key: str, value: str, owner: str, slots: Mapping[str, _Slot]) -> str:
    if owner:
        return f"{key}={value}: no part is chosen for {owner!r}{nearest(owner, slots)}"
    return (
        f"{key}={value}: unknown key {key!r}; expected {', '.join(SLOTS)}, a limb such as left.arm "
        "or left.ee, or a parameter of a part such as ee.size"
    )


def _limbs(
    slots: Mapping[str, _Slot], manifests: Mapping[str, Manifest], library: Library
) -> list[tuple[str, Derivation]]:
    """(port of the base, what stands there), arms with their end-effectors."""
    limbs: list[tuple[str, Derivation]] = []
    used: set[str] = set()
    for key, slot in slots.items():
        if slot.kind != "arm":
            continue
        arm = manifests[key]
        held: list[tuple[str, Derivation]] = []
        for port in arm.ports:
            ee_key = _ee_key(slot, port, arm)
            if ee_key in slots:
                used.add(ee_key)
                held.append((port, _node(slots[ee_key], manifests[ee_key])))
            else:
                limb, _, _ = ee_key.rpartition(".")
                none = _Slot("ee", limb, "none")
                held.append((port, _node(none, library.manifest("none", "ee"))))
        limbs.append((slot.port or MAIN_PORTS["base"], _node(slot, arm, tuple(held))))
    for key, slot in slots.items():
        if slot.kind == "ee" and key not in used:
            arm_key = f"{slot.port}.arm" if slot.port and slot.port in _ports(slots) else "arm"
            if arm_key in slots:
                _require_port(manifests[arm_key], slot.port or MAIN_PORTS["arm"], key)
            limbs.append((slot.port or MAIN_PORTS["base"], _node(slot, manifests[key])))
    return limbs


def _ports(slots: Mapping[str, _Slot]) -> set[str]:
    return {slot.port for slot in slots.values() if slot.kind == "arm"}


def _ee_key(arm_slot: _Slot, port: str, arm: Manifest) -> str:
    """The key that names the end-effector on an arm's port."""
    if port == MAIN_PORTS["arm"]:
        return f"{arm_slot.port}.ee" if arm_slot.port else "ee"
    return f"{port}.ee"


def _node(
    slot: _Slot, manifest: Manifest, children: tuple[tuple[str, Derivation], ...] = ()
) -> Derivation:
    parameters = dict(manifest.parameters)
    if slot.kind != "base":
        parameters[MOUNT_YAW.name] = MOUNT_YAW
    values = {}
    for name, text in slot.values.items():
        if name not in parameters:
            raise CompositionError(
                f"{slot.key}.{name}: {manifest.name!r} has no parameter {name!r}"
                + nearest(name, parameters)
            )
        values[name] = parse_value(text, parameters[name], f"{slot.key}.{name}")
    complete = resolve_values(values, parameters, manifest.name)
    if complete.get(MOUNT_YAW.name) == 0.0:
        del complete[MOUNT_YAW.name]
    label = slot.key.replace(".", "_")
    return Derivation(label, manifest.name, tuple(complete.items()), children)


def _require_port(manifest: Manifest, port: str, wanted: str) -> None:
    if port not in manifest.ports:
        raise CompositionError(
            f"{wanted}: {manifest.name!r} has no port {port!r}{nearest(port, manifest.ports)}"
        )
