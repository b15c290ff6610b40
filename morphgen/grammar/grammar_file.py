"""Find, read and write grammar files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path

from morphgen.errors import GrammarError, nearest
from morphgen.grammar import syntax
from morphgen.grammar.values import require_condition

SUFFIX = ".grammar"


@dataclass(frozen=True)
class Grammar:
    """The statements of a grammar file and its includes."""

    name: str  # name of the file without its suffix
    start: str  # the symbol that derivations begin with: the first one of the file
    productions: tuple[syntax.Production, ...]
    lets: tuple[syntax.Let, ...] = ()  # named values that are drawn once per robot
    wheres: tuple[syntax.Expression, ...] = ()  # conditions that every robot meets
    digest: str = ""  # SHA-256 of the texts that the grammar was read from, hexadecimal

    def production(self, symbol: str) -> syntax.Production | None:
        """Return the production of a symbol; None if the name is a part."""
        return self._by_symbol.get(symbol)

    def alternatives(self) -> Iterator[tuple[syntax.Production, syntax.Alternative]]:
        """Yield every alternative with its production."""
        for production in self.productions:
            for alternative in production.alternatives:
                yield production, alternative

    @cached_property
    def _by_symbol(self) -> Mapping[str, syntax.Production]:
        return {production.symbol: production for production in self.productions}


def grammar_names() -> list[str]:
    """Return the names of the grammars that come with morphgen."""
    return sorted(path.stem for path in _shipped().glob(f"*{SUFFIX}"))


def grammar_summary(name: str) -> str:
    """Return the description in the first comment of a grammar that comes with morphgen."""
    with (_shipped() / f"{name}{SUFFIX}").open(encoding="utf-8") as lines:
        return lines.readline().partition(": ")[2].strip()


def find_grammar(name: str, folders: Iterable[Path] = ()) -> Path:
    """Return the file of a grammar."""
    if name.endswith(SUFFIX) or "/" in name:
        path = Path(name)
        if not path.is_file():
            what = "a folder, not a grammar" if path.is_dir() else "no such file"
            raise GrammarError(f"{path}: {what}")
        return path
    # Grammars of users hide shipped ones of their name.
    users = [folder for folder in folders if not _shipped().is_relative_to(folder)]
    paths = [path for folder in (*users, _shipped()) for path in sorted(folder.rglob(f"*{SUFFIX}"))]
    for path in paths:
        if path.stem == name:
            return path
    raise GrammarError(f"unknown grammar {name!r}{nearest(name, {path.stem for path in paths})}")


def load_grammar(path: Path, folders: Iterable[Path] = ()) -> Grammar:
    """Read a grammar with its includes, whose symbols and values it may replace."""
    reader = _Reader(path, tuple(folders))
    return _build(path.stem, str(path), reader.statements, reader.texts)


def grammar_from_text(text: str, name: str) -> Grammar:
    """Read a grammar from a text without includes, such as that of ``grammar_text``."""
    statements = syntax.parse_grammar(text, name)
    for statement in statements:
        if isinstance(statement, syntax.Include):
            raise GrammarError(
                f"{statement.location}: a grammar given as text cannot include others"
            )
    _require_unique(statements)
    return _build(name, name, statements, [text])


def grammar_text(grammar: Grammar) -> str:
    """Return the grammar with its includes as one text, the start symbol first."""
    lines = [f"let {let.name} = {let.expression}" for let in grammar.lets]
    for production in sorted(grammar.productions, key=lambda p: p.symbol != grammar.start):
        alternatives = map(_alternative_text, production.alternatives)
        lines.append(f"{production.symbol} -> {' | '.join(alternatives)}")
    lines += [f"where {condition}" for condition in grammar.wheres]
    text = "".join(f"{line}\n" for line in lines)
    syntax.require_at_most(
        len(text), syntax.MAX_TEXT, f"{grammar.name}: {len(text):,} characters as one text"
    )
    return text


def _alternative_text(alternative: syntax.Alternative) -> str:
    weight = f"@weight({alternative.weight}) " if alternative.weight else ""
    return weight + " ".join(map(_item_text, alternative.items))


def _item_text(item: syntax.Item) -> str:
    values = ", ".join(f"{name}={value}" for name, value in item.arguments)
    low, high = item.repetition or (0, 0)
    return (
        (f"{item.port}:" if item.port else "")
        + item.name
        + (f"({values})" if values else "")
        + (f"{{{low},{high}}}" if item.repetition else "")
    )


def _build(
    name: str, origin: str, statements: Sequence[syntax.Statement], texts: Iterable[str]
) -> Grammar:
    productions = [s for s in statements if isinstance(s, syntax.Production)]
    if not productions:
        raise GrammarError(f"{origin}: no production, such as: robot -> base arm ee")
    in_file = [p for p in productions if p.location.origin == origin]
    start = (in_file or productions)[0].symbol
    wheres = tuple(s.condition for s in statements if isinstance(s, syntax.Where))
    for where in wheres:
        require_condition(where)
    # Of several definitions the last counts; a file comes after those that it includes.
    symbols = {p.symbol: p for p in productions}
    lets = {s.name: s for s in statements if isinstance(s, syntax.Let)}
    digest = hashlib.sha256("\0".join(texts).encode()).hexdigest()
    return Grammar(name, start, tuple(symbols.values()), tuple(lets.values()), wheres, digest)


class _Reader:
    """Reads a grammar with its includes; the limits apply to all files together."""

    def __init__(self, path: Path, folders: tuple[Path, ...]) -> None:
        self._folders = folders
        self._roots = [folder.resolve() for folder in (path.parent, *folders, _shipped())]
        self.statements: list[syntax.Statement] = []
        """Statements of all files, those of an include before those of the including file."""
        self.texts: list[str] = []
        self._read(path, ())
        what = f"{path}: {len(self.statements):,} statements with its includes"
        syntax.require_at_most(len(self.statements), syntax.MAX_STATEMENTS, what)

    def _read(self, path: Path, above: tuple[Path, ...]) -> None:
        if path.resolve() in (p.resolve() for p in above):
            chain = " -> ".join(p.name for p in (*above, path))
            raise GrammarError(f"{above[-1]}: grammars include each other: {chain}")
        text = self._text(path)
        statements: list[syntax.Statement] = []
        for statement in syntax.parse_grammar(text, str(path)):
            if isinstance(statement, syntax.Include):
                self._read(self._included(statement, path), (*above, path))
            else:
                statements.append(statement)
        _require_unique(statements)
        self.statements += statements

    def _text(self, path: Path) -> str:
        """Read a file; the size limit applies to it and all files read before."""
        if len(self.texts) == syntax.MAX_FILES:
            raise GrammarError(
                f"{path}: one file too many: a grammar is read from at most {syntax.MAX_FILES}"
            )
        room = syntax.MAX_TEXT - sum(len(text.encode()) for text in self.texts)
        try:
            with path.open("rb") as file:
                content = file.read(room + 1)
            text = content.decode("utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise GrammarError(f"{path}: cannot be read: {error}") from error
        if len(content) > room:
            raise GrammarError(
                f"{path}: {path.stat().st_size:,} bytes; expected at most {syntax.MAX_TEXT:,} in a "
                "grammar with its includes"
            )
        self.texts.append(text)
        return text

    def _included(self, include: syntax.Include, path: Path) -> Path:
        """Return the file that an include in the file ``path`` names."""
        if not (include.target.endswith(SUFFIX) or "/" in include.target):
            try:
                return find_grammar(include.target, self._folders)
            except GrammarError as error:
                raise GrammarError(f"{include.location}: {error}") from error
        target = path.parent / include.target
        try:
            is_allowed = any(target.resolve().is_relative_to(root) for root in self._roots)
            exists = is_allowed and target.is_file()
        except (OSError, ValueError):  # a name that is invalid for the file system
            is_allowed, exists = True, False
        if not is_allowed:
            raise GrammarError(
                f"{include.location}: include {include.target!r} leads outside of "
                f"{self._roots[0]}; an include stays in the folder of its grammar or in a "
                "library (--library DIR)"
            )
        if not exists:
            raise GrammarError(f"{include.location}: include {include.target!r}: no such file")
        return target


def _require_unique(statements: Iterable[syntax.Statement]) -> None:
    """Require that a file defines no symbol and no ``let`` twice."""
    definitions: dict[tuple[type, str], syntax.SourceLocation] = {}
    for statement in statements:
        if isinstance(statement, syntax.Production | syntax.Let):
            name = statement.symbol if isinstance(statement, syntax.Production) else statement.name
            key = (type(statement), name)
            if key in definitions:
                raise GrammarError(
                    f"{statement.location}: {name!r} is already defined at {definitions[key]}"
                )
            definitions[key] = statement.location


def _shipped() -> Path:
    """Return the folder of the grammars that come with morphgen."""
    return Path(str(files("morphgen.templates"))) / "grammars"
