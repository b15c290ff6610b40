"""A grammar: symbols, values drawn once a robot, and conditions."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from morphgen.errors import GrammarError, nearest
from morphgen.grammar.conditions import require_condition
from morphgen.grammar.syntax import (
    Alternative,
    Expression,
    Include,
    Item,
    Let,
    Place,
    Production,
    Statement,
    Where,
    parse_grammar,
)

SUFFIX = ".grammar"


@dataclass(frozen=True)
class Grammar:
    """Everything that a grammar file and its includes say."""

    name: str
    start: str
    """The symbol that a robot is: the first of the file."""
    productions: tuple[Production, ...]
    lets: tuple[Let, ...] = ()
    wheres: tuple[Expression, ...] = ()
    digest: str = ""
    """SHA-256 of the texts that it was read from, hexadecimal."""

    def production(self, symbol: str) -> Production | None:
        """How a symbol is rewritten; None if the name is a part."""
        return next((p for p in self.productions if p.symbol == symbol), None)


def grammar_names() -> list[str]:
    """Names of the grammars that come with morphgen."""
    return sorted(path.stem for path in _shipped().glob(f"*{SUFFIX}"))


def find_grammar(name: str, folders: Iterable[Path] = ()) -> Path:
    """The file of a grammar.

    Args:
        name: A path, or the name of a grammar of a user's library or of morphgen's own.
        folders: The user's library.

    Raises:
        GrammarError: If there is none.
    """
    if name.endswith(SUFFIX) or "/" in name:
        path = Path(name)
        if not path.is_file():
            raise GrammarError(f"{path}: no such file")
        return path
    users = [folder for folder in folders if not _shipped().is_relative_to(folder)]
    found = [path for folder in (*users, _shipped()) for path in sorted(folder.rglob(f"*{SUFFIX}"))]
    for path in found:
        if path.stem == name:
            return path
    raise GrammarError(f"unknown grammar {name!r}{nearest(name, {path.stem for path in found})}")


def load_grammar(path: Path, folders: Iterable[Path] = ()) -> Grammar:
    """Read a grammar and what it includes.

    A file may say anew what a symbol or value of an included file is.

    Raises:
        GrammarError: If a file cannot be read or parsed, includes itself, or names a symbol twice.
    """
    return _assembled(path.stem, str(path), *_read(path, tuple(folders), ()))


def grammar_from_text(text: str, name: str) -> Grammar:
    """Read a grammar from text without includes, such as ``grammar_text`` gives.

    Raises:
        GrammarError: If the text cannot be parsed, or includes another grammar.
    """
    statements = parse_grammar(text, name)
    for statement in statements:
        if isinstance(statement, Include):
            raise GrammarError(f"{statement.place}: a grammar given as text includes no other")
    _require_unique(statements)
    return _assembled(name, name, list(statements), [text])


def grammar_text(grammar: Grammar) -> str:
    """The grammar with its includes as one text, the start symbol first."""
    ordered = sorted(grammar.productions, key=lambda p: p.symbol != grammar.start)
    lines = [f"let {let.name} = {let.expression}" for let in grammar.lets]
    for production in ordered:
        alternatives = " | ".join(_alternative_text(a) for a in production.alternatives)
        lines.append(f"{production.symbol} -> {alternatives}")
    lines += [f"where {condition}" for condition in grammar.wheres]
    return "".join(f"{line}\n" for line in lines)


def _alternative_text(alternative: Alternative) -> str:
    weight = f"@weight({alternative.weight}) " if alternative.weight else ""
    return weight + " ".join(_item_text(item) for item in alternative.items)


def _item_text(item: Item) -> str:
    values = ", ".join(f"{name}={value}" for name, value in item.arguments)
    low, high = item.repetition or (0, 0)
    return (
        (f"{item.port}:" if item.port else "")
        + item.name
        + (f"({values})" if values else "")
        + (f"{{{low},{high}}}" if item.repetition else "")
    )


def _assembled(name: str, origin: str, statements: list[Statement], texts: list[str]) -> Grammar:
    productions = [s for s in statements if isinstance(s, Production)]
    if not productions:
        raise GrammarError(f"{origin}: no production, such as: robot -> base arm ee")
    own = [p for p in productions if p.place.origin == origin]
    start = (own or productions)[0].symbol
    wheres = tuple(s.condition for s in statements if isinstance(s, Where))
    for where in wheres:
        require_condition(where)
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return Grammar(
        name,
        start,
        tuple({p.symbol: p for p in productions}.values()),
        tuple({s.name: s for s in statements if isinstance(s, Let)}.values()),
        wheres,
        digest,
    )


def _read(
    path: Path, folders: tuple[Path, ...], above: tuple[Path, ...]
) -> tuple[list[Statement], list[str]]:
    """Statements of a file after those of its includes, and all texts."""
    if path.resolve() in (p.resolve() for p in above):
        chain = " -> ".join(p.name for p in (*above, path))
        raise GrammarError(f"{above[-1]}: grammars include each other: {chain}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise GrammarError(f"{path}: cannot be read: {error}") from error
    statements: list[Statement] = []
    texts = [text]
    own: list[Statement] = []
    for statement in parse_grammar(text, str(path)):
        if not isinstance(statement, Include):
            own.append(statement)
            continue
        try:
            target = _included(statement, path, folders)
        except GrammarError as error:
            raise GrammarError(f"{statement.place}: {error}") from error
        below, more = _read(target, folders, (*above, path))
        statements += below
        texts += more
    _require_unique(own)
    return [*statements, *own], texts


def _included(statement: Include, path: Path, folders: tuple[Path, ...]) -> Path:
    target = statement.target
    if not (target.endswith(SUFFIX) or "/" in target):
        return find_grammar(target, folders)
    beside = path.parent / target
    try:
        is_own = beside.resolve().is_relative_to(path.parent.resolve())
        is_there = is_own and beside.is_file()
    except (OSError, ValueError):  # a name that no file system takes
        is_own, is_there = True, False
    if not is_own:
        raise GrammarError(f"include {target!r} leads out of the folder of {path.name}")
    if not is_there:
        raise GrammarError(f"include {target!r}: no such file")
    return beside


def _require_unique(statements: Iterable[Statement]) -> None:
    seen: dict[tuple[type, str], Place] = {}
    for statement in statements:
        if isinstance(statement, Production | Let):
            name = statement.symbol if isinstance(statement, Production) else statement.name
            key = (type(statement), name)
            if key in seen:
                raise GrammarError(f"{statement.place}: {name!r} is defined at {seen[key]} already")
            seen[key] = statement.place


def _shipped() -> Path:
    return Path(str(files("morphgen.templates"))) / "grammars"
