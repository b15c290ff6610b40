"""Derivations: the parts of a robot, their parameters, and the ports that they are attached to.

A derivation is written ``base=fixed(spread=0.6)[top: arm=ur5[flange: ee=stick]]``: a label, the
part, its parameters in SI units, and the derivations attached to its ports.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from lark import Lark, Token, UnexpectedInput, v_args
from lark.exceptions import VisitError
from lark.visitors import Transformer_NonRecursive

from morphgen.errors import GrammarError
from morphgen.formats.rounding import format_number
from morphgen.grammar.syntax import MAX_DERIVATION_TEXT, MAX_PARTS, require_at_most

_SYNTAX = r"""
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
        derivation: Derivation = _Builder(origin).transform(_parser().parse(text))
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
def _parser() -> Lark:
    return Lark(_SYNTAX, parser="lalr", start="node", maybe_placeholders=False)  # linear


@v_args(inline=True)
class _Builder(Transformer_NonRecursive[Token, Any]):
    """Converts Lark's tree without recursion, however deep; a method per rule of the syntax."""

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
