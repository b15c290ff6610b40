"""Parse grammars and derivations to syntax trees; errors name the line and column.

A derivation is written ``base=fixed(spread=0.6)[top: arm=ur5[flange: ee=stick]]``: a label, the
part, its parameters in SI units, and the derivations attached to its ports.
"""

from __future__ import annotations

import hashlib
import string
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from lark import Lark, Token, UnexpectedInput, v_args
from lark.exceptions import VisitError
from lark.visitors import Transformer_NonRecursive

from morphgen.errors import GrammarError, nearest
from morphgen.formats.rounding import format_number

MAX_PARTS = 100
"""Largest number of parts of a robot, of copies in a repetition, and of nested symbols. A recursion
that goes deeper is considered endless; loaders of robots have smaller limits."""
MAX_TEXT = 64 * 1024
"""Largest size of a grammar with its includes, and of a condition [bytes]; all shipped grammars
together have 3 kB."""
MAX_FILES = 100  # largest number of files of a grammar, including itself
MAX_STATEMENTS = 1000  # largest number of statements of a grammar with its includes
MAX_ALTERNATIVES = 1000  # largest number of alternatives of one symbol
MAX_WORD = 100  # largest length of a name or a number [characters]
MAX_NESTING = 100  # largest depth of an expression; `1 + 1 + 1` has three levels
MAX_FAULTS = 20  # largest number of faults that `morphgen grammar check` reports at once
COUNT_DIGITS = 100  # exponent of `MAX_COUNT`
MAX_COUNT: int = 10**COUNT_DIGITS  # largest number of structures that is counted exactly
MAX_DERIVATION_TEXT = 256 * 1024  # largest length of a derivation's text [characters]


_SYNTAX = r"""
grammar: _END? [statement (_END statement)*]
?statement: include | let | where | production
include: "include" (STRING | NAME)
let: "let" NAME "=" sum
where: "where" or_
production: NAME _ARROW alternative ("|" alternative)*
alternative: [weight] item+
?weight: _WEIGHT "(" sum ")"
item: [NAME ":"] NAME ["(" [argument ("," argument)*] ")"] [repetition]
argument: NAME "=" sum
repetition: "{" INT ["," INT] "}"

?or_: and_ ("or" and_)*
?and_: not_ ("and" not_)*
?not_: "not" not_ -> negation
     | comparison
?comparison: sum (COMPARATOR sum)*

?sum: product (SIGN product)*
?product: signed (FACTOR signed)*
?signed: SIGN signed -> unary
       | atom
?atom: QUANTITY -> quantity
     | INT -> quantity
     | NAME "(" [sum ("," sum)*] ")" -> call
     | NAME -> name
     | "(" or_ ")"

_ARROW: "->"
_WEIGHT: "@weight"
COMPARATOR: "<=" | ">=" | "==" | "!=" | "<" | ">"
SIGN: "+" | "-"
FACTOR: "*" | "/"
INT: /\d+(?![\w.])/
QUANTITY: /(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?[a-zA-Z]*/
NAME: /(?!(include|let|where|and|or|not)\b)[A-Za-z_]\w*/
STRING: /"[^"\n]*"/
_END: /\n(?=[^ \t\r\n|#])/
_CONTINUED: /\n(?=[ \t\r\n|#]|\Z)/
_COMMENT: /#[^\n]*/
_SPACE: /[ \t\r]+/
%ignore _CONTINUED
%ignore _COMMENT
%ignore _SPACE
"""

_TOKEN_NAMES = {
    "$END": "the end",
    "_END": "a new line",
    "NAME": "a name",
    "INT": "a whole number",
    "QUANTITY": "a number",
    "STRING": 'a "path"',
    "SIGN": "'+' or '-'",
    "FACTOR": "'*' or '/'",
    "COMPARATOR": "a comparison such as '<'",
}
"""Names of the terminals that are no fixed text, for messages."""


def require_at_most(number: int, most: int, text: str) -> None:
    """Require that a size keeps a limit; ``text`` says where it is and what it is of."""
    if number > most:
        raise GrammarError(f"{text}; expected at most {most:,}")


@lru_cache(maxsize=1)
def _parser() -> Lark:
    return Lark(_SYNTAX, parser="lalr", start=["grammar", "or_"], maybe_placeholders=True)


def _message(error: UnexpectedInput, text: str, origin: str) -> str:
    """Return the location of a syntax error, what is there, and what may be there."""
    line, column, token = error.line, error.column, getattr(error, "token", None)
    kind = "" if token is None else token.type
    if kind in ("$END", "_END"):
        token_text = "the end" if kind == "$END" else "the end of the line"
    elif token is not None:
        token_text = repr(str(token) if len(token) <= MAX_WORD else f"{token[:MAX_WORD]}...")
    else:
        token_text = repr(text.split("\n")[line - 1][column - 1 : column])
    if kind == "$END":
        lines = text.rstrip().split("\n")
        line, column = len(lines), len(lines[-1]) + 1
    # Lark's parser and its lexer name what they expect by different attributes.
    attributes = (getattr(error, name, None) for name in ("accepts", "expected", "allowed"))
    names = next(filter(None, attributes), ())
    texts = {each.name: repr(each.pattern.value) for each in _parser().terminals} | _TOKEN_NAMES
    expected = sorted({texts[name] for name in names})
    return f"{origin}:{line}:{column}: found {token_text}, expected {' or '.join(expected)}"


@dataclass(frozen=True)
class SourceLocation:
    """Line and column in a text."""

    origin: str  # file or other name of the text
    line: int
    column: int

    def __str__(self) -> str:
        return f"{self.origin}:{self.line}:{self.column}"


@dataclass(frozen=True)
class Expression:
    """An arithmetic expression or a condition."""

    operator: str
    """``number``, ``name``, ``call``, ``negative``, an arithmetic sign, a comparator, ``and``,
    ``or`` or ``not``."""
    operands: tuple[Expression, ...]
    location: SourceLocation
    text: str = ""  # the name, the function's name, or the unit of a number
    value: float = 0.0  # value of a number in the unit as written, not in SI units
    levels: int = field(init=False, repr=False, compare=False)
    """Depth of the tree, at most ``MAX_NESTING``, so that recursive functions are safe."""

    def __post_init__(self) -> None:
        levels = 1 + max((operand.levels for operand in self.operands), default=0)
        what = f"{self.location}: an expression of more than {MAX_NESTING} levels"
        require_at_most(levels, MAX_NESTING, what)
        object.__setattr__(self, "levels", levels)

    def walk(self) -> Iterator[Expression]:
        """Yield the expression and all its operands, recursively."""
        yield self
        for operand in self.operands:
            yield from operand.walk()

    def __str__(self) -> str:
        match self.operator:
            case "number":
                return f"{str(self.value).removesuffix('.0')}{self.text}"
            case "name":
                return self.text
            case "call":
                return f"{self.text}({', '.join(map(str, self.operands))})"
            case "not":
                return f"not {self.operands[0]}"
            case "negative":
                return f"-{self.operands[0]}"
            case _:
                return f"({f' {self.operator} '.join(map(str, self.operands))})"


@dataclass(frozen=True)
class Item:
    """A symbol or a part in an alternative."""

    name: str
    location: SourceLocation
    port: str = ""  # port that the item is attached to; empty for the default port
    arguments: tuple[tuple[str, Expression], ...] = ()  # parameters of a part: (name, value)
    repetition: tuple[int, int] | None = None  # smallest and largest number of copies


@dataclass(frozen=True)
class Alternative:
    """A sequence of items that a symbol can be rewritten to."""

    items: tuple[Item, ...]
    weight: Expression | None = None  # relative probability of the alternative; None for 1


@dataclass(frozen=True)
class Production:
    """A symbol and its alternatives."""

    symbol: str
    alternatives: tuple[Alternative, ...]
    location: SourceLocation

    def items(self) -> Iterator[Item]:
        """Yield the items of all alternatives."""
        for alternative in self.alternatives:
            yield from alternative.items


@dataclass(frozen=True)
class Include:
    """An include of another grammar's statements."""

    target: str  # name or path of the grammar, as written
    location: SourceLocation


@dataclass(frozen=True)
class Let:
    """A named value that is drawn once per robot."""

    name: str
    expression: Expression
    location: SourceLocation


@dataclass(frozen=True)
class Where:
    """A condition that every robot meets; other draws are rejected."""

    condition: Expression


Statement = Production | Include | Let | Where


def parse_grammar(text: str, origin: str) -> tuple[Statement, ...]:
    """Parse the text of a grammar."""
    return tuple(_parse(text, origin, "grammar"))


def parse_condition(text: str, origin: str = "--where") -> Expression:
    """Parse a condition such as ``reach > 0.4 and dof >= 5``."""
    condition: Expression = _parse(text, origin, "or_")
    return condition


def _parse(text: str, origin: str, start: str) -> Any:
    require_at_most(len(text), MAX_TEXT, f"{origin}: a text of {len(text):,} characters")
    text = text.replace("\r\n", "\n")
    try:
        return _Builder(origin).transform(_parser().parse(text, start=start))
    except UnexpectedInput as error:
        raise GrammarError(_message(error, text, origin)) from error
    except VisitError as error:
        raise error.orig_exc from error


@v_args(inline=True)
class _Builder(Transformer_NonRecursive[Token, Any]):
    """Converts Lark's tree without recursion; a method per rule of the syntax."""

    def __init__(self, origin: str) -> None:
        super().__init__()
        self._origin = origin

    def _location(self, token: Token) -> SourceLocation:
        return SourceLocation(self._origin, token.line or 1, token.column or 1)

    def _word(self, token: Token) -> Token:
        what = f"{self._location(token)}: a word of {len(token):,} characters"
        require_at_most(len(token), MAX_WORD, what)
        return token

    NAME = INT = QUANTITY = _word

    def grammar(self, *children: Statement | None) -> list[Statement]:
        statements = [statement for statement in children if statement is not None]
        what = f"{self._origin}: {len(statements):,} statements"
        require_at_most(len(statements), MAX_STATEMENTS, what)
        return statements

    def include(self, target: Token) -> Include:
        return Include(str(target).strip('"'), self._location(target))

    def let(self, name: Token, expression: Expression) -> Let:
        return Let(str(name), expression, self._location(name))

    def where(self, condition: Expression) -> Where:
        return Where(condition)

    def production(self, symbol: Token, *alternatives: Alternative) -> Production:
        location = self._location(symbol)
        what = f"{location}: {len(alternatives):,} alternatives of {str(symbol)!r}"
        require_at_most(len(alternatives), MAX_ALTERNATIVES, what)
        return Production(str(symbol), alternatives, location)

    def alternative(self, weight: Expression | None, *items: Item) -> Alternative:
        return Alternative(items, weight)

    def argument(self, name: Token, expression: Expression) -> tuple[Token, Expression]:
        return (name, expression)

    def repetition(self, low: Token, high: Token | None) -> tuple[int, int]:
        m, n = int(low), int(high if high is not None else low)
        what = f"{self._location(low)}: repetition {{{m},{n}}}"
        if not 0 < m <= n:
            raise GrammarError(f"{what} needs 1 <= m <= n")
        if n > MAX_PARTS:
            raise GrammarError(f"{what}: expected at most {MAX_PARTS}, the most parts of a robot")
        return m, n

    def item(self, port: Token | None, name: Token, *rest: Any) -> Item:
        arguments: dict[str, Expression] = {}
        for key, value in filter(None, rest[:-1]):
            if str(key) in arguments:
                raise GrammarError(f"{self._location(key)}: {key} is given twice")
            arguments[str(key)] = value
        given = tuple(arguments.items())
        return Item(str(name), self._location(name), str(port or ""), given, rest[-1])

    def quantity(self, token: Token) -> Expression:
        text = str(token)
        digits = text.rstrip(string.ascii_letters)
        try:
            value = float(digits)
        except ValueError as error:
            raise GrammarError(f"{self._location(token)}: {text!r} is not a number") from error
        return Expression("number", (), self._location(token), text[len(digits) :], value)

    def name(self, token: Token) -> Expression:
        return Expression("name", (), self._location(token), str(token))

    def call(self, name: Token, *operands: Expression | None) -> Expression:
        arguments = tuple(operand for operand in operands if operand is not None)
        return Expression("call", arguments, self._location(name), str(name))

    def unary(self, sign: Token, operand: Expression) -> Expression:
        return operand if sign == "+" else Expression("negative", (operand,), self._location(sign))

    def sum(self, *parts: Any) -> Expression:
        """Fold operands and signs from the left: ``a - b - c`` is ``(a - b) - c``."""
        folded: Expression = parts[0]
        for sign, operand in zip(parts[1::2], parts[2::2], strict=True):
            folded = Expression(str(sign), (folded, operand), self._location(sign))
        return folded

    product = sum

    def comparison(self, *parts: Any) -> Expression:
        """Split a chain: ``a < b < c`` is ``a < b and b < c``."""
        pairs = [
            Expression(str(parts[i + 1]), (parts[i], parts[i + 2]), self._location(parts[i + 1]))
            for i in range(0, len(parts) - 2, 2)
        ]
        return pairs[0] if len(pairs) == 1 else Expression("and", tuple(pairs), pairs[0].location)

    def or_(self, *parts: Expression) -> Expression:
        return Expression("or", parts, parts[0].location)

    def and_(self, *parts: Expression) -> Expression:
        return Expression("and", parts, parts[0].location)

    def negation(self, operand: Expression) -> Expression:
        return Expression("not", (operand,), operand.location)


def unknown(what: str, name: str, location: SourceLocation, valid: Iterable[str]) -> GrammarError:
    """Return the error for an unknown name, with the valid ones."""
    return GrammarError(f"{location}: unknown {what} {name!r}{nearest(name, valid)}")


_DERIVATION_SYNTAX = r"""
node: NAME "=" NAME ["(" value ("," value)* ")"] ["[" child ("," child)* "]"]
value: NAME "=" NUMBER
child: NAME ":" node
NAME: /[A-Za-z_]\w*/
NUMBER: /[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?/
%ignore /\s+/
"""


@dataclass(frozen=True)
class Derivation:
    """A part with its parameters, and the parts attached to its ports."""

    label: str  # prefix of the part's names in the robot, such as `left_ee`; unique in the tree
    part: str
    parameters: tuple[tuple[str, float], ...] = ()
    """Every parameter of the part: (name, value in SI units)."""
    children: tuple[tuple[str, Derivation], ...] = ()  # (port, derivation attached to it)

    def __str__(self) -> str:
        values = ", ".join(f"{name}={format_number(value)}" for name, value in self.parameters)
        ports = ", ".join(f"{port}: {child}" for port, child in self.children)
        return (
            f"{self.label}={self.part}"
            + (f"({values})" if values else "")
            + (f"[{ports}]" if ports else "")
        )

    def walk(self) -> Iterator[Derivation]:
        """Yield the node and all below it, parents first."""
        yield self
        for _, child in self.children:
            yield from child.walk()

    @property
    def digest(self) -> str:
        """SHA-256 of the text, hexadecimal."""
        return hashlib.sha256(str(self).encode()).hexdigest()


def parse_derivation(text: str, origin: str = "derivation") -> Derivation:
    """Parse the text of a derivation."""
    what = f"{origin}: a derivation of {len(text):,} characters"
    require_at_most(len(text), MAX_DERIVATION_TEXT, what)
    try:
        derivation: Derivation = _DerivationBuilder(origin).transform(
            _derivation_parser().parse(text)
        )
    except UnexpectedInput as error:
        location = f"{origin}:{max(error.line, 1)}:{max(error.column, 1)}"
        raise GrammarError(
            f"{location}: invalid derivation; expected one such as "
            "base=fixed[top: arm=ur5[flange: ee=stick]]"
        ) from error
    except VisitError as error:
        raise error.orig_exc from error
    return derivation


@lru_cache(maxsize=1)
def _derivation_parser() -> Lark:
    return Lark(_DERIVATION_SYNTAX, parser="lalr", start="node", maybe_placeholders=False)  # linear


@v_args(inline=True)
class _DerivationBuilder(Transformer_NonRecursive[Token, Any]):
    """Converts Lark's tree of a derivation."""

    def __init__(self, origin: str) -> None:
        super().__init__()
        self._origin, self._parts = origin, 0

    def node(self, label: Token, part: Token, *rest: Any) -> Derivation:
        self._parts += 1
        what = f"{self._origin}: a derivation has more than {MAX_PARTS} parts"
        require_at_most(self._parts, MAX_PARTS, what)
        values = tuple(entry for entry in rest if isinstance(entry[1], float))
        children = tuple(entry for entry in rest if isinstance(entry[1], Derivation))
        return Derivation(str(label), str(part), values, children)

    def value(self, name: Token, text: Token) -> tuple[str, float]:
        return (str(name), float(text))

    def child(self, port: Token, node: Derivation) -> tuple[str, Derivation]:
        return (str(port), node)
