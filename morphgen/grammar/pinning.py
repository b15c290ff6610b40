"""Pin what a grammar leaves open: ``beads=5 bead.radius=20mm arm=ur5``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from morphgen.errors import GrammarError, nearest
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_WORD
from morphgen.grammar.parameters import MOUNT_YAW, parse_value
from morphgen.grammar.syntax import (
    Alternative,
    Expression,
    Item,
    Let,
    Production,
    SourceLocation,
    parse_condition,
)
from morphgen.grammar.values import Scope, evaluate, no_draw


def pin(grammar: Grammar, words: Sequence[str], library: Library) -> Grammar:
    """The grammar with some of its choices made.

    ``symbol=name`` keeps the alternatives of a symbol that begin with a name, ``symbol=5`` fixes
    its repetition, ``part.parameter=value`` a parameter wherever the part stands, ``name=value``
    a value of ``let``.

    Args:
        grammar: The grammar.
        words: ``key=value`` words, in any order.
        library: Where its parts are.

    Raises:
        GrammarError: If a word is malformed or names nothing in the grammar.
        PartError: If a value is no number, of another unit or out of range.
    """
    for word in words:
        key, equals, value = word.partition("=")
        if not equals or not key or not value:
            raise GrammarError(f"{word!r} is not of the form key=value, such as beads=5")
        owner, dot, name = key.rpartition(".")
        if dot:
            grammar = _with_parameter(grammar, owner, name, value, library)
        elif any(let.name == key for let in grammar.lets):
            grammar = _with_let(grammar, key, value)
        else:
            grammar = _with_symbol(grammar, key, value)
    return grammar


def _with_parameter(
    grammar: Grammar, part: str, name: str, value: str, library: Library
) -> Grammar:
    parts = {
        item.name
        for production in grammar.productions
        for alternative in production.alternatives
        for item in alternative.items
        if grammar.production(item.name) is None
    }
    if part not in parts:
        raise GrammarError(
            f"{part}.{name}: no part {part!r} in {grammar.name!r}{nearest(part, parts)}"
        )
    parameters = {**library.manifest(part).parameters, MOUNT_YAW.name: MOUNT_YAW}
    if name not in parameters:
        raise GrammarError(f"{part!r} has no parameter {name!r}{nearest(name, parameters)}")
    number = _number(parse_value(value, parameters[name], f"{part}.{name}"))

    def pinned(item: Item) -> Item:
        if item.name != part:
            return item
        others = tuple(entry for entry in item.arguments if entry[0] != name)
        return replace(item, arguments=(*others, (name, number)))

    return _with_productions(
        grammar,
        [
            replace(
                production,
                alternatives=tuple(
                    replace(alternative, items=tuple(pinned(item) for item in alternative.items))
                    for alternative in production.alternatives
                ),
            )
            for production in grammar.productions
        ],
    )


def _with_let(grammar: Grammar, name: str, value: str) -> Grammar:
    number = parse_condition(value, f"{name}={value}")
    unsigned = number.operands[0] if number.operator == "negative" else number
    if unsigned.operator != "number":
        raise GrammarError(f"{name}={value}: not a number, such as 0.02 or 20mm")
    evaluate(number, Scope({}, no_draw, name))
    lets = tuple(
        Let(let.name, number, let.location) if let.name == name else let for let in grammar.lets
    )
    return replace(grammar, lets=lets)


def _with_symbol(grammar: Grammar, symbol: str, value: str) -> Grammar:
    production = grammar.production(symbol)
    if production is None:
        valid = [*(p.symbol for p in grammar.productions), *(let.name for let in grammar.lets)]
        raise GrammarError(f"{symbol}={value}: no symbol {symbol!r}{nearest(symbol, valid)}")
    if value.isdecimal() and len(value) <= MAX_WORD:
        pinned = _with_count(production, int(value))
    else:
        kept = tuple(a for a in production.alternatives if a.items[0].name == value)
        if not kept:
            valid = [alternative.items[0].name for alternative in production.alternatives]
            raise GrammarError(f"{symbol}={value}: no such alternative{nearest(value, valid)}")
        pinned = replace(production, alternatives=kept)
    return _with_productions(
        grammar, [pinned if p.symbol == symbol else p for p in grammar.productions]
    )


def _with_count(production: Production, count: int) -> Production:
    found = [
        (alternative, item)
        for alternative in production.alternatives
        for item in alternative.items
        if item.repetition is not None and item.repetition[0] < item.repetition[1]
    ]
    if len(found) != 1:
        raise GrammarError(
            f"{production.symbol}={count}: {production.symbol!r} has {len(found)} repetitions to "
            "pin, not one"
        )
    ((alternative, repeated),) = found
    low, high = repeated.repetition or (1, 1)
    if not low <= count <= high:
        raise GrammarError(f"{production.symbol}={count}: expected {low} to {high}")
    fixed = replace(repeated, repetition=(count, count))
    items = tuple(fixed if item is repeated else item for item in alternative.items)
    return replace(production, alternatives=(Alternative(items, alternative.weight),))


def _with_productions(grammar: Grammar, productions: Sequence[Production]) -> Grammar:
    return replace(grammar, productions=tuple(productions))


def _number(value: float) -> Expression:
    return Expression("number", (), SourceLocation("command line", 1, 1), "", value)
