"""Pin choices that a grammar leaves open: ``beads=5 bead.radius=20mm arm=ur5``."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from morphgen.errors import GrammarError, nearest
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_WORD
from morphgen.grammar.parameters import parse_value
from morphgen.grammar.syntax import (
    Alternative,
    Expression,
    Item,
    Production,
    SourceLocation,
    parse_condition,
)
from morphgen.grammar.values import Scope, evaluate, typical_value


def pin(grammar: Grammar, words: Sequence[str], library: Library) -> Grammar:
    """Return the grammar with some of its choices fixed.

    ``symbol=name`` keeps the alternatives of a symbol that begin with a name; ``symbol=5`` fixes
    the count of its repetition; ``part.parameter=value`` fixes a parameter of every copy of a
    part; ``name=value`` fixes a value of ``let``.

    Args:
        grammar: The grammar.
        words: ``key=value`` words, in any order.
        library: Library of the grammar's parts.

    Raises:
        GrammarError: If a word is malformed or names nothing in the grammar.
        PartError: If a value is not a number, has the wrong unit or is out of range.
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
            grammar = _pin_symbol(grammar, key, value)
    return grammar


def _pin_parameter(grammar: Grammar, part: str, name: str, value: str, library: Library) -> Grammar:
    names = {item.name for production in grammar.productions for item in production.items()}
    parts = {name for name in names if grammar.production(name) is None}
    if part not in parts:
        raise GrammarError(
            f"{part}.{name}: no part {part!r} in {grammar.name!r}{nearest(part, parts)}"
        )
    parameters = library.manifest(part).attached_parameters
    if name not in parameters:
        raise GrammarError(f"{part!r} has no parameter {name!r}{nearest(name, parameters)}")
    pinned_value = parse_value(value, parameters[name], f"{part}.{name}")
    number = Expression("number", (), SourceLocation("command line", 1, 1), "", pinned_value)

    def pinned(item: Item) -> Item:
        if item.name != part:
            return item
        other_arguments = tuple(entry for entry in item.arguments if entry[0] != name)
        return replace(item, arguments=(*other_arguments, (name, number)))

    def with_items(alternative: Alternative) -> Alternative:
        return replace(alternative, items=tuple(map(pinned, alternative.items)))

    return _with_productions(
        grammar, lambda p: replace(p, alternatives=tuple(map(with_items, p.alternatives)))
    )


def _pin_let(grammar: Grammar, name: str, value: str) -> Grammar:
    number = parse_condition(value, f"{name}={value}")
    unsigned = number.operands[0] if number.operator == "negative" else number
    if unsigned.operator != "number":
        raise GrammarError(f"{name}={value}: not a number, such as 0.02 or 20mm")
    evaluate(number, Scope({}, typical_value, name))  # raises if the unit is unknown
    lets = (replace(let, expression=number) if let.name == name else let for let in grammar.lets)
    return replace(grammar, lets=tuple(lets))


def _pin_symbol(grammar: Grammar, symbol: str, value: str) -> Grammar:
    production = grammar.production(symbol)
    if production is None:
        valid = [*(p.symbol for p in grammar.productions), *(let.name for let in grammar.lets)]
        raise GrammarError(f"{symbol}={value}: no symbol {symbol!r}{nearest(symbol, valid)}")
    if value.isdecimal() and len(value) <= MAX_WORD:
        pinned = _with_count(production, int(value))
    else:
        alternatives = tuple(a for a in production.alternatives if a.items[0].name == value)
        if not alternatives:
            valid = [alternative.items[0].name for alternative in production.alternatives]
            if any(item.repetition for a in production.alternatives for item in a.items):
                valid.append("a whole number of repetitions")
            raise GrammarError(f"{symbol}={value}: no such alternative{nearest(value, valid)}")
        pinned = replace(production, alternatives=alternatives)
    return _with_productions(grammar, lambda p: pinned if p.symbol == symbol else p)


def _with_count(production: Production, count: int) -> Production:
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


def _with_productions(grammar: Grammar, change: Callable[[Production], Production]) -> Grammar:
    """Return the grammar with every production changed."""
    return replace(grammar, productions=tuple(map(change, grammar.productions)))
