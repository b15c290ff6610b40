"""Test what a split says of what it holds out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from morphgen.benchmark.hold_out_rules import HoldOutRule, held_out_parts, parse_rules
from morphgen.benchmark.regimes import parts
from morphgen.benchmark.split import HOLD_OUT, HOLD_OUT_KEY, Member, Side, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding


def has_hold_out_rules(split: Split) -> bool:
    """Return whether a split claims to hold something out."""
    return split.regime == HOLD_OUT or HOLD_OUT_KEY in split.provenance


def hold_out_rules(split: Split, library: Library) -> tuple[HoldOutRule, ...]:
    """Return the rules of what a split holds out.

    Raises:
        BenchmarkError: If they are missing or malformed, or name nothing in the library.
    """
    origin = f"split {split.name!r}: made: {HOLD_OUT_KEY}"
    texts = split.provenance.get(HOLD_OUT_KEY)
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        raise BenchmarkError(f"{origin}: {texts!r}; expected a list such as ['arm=kinova*']")
    return parse_rules(texts, library, origin)


def hold_out_findings(split: Split, library: Library) -> tuple[Finding, ...]:
    """Return the violations of what a split says is held out; all are errors.

    - ``held-out-trained``: a train robot has what is held out;
    - ``held-out-absent``: a test robot does not have it;
    - ``held-out-untested``: a rule holds for no test robot;
    - ``part-unseen``: a part of a test robot is not held out as such, but no train robot has it.

    Raises:
        BenchmarkError: If the rules are missing or malformed.
        GrammarError: If a derivation is malformed.
        PartError: If the library lacks a part.
    """
    rules = hold_out_rules(split, library)
    train, test = (
        [(m, parse_derivation(m.derivation, f"derivation of {m.name!r}")) for m in members]
        for members in (split.train, split.test)
    )
    return (
        *_train_findings(rules, train, library),
        *_test_findings(rules, train, test, library),
        *_untested(rules, test, library),
    )


def related_parts(split: Split, library: Library) -> dict[str, tuple[str, ...]]:
    """Return train parts of the kind and manufacturer of parts that are held out by their names.

    ``arm=kinova*`` does not hold out ``mico``, which is Kinova's, too: users may not expect that.

    Returns:
        The parts by the rule that holds them out, such as ``arm.manufacturer=Kinova``.
    """
    named = [rule for rule in hold_out_rules(split, library) if rule.holds_out_parts]
    held = {
        part
        for member in split.test
        for part in held_out_parts(named, parse_derivation(member.derivation), library)
    }
    trained = {
        part for member in split.train for part in parts(parse_derivation(member.derivation))
    }
    related: dict[str, tuple[str, ...]] = {}
    for manifest in map(library.manifest, sorted(held)):
        same = [
            part
            for part in sorted(trained)
            if (library.manifest(part).kind, library.manifest(part).manufacturer)
            == (manifest.kind, manifest.manufacturer)
        ]
        if manifest.manufacturer and same:
            related[f"{manifest.kind}.manufacturer={manifest.manufacturer}"] = tuple(same)
    return related


Parsed = tuple[Member, Derivation]


def _train_findings(
    rules: Sequence[HoldOutRule], train: Sequence[Parsed], library: Library
) -> Iterator[Finding]:
    for member, derivation in train:
        for rule in rules:
            if rule.holds(derivation, library):
                names = ", ".join(sorted(rule.matching_parts(derivation, library)))
                why = f"it has {names}, and the split holds out {rule}"
                yield _finding("held-out-trained", "train", member, why, "leave it out of train")


def _test_findings(
    rules: Sequence[HoldOutRule],
    train: Sequence[Parsed],
    test: Sequence[Parsed],
    library: Library,
) -> Iterator[Finding]:
    trained = frozenset[str]().union(*(parts(derivation) for _, derivation in train))
    for member, derivation in test:
        if not any(rule.holds(derivation, library) for rule in rules):
            why = f"it has nothing that the split holds out: {', '.join(map(str, rules))}"
            yield _finding("held-out-absent", "test", member, why, "leave it out of test")
        unseen = parts(derivation) - trained - held_out_parts(rules, derivation, library)
        if unseen:
            why = f"no train robot has {', '.join(map(repr, sorted(unseen)))}, which no rule names"
            fix = "train on a robot that has it, or hold it out, too"
            yield _finding("part-unseen", "test", member, why, fix)


def _untested(
    rules: Sequence[HoldOutRule], test: Sequence[Parsed], library: Library
) -> Iterator[Finding]:
    for rule in rules:
        if not any(rule.holds(derivation, library) for _, derivation in test):
            yield Finding(
                "held-out-untested",
                "error",
                f"rule {rule}",
                "no test robot has what it holds out",
                "add a test robot that has it, or delete the rule",
            )


def _finding(code: str, side: Side, member: Member, why: str, fix: str) -> Finding:
    return Finding(code, "error", f"{side} robot {member.name}", why, fix)
