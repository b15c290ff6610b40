"""Rules that say which robots a split keeps for its test side.

A rule holds out parts, a manufacturer, a range of a parameter, or a combination. It is written as
on the command line: ``arm=kinova*`` holds out parts, ``manufacturer=Kinova``
the parts of a manufacturer, ``arm3.length=0.3..0.4`` a range of a parameter, and
``arm=ur5+ee=plane`` a combination. A robot is held out if one rule holds for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import cast

from morphgen.errors import BenchmarkError, PartError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import PART_KINDS, Manifest, PartKind
from morphgen.grammar.parameters import Parameter, parse_value

MANUFACTURER = "manufacturer"
"""Key of conditions on the manufacturer of a part."""
EXAMPLES = "arm=kinova*, manufacturer=Kinova, arm3.length=0.3..0.4 or arm=ur5+ee=plane"
"""Examples of rules, for messages."""


@dataclass(frozen=True)
class PartCondition:
    """The part has a kind and a name: ``arm=kinova*``."""

    kind: PartKind
    pattern: str
    """Name of the part, with shell wildcards."""

    def __str__(self) -> str:
        return f"{self.kind}={self.pattern}"

    def matches(self, node: Derivation, library: Library) -> bool:
        """Test a part of a robot."""
        return fnmatchcase(node.part, self.pattern) and library.manifest(node.part).kind == (
            self.kind
        )


@dataclass(frozen=True)
class ManufacturerCondition:
    """The part is made by a manufacturer: ``manufacturer=Kinova``, ``arm.manufacturer=Kinova``."""

    kind: PartKind | None
    """Kind of the part; None for any."""
    pattern: str
    """Name of the manufacturer in any case, with shell wildcards."""

    def __str__(self) -> str:
        prefix = f"{self.kind}." if self.kind else ""
        return f"{prefix}{MANUFACTURER}={self.pattern}"

    def matches(self, node: Derivation, library: Library) -> bool:
        """Test a part of a robot."""
        return self.matches_manifest(library.manifest(node.part))

    def matches_manifest(self, manifest: Manifest) -> bool:
        """Test a part."""
        name = manifest.manufacturer.lower()
        is_kind = self.kind in (None, manifest.kind)
        return is_kind and bool(name) and fnmatchcase(name, self.pattern.lower())


@dataclass(frozen=True)
class RangeCondition:
    """A parameter of the part is in a range, bounds included: ``arm3.length=0.3..0.4``."""

    owner: str
    """Kind of the part, or its name with shell wildcards."""
    parameter: str
    low: float
    """Lower bound [SI unit of the parameter]."""
    high: float
    """Upper bound [SI unit of the parameter]."""

    def __str__(self) -> str:
        low, high = format_number(self.low), format_number(self.high)
        return f"{self.owner}.{self.parameter}={low}..{high}"

    def applies_to(self, manifest: Manifest) -> bool:
        """Test if the part is one whose parameter has a held-out range."""
        return _is_owner(self.owner, manifest) and self.parameter in manifest.attached_parameters

    def matches(self, node: Derivation, library: Library) -> bool:
        """Test a part of a robot."""
        manifest = library.manifest(node.part)
        if not self.applies_to(manifest):
            return False
        default = manifest.attached_parameters[self.parameter].default
        return self.low <= dict(node.parameters).get(self.parameter, default) <= self.high


Condition = PartCondition | ManufacturerCondition | RangeCondition


@dataclass(frozen=True)
class HoldOutRule:
    """Conditions that hold together for a held-out robot, each for one of its parts."""

    conditions: tuple[Condition, ...]

    def __str__(self) -> str:
        return "+".join(map(str, self.conditions))

    @property
    def holds_out_parts(self) -> bool:
        """Whether parts are held out as such, rather than a combination or a range."""
        return len(self.conditions) == 1 and not isinstance(self.conditions[0], RangeCondition)

    def holds(self, derivation: Derivation, library: Library) -> bool:
        """Test if a robot is held out."""
        return all(
            any(condition.matches(node, library) for node in derivation.walk())
            for condition in self.conditions
        )

    def matching_parts(self, derivation: Derivation, library: Library) -> frozenset[str]:
        """Return the parts of a robot for which a condition holds."""
        return frozenset(
            node.part
            for node in derivation.walk()
            if any(condition.matches(node, library) for condition in self.conditions)
        )


def parse_rules(
    texts: Sequence[str], library: Library, origin: str = "--hold-out"
) -> tuple[HoldOutRule, ...]:
    """Parse rules; each text has one, or several that are separated by commas.

    Args:
        texts: The texts.
        library: Library of the parts that rules may name.
        origin: Option or key that has the texts, for messages.

    Raises:
        BenchmarkError: If a rule is malformed, names nothing in the library, or is there twice.
    """
    rules: list[HoldOutRule] = []
    for text in texts:
        for entry in text.split(","):
            terms = [term.strip() for term in entry.split("+")]
            rule = HoldOutRule(tuple(_condition(term, text, library, origin) for term in terms))
            if rule in rules:
                raise BenchmarkError(f"{origin} {text}: {rule} is there twice")
            rules.append(rule)
    if not rules:
        raise BenchmarkError(f"{origin}: nothing is held out; expected such as {EXAMPLES}")
    return tuple(rules)


def held_out_parts(
    rules: Sequence[HoldOutRule], derivation: Derivation, library: Library
) -> frozenset[str]:
    """Return the parts of a robot that are held out as such; no train robot has them."""
    whole = [rule for rule in rules if rule.holds_out_parts]
    return frozenset[str]().union(*(rule.matching_parts(derivation, library) for rule in whole))


def _condition(term: str, text: str, library: Library, origin: str) -> Condition:
    where = f"{origin} {text}" if term == text else f"{origin} {text}: {term or 'empty rule'}"
    key, _, value = term.partition("=")
    if not key or not value:
        raise BenchmarkError(f"{where}: expected KEY=VALUE, such as {EXAMPLES}")
    owner, dot, name = key.rpartition(".")
    if key in PART_KINDS:
        _require_match(value, library.names(key), key, where)
        return PartCondition(key, value)
    if name == MANUFACTURER and (not dot or owner in PART_KINDS):
        condition = ManufacturerCondition(cast(PartKind, owner) if dot else None, value)
        manifests = library.manifests(condition.kind)
        if not any(map(condition.matches_manifest, manifests)):
            valid = {manifest.manufacturer for manifest in manifests} - {""}
            raise BenchmarkError(f"{where}: no manufacturer {value!r}{nearest(value, valid)}")
        return condition
    if dot:
        return _range(owner, name, value, library, where)
    keys = [*PART_KINDS, MANUFACTURER]
    raise BenchmarkError(
        f"{where}: unknown key {key!r}{nearest(key, keys)}, or PART.PARAMETER=LOW..HIGH"
    )


def _range(owner: str, name: str, value: str, library: Library, where: str) -> RangeCondition:
    manifests = [manifest for manifest in library.manifests() if _is_owner(owner, manifest)]
    if not manifests:
        _require_match(owner, [*PART_KINDS, *library.paths], "part", where)
    known = [m.attached_parameters[name] for m in manifests if name in m.attached_parameters]
    if not known:
        valid = {parameter for manifest in manifests for parameter in manifest.attached_parameters}
        raise BenchmarkError(f"{where}: {owner} has no parameter {name!r}{nearest(name, valid)}")
    if len({parameter.unit for parameter in known}) > 1:
        raise BenchmarkError(f"{where}: {name!r} has several units in {owner}; name one part")
    low, dots, high = value.partition("..")
    if not dots:
        raise BenchmarkError(
            f"{where}: {value!r} is no range; expected LOW..HIGH, such as 0.3..0.4"
        )
    widest = Parameter(
        known[0].default,
        min(parameter.minimum for parameter in known),
        max(parameter.maximum for parameter in known),
        known[0].unit,
        integer=all(parameter.integer for parameter in known),
    )
    try:
        bounds = [parse_value(bound, widest, f"{owner}.{name}") for bound in (low, high)]
    except PartError as error:
        raise BenchmarkError(f"{where}: {error}") from error
    if bounds[0] > bounds[1]:
        raise BenchmarkError(f"{where}: {low} is above {high}; expected LOW..HIGH")
    return RangeCondition(owner, name, *bounds)


def _is_owner(owner: str, manifest: Manifest) -> bool:
    if owner in PART_KINDS:
        return manifest.kind == owner
    return fnmatchcase(manifest.name, owner)


def _require_match(pattern: str, names: Sequence[str], what: str, where: str) -> None:
    if not any(fnmatchcase(name, pattern) for name in names):
        raise BenchmarkError(f"{where}: no {what} matches {pattern!r}{nearest(pattern, names)}")
