"""Requests for splits, and what their robots have in common."""

from morphgen.benchmark.generate import SplitRequest
from morphgen.benchmark.regimes import regime_findings
from morphgen.grammar.library import default_library
from morphgen.grammar.syntax import parse_derivation
from morphgen.splits.split import compose_member

LIBRARY = default_library()


def order(*train, test=1, **changes):
    return SplitRequest("mine", train, test, **changes)


def derivations(members):
    return [parse_derivation(member.derivation) for member in members]


def names(members):
    return [member.name for member in members]


def require_sound(split):
    """Assert that the robots can be composed and that the rules of the regime hold."""
    for member in (*split.train, *split.test):
        assert compose_member(member, LIBRARY).name == member.name
    assert regime_findings(split, LIBRARY) == ()
