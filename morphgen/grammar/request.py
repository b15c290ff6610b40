"""Parse requests: ``arm=ur5 ee=plane left.ee.size=0.1`` to a derivation."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from morphgen.errors import CompositionError, GrammarError, nearest
from morphgen.grammar import syntax
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.derive import Chooser, derive
from morphgen.grammar.grammar_file import SUFFIX, Grammar, grammar_names
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW, Manifest, PartKind, parse_value, resolve_values
from morphgen.grammar.syntax import Derivation
from morphgen.grammar.values import Scope, evaluate, typical_value


def pin(grammar: Grammar, words: Sequence[str], library: Library) -> Grammar:
    """Return the grammar with some of its choices fixed.

    ``symbol=name`` keeps alternatives that begin with a name; ``symbol=5`` fixes a count;
    ``part.parameter=value`` a parameter of every copy; ``name=value`` a value of ``let``.
    """
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key or not value:
            raise GrammarError(f"{word!r} is not of the form key=value, such as beads=5")
        part, dot, parameter = key.rpartition(".")
        if dot:
            grammar = _pin_parameter(grammar, part, parameter, value, library)
        elif any(let.name == key for let in grammar.lets):
            grammar = _pin_let(grammar, key, value)
        else:
            grammar = _pin_symbol(grammar, key, value, library)
    return grammar


def _pin_parameter(grammar: Grammar, part: str, name: str, value: str, library: Library) -> Grammar:
    if part not in (parts := _parts(grammar)):
        raise GrammarError(
            f"{part}.{name}: no part {part!r} in {grammar.name!r}{nearest(part, parts)}"
        )
    parameters = library.manifest(part).attached_parameters
    if name not in parameters:
        raise GrammarError(f"{part!r} has no parameter {name!r}{nearest(name, parameters)}")
    pinned_value = parse_value(value, parameters[name], f"{part}.{name}")
    number = syntax.Expression(
        "number", (), syntax.SourceLocation("command line", 1, 1), "", pinned_value
    )

    def pinned(item: syntax.Item) -> syntax.Item:
        if item.name != part:
            return item
        other_arguments = tuple(entry for entry in item.arguments if entry[0] != name)
        return replace(item, arguments=(*other_arguments, (name, number)))

    def with_pinned(production: syntax.Production) -> syntax.Production:
        alternatives = (
            replace(alternative, items=tuple(map(pinned, alternative.items)))
            for alternative in production.alternatives
        )
        return replace(production, alternatives=tuple(alternatives))

    return replace(grammar, productions=tuple(map(with_pinned, grammar.productions)))


def _parts(grammar: Grammar) -> set[str]:
    names = {item.name for production in grammar.productions for item in production.items()}
    return {name for name in names if grammar.production(name) is None}


def dotted_keys(owners: Iterable[tuple[str, Manifest]]) -> Iterator[str]:
    """Yield the keys of the parameters of parts, such as ``ee.size``, by the names of the parts."""
    return (f"{owner}.{name}" for owner, part in owners for name in part.attached_parameters)


def _pin_let(grammar: Grammar, name: str, value: str) -> Grammar:
    number = syntax.parse_condition(value, f"{name}={value}")
    unsigned = number.operands[0] if number.operator == "negative" else number
    if unsigned.operator != "number":
        raise GrammarError(f"{name}={value}: not a number, such as 0.02 or 20mm")
    evaluate(number, Scope({}, typical_value, name))  # raises if the unit is unknown
    lets = (replace(let, expression=number) if let.name == name else let for let in grammar.lets)
    return replace(grammar, lets=tuple(lets))


def _pin_symbol(grammar: Grammar, symbol: str, value: str, library: Library) -> Grammar:
    production = grammar.production(symbol)
    if production is None:
        valid = [*(p.symbol for p in grammar.productions), *(let.name for let in grammar.lets)]
        manifests = (library.manifest(part) for part in _parts(grammar))
        hint = nearest(symbol, valid, dotted_keys((each.name, each) for each in manifests))
        raise GrammarError(f"{symbol}={value}: no symbol {symbol!r}{hint}")
    if value.isdecimal() and len(value) <= syntax.MAX_WORD:
        pinned = _with_count(production, int(value))
    else:
        alternatives = tuple(a for a in production.alternatives if a.items[0].name == value)
        if not alternatives:
            valid = [alternative.items[0].name for alternative in production.alternatives]
            if any(item.repetition for a in production.alternatives for item in a.items):
                valid.append("a whole number of repetitions")
            raise GrammarError(f"{symbol}={value}: no such alternative{nearest(value, valid)}")
        pinned = replace(production, alternatives=alternatives)
    productions = (pinned if p.symbol == symbol else p for p in grammar.productions)
    return replace(grammar, productions=tuple(productions))


def _with_count(production: syntax.Production, count: int) -> syntax.Production:
    """Fix the count of the one open repetition of a symbol; drop its other alternatives."""
    repetitions = [
        (alternative, item, item.repetition)
        for alternative in production.alternatives
        for item in alternative.items
        if item.repetition is not None and item.repetition[0] < item.repetition[1]
    ]
    if len(repetitions) != 1:
        raise GrammarError(
            f"{production.symbol}={count}: {production.symbol!r} has {len(repetitions)} "
            "repetitions to pin, not one"
        )
    ((alternative, repeated, (low, high)),) = repetitions
    if not low <= count <= high:
        raise GrammarError(f"{production.symbol}={count}: expected {low} to {high}")
    fixed = replace(repeated, repetition=(count, count))
    items = tuple(fixed if item is repeated else item for item in alternative.items)
    return replace(production, alternatives=(replace(alternative, items=items),))


SLOTS: tuple[PartKind, ...] = ("base", "arm", "ee")  # kinds of parts that a request can choose
OBJECT: PartKind = "object"
"""Kind of the parts that a request names alone, without base, arm and end-effector."""
_NAMED: tuple[PartKind, ...] = (*SLOTS, OBJECT)
MAIN_PORTS: Mapping[PartKind, str] = {"base": "top", "arm": "flange"}
"""Port of each kind of part that the next part is attached to when none is named."""


@dataclass
class _Slot:
    """A part of a request, such as ``base``, ``arm`` or ``left.ee``."""

    kind: PartKind
    port: str  # name of the limb, such as `left`; empty for the main limb
    part: str = ""
    values: dict[str, str] = field(default_factory=dict)  # parameters as the user wrote them

    @property
    def key(self) -> str:
        return f"{self.port}.{self.kind}" if self.port else self.kind


def parse_words(words: Sequence[str], library: Library) -> tuple[Derivation, str]:
    """Return the derivation that words describe, and a name for its robot.

    The words are ``key=value`` (see ``parse_request``); a grammar and choices of ``pin``, with its
    first alternatives, smallest counts and typical values; or parts joined by dashes, each of which
    takes the slot of its kind: ``ur5-plane`` is ``arm=ur5 ee=plane``.
    """
    if not words:
        raise CompositionError(
            "no robot is named; expected one such as ur5-plane or arm=ur5 ee=plane"
        )
    first = words[0]
    grammars = known_grammars(library)
    if first in grammars or first.endswith(SUFFIX):
        grammar = load_sound_grammar(first, library)
        derivation = derive(pin(grammar, words[1:], library), library, Chooser())
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
    """Return the names of morphgen's grammars and of those in the library's folders."""
    in_library = (path.stem for folder in library.folders for path in folder.rglob(f"*{SUFFIX}"))
    return {*grammar_names(), *in_library}


def _slot_word(part: str, text: str, library: Library) -> str:
    """Return the ``key=value`` word of a part, such as ``arm=ur5``."""
    if part not in library.paths:
        names = {name for kind in _NAMED for name in library.names(kind)} | known_grammars(library)
        raise CompositionError(
            f"robot {text!r}: there is no such bundle or URDF, and {part!r} is not a part"
            + nearest(part, names)
        )
    kind = library.manifest(part).kind
    if kind not in _NAMED:
        raise CompositionError(
            f"robot {text!r}: {part!r} is a {kind}, which only a grammar can use"
            + nearest(part, known_grammars(library))
        )
    return f"{kind}={part}"


def parse_request(words: Sequence[str], library: Library) -> Derivation:
    """Return the derivation of ``key=value`` words.

    ``base``, ``arm`` and ``ee`` choose parts; the base is ``fixed`` by default. A prefix names the
    port of a limb: ``left.arm=ur5``. ``object`` chooses an object, alone. Every other key is a
    parameter of a part: ``ee.size=80mm``, ``left.ee.mount_yaw=45deg``.
    """
    slots = _parse_slots(words, library)
    if OBJECT in slots:
        if len(slots) > 1:
            raise CompositionError(
                f"{', '.join(sorted(slots))}: an object is no part of a robot; compose it alone"
            )
        return _node(slots[OBJECT], library.manifest(slots[OBJECT].part, OBJECT))
    base = slots.pop("base", _Slot("base", "", "fixed"))
    if not slots:
        raise CompositionError(
            "nothing to compose: name at least an arm or an ee, such as arm=ur5 ee=plane"
        )
    manifests = {key: library.manifest(slot.part, slot.kind) for key, slot in slots.items()}
    limbs = _limbs(slots, manifests, library)
    base_manifest = library.manifest(base.part, "base")
    for port, limb in limbs:
        _require_port(base_manifest, port, limb.label)
    order = list(base_manifest.ports).index  # words may name the limbs in any order
    return _node(base, base_manifest, tuple(sorted(limbs, key=lambda limb: order(limb[0]))))


def default_name(derivation: Derivation, library: Library) -> str:
    """Return a robot's name: its parts, and a hash if a parameter differs from its default."""
    words = []
    is_changed = False
    labels = {node.label for node in derivation.walk()}
    for node in derivation.walk():
        parameters = library.manifest(node.part).parameters
        is_changed |= dict(node.parameters) != {name: p.default for name, p in parameters.items()}
        if node.part in ("fixed", "none"):
            continue
        limb, _, kind = node.label.rpartition("_")
        starts_limb = limb and (kind == "arm" or f"{limb}_arm" not in labels)
        words.append(f"{limb}-{node.part}" if starts_limb else node.part)
    if is_changed:
        words.append(derivation.digest[:8])
    return "-".join(words)


def _parse_slots(words: Sequence[str], library: Library) -> dict[str, _Slot]:
    """Return the parts that ``key=value`` words choose, with their parameters, by key."""
    slots: dict[str, _Slot] = {}
    values: dict[str, str] = {}
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key or not value:
            raise CompositionError(f"{word!r} is not of the form key=value, such as arm=ur5")
        *port, last = key.split(".")
        if last not in _NAMED:
            if key in values:
                raise CompositionError(f"{key} is given twice")
            values[key] = value
            continue
        if len(port) > 1 or port == [""] or (port and last in ("base", OBJECT)):
            raise CompositionError(
                f"{key}: a part is named base, arm, ee, PORT.arm or PORT.ee, such as left.arm"
            )
        if key in slots:
            raise CompositionError(f"{key} is given twice: {slots[key].part} and {value}")
        slots[key] = _Slot(last, port[0] if port else "", value)
    # A base alone is no robot; parse_request says so.
    if any(key not in ("base", OBJECT) for key in slots):
        slots.setdefault("base", _Slot("base", "", "fixed"))
    for key, value in values.items():
        _assign(key, value, slots, library)
    return slots


def _assign(key: str, value: str, slots: Mapping[str, _Slot], library: Library) -> None:
    """Give a parameter's value to the slot of its part."""
    owner, _, name = key.rpartition(".")
    if owner in slots:
        slots[owner].values[name] = value
        return
    chosen = ((slot.key, library.manifest(slot.part, slot.kind)) for slot in slots.values())
    hint = nearest(key, _NAMED, dotted_keys(chosen))
    if owner:
        raise CompositionError(f"{key}={value}: no part is chosen for {owner!r}{hint}")
    raise CompositionError(
        f"{key}={value}: unknown key {key!r}{hint}, a limb such as left.arm or left.ee, or a "
        "parameter of a part such as ee.size"
    )


def _limbs(
    slots: Mapping[str, _Slot], manifests: Mapping[str, Manifest], library: Library
) -> list[tuple[str, Derivation]]:
    """Return (port of the base, derivation) of each limb, arms with their end-effectors."""
    limbs: list[tuple[str, Derivation]] = []
    attached: set[str] = set()  # keys of end-effectors that an arm carries
    for key, slot in slots.items():
        if slot.kind != "arm":
            continue
        arm = manifests[key]
        children: list[tuple[str, Derivation]] = []
        for port in arm.ports:
            empty = _Slot("ee", slot.port if port == MAIN_PORTS["arm"] else port, "none")
            if empty.key in slots:
                attached.add(empty.key)
                children.append((port, _node(slots[empty.key], manifests[empty.key])))
            else:
                children.append((port, _node(empty, library.manifest("none", "ee"))))
        limbs.append((slot.port or MAIN_PORTS["base"], _node(slot, arm, tuple(children))))
    for key, slot in slots.items():
        if slot.kind == "ee" and key not in attached:
            has_arm = slot.port and f"{slot.port}.arm" in slots
            arm_key = f"{slot.port}.arm" if has_arm else "arm"
            if arm_key in slots:
                _require_port(manifests[arm_key], slot.port or MAIN_PORTS["arm"], key)
            limbs.append((slot.port or MAIN_PORTS["base"], _node(slot, manifests[key])))
    return limbs


def _node(
    slot: _Slot, manifest: Manifest, children: tuple[tuple[str, Derivation], ...] = ()
) -> Derivation:
    """Return the derivation of a slot's part with its children, defaults filled in."""
    is_root = slot.kind in ("base", OBJECT)
    parameters = manifest.parameters if is_root else manifest.attached_parameters
    values = {}
    for name, text in slot.values.items():
        if name not in parameters:
            raise CompositionError(
                f"{slot.key}.{name}: {manifest.name!r} has no parameter {name!r}"
                + nearest(name, parameters)
            )
        values[name] = parse_value(text, parameters[name], f"{slot.key}.{name}")
    complete = resolve_values(values, parameters, manifest.name)
    if complete.get(MOUNT_YAW) == 0.0:
        del complete[MOUNT_YAW]
    return Derivation(slot.key.replace(".", "_"), manifest.name, tuple(complete.items()), children)


def _require_port(manifest: Manifest, port: str, key: str) -> None:
    """Require that a part has a port; ``key`` names in the error what is attached to it."""
    if port not in manifest.ports:
        raise CompositionError(
            f"{key}: {manifest.name!r} has no port {port!r}{nearest(port, manifest.ports)}"
        )
