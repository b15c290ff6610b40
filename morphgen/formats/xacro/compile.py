"""Expand a xacro once for all values of its parameters.

Expanding a xacro is the slowest step of composing a robot. If parameters only enter the document's
numbers by arithmetic, one expansion with symbols instead of values gives a text with expressions.
Evaluating these for new values gives the same bytes as another expansion.

The expressions are evaluated by the same allow-list as those of a xacro. A document that is not
installed with morphgen is traced in the child process with limits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

from morphgen.errors import FormatError
from morphgen.formats.data_files import kept_reading
from morphgen.formats.resolve import PackageFinder, finds_installed_only, is_installed
from morphgen.formats.xacro.evaluator import Expression, Function, RefusedError

_OPEN, _CLOSE = "\ue000", "\ue001"  # private-use characters: documents hardly have them
_MARK = re.compile(f"{_OPEN}(.*?){_CLOSE}", re.DOTALL)
_FUNCTIONS: Mapping[str, Callable[..., object]] = {
    name: getattr(math, name)
    for name in ("sqrt", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "fabs", "pow")
} | {"radians": math.radians, "degrees": math.degrees, "min": min, "max": max, "abs": abs}
_NAMES = {name: Function(name, call) for name, call in _FUNCTIONS.items()}


class UntraceableError(Exception):
    """A template does more with a parameter than arithmetic."""


_UNTRACEABLE = (
    UntraceableError,
    FormatError,
    RefusedError,
    SyntaxError,
    NameError,
    TypeError,
    LookupError,
)
"""Exceptions that tracing an untraceable template can raise."""


def _recorded(form: str) -> Callable[[Traced, object], Traced]:
    """Return a method that records an operation, such as ``{other} - {symbol}``."""
    return lambda symbol, other: Traced(f"({form.format(symbol=symbol.code, other=_code(other))})")


class Traced:
    """A symbol in place of a number; it records the arithmetic done with it as an expression."""

    def __init__(self, code: str) -> None:
        self.code = code

    def __str__(self) -> str:
        return f"{_OPEN}{self.code}{_CLOSE}"

    __add__, __radd__ = _recorded("{symbol} + {other}"), _recorded("{other} + {symbol}")
    __sub__, __rsub__ = _recorded("{symbol} - {other}"), _recorded("{other} - {symbol}")
    __mul__, __rmul__ = _recorded("{symbol} * {other}"), _recorded("{other} * {symbol}")
    __truediv__, __rtruediv__ = _recorded("{symbol} / {other}"), _recorded("{other} / {symbol}")
    __pow__ = _recorded("{symbol} ** {other}")

    def __neg__(self) -> Traced:
        return Traced(f"(-{self.code})")

    def __pos__(self) -> Traced:
        return self

    def _refuse(self, *_: object) -> bool:
        raise UntraceableError(f"a decision depends on {self.code}")

    __bool__ = __lt__ = __le__ = __gt__ = __ge__ = __eq__ = __ne__ = _refuse
    __float__ = __int__ = __index__ = __hash__ = _refuse


@dataclass(frozen=True, eq=False)
class CompiledXacro:
    """A document with expressions over parameters."""

    texts: tuple[str, ...]  # texts before, between and after the expressions
    expressions: tuple[Expression, ...]
    """Distinct expressions; most documents use one several times."""
    order: tuple[int, ...]  # index of the expression after each text except the last

    def fill(self, values: Mapping[str, str]) -> bytes:
        """Return the document for values of the parameters, given as xacro arguments."""
        names = dict(_NAMES) | {_symbol(name): _literal(text) for name, text in values.items()}
        try:
            numbers = [str(expression.evaluate(names)) for expression in self.expressions]
        except (ArithmeticError, ValueError) as error:
            raise FormatError(
                f"a template's expression fails for {dict(values)}: {error}"
            ) from error
        pieces = [self.texts[0]]
        for k, text in zip(self.order, self.texts[1:], strict=True):
            pieces += (numbers[k], text)
        return "".join(pieces).encode()


def compile_xacro(
    path: Path, constants: Mapping[str, str], numbers: Mapping[str, str], finder: PackageFinder
) -> CompiledXacro | None:
    """Expand a xacro file for all values of some of its arguments; memoised.

    None if the file uses a number other than by arithmetic, or cannot be expanded for these values.
    Then call ``expand``, which raises the error, if any.
    """
    stamp = path.stat().st_mtime_ns if path.is_file() else 0
    return _compiled(path, stamp, tuple(constants.items()), _Example(numbers), finder)


class _Example(dict[str, str]):
    """Values of numbers; as a key of the cache, examples with the same names are equal."""

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Example) and tuple(self) == tuple(other)


@lru_cache(maxsize=256)
def _compiled(
    path: Path,
    stamp: int,
    constants: tuple[tuple[str, str], ...],
    example: _Example,
    finder: PackageFinder,
) -> CompiledXacro | None:
    """Compile a file; ``stamp`` makes the cache read it again after a change."""
    del stamp
    path = path.absolute()
    given = dict(constants)

    read = partial(trace, path, finder, given, example, installed_only=True)
    try:
        if not is_installed(path):
            from morphgen.formats.xacro.expand import run_in_child

            traced = run_in_child(trace, path, finder, constants=given, numbers=example)
        elif finds_installed_only(finder):
            traced = kept_reading("template", (path, constants, tuple(example)), read)
        else:
            traced = read()
        return None if traced is None else _translated(*traced)
    except _UNTRACEABLE:
        return None


def trace(
    path: Path,
    finder: PackageFinder,
    constants: Mapping[str, str],
    numbers: Mapping[str, str],
    *,
    installed_only: bool = False,
) -> tuple[list[str], list[str]] | None:
    """Expand a file with symbols for numbers; return the parts of a ``CompiledXacro``, or None."""
    from morphgen.formats.xacro.expand import Expansion  # loads xacro and minidom

    objects = {name: Traced(_symbol(name)) for name in numbers}
    functions = {name: Function(name, _lifted(name, call)) for name, call in _FUNCTIONS.items()}
    expansion = Expansion(
        constants, path, finder, objects, functions, installed_only=installed_only
    )
    try:
        pieces = _MARK.split(expansion.run_file().decode())
        filled = _translated(pieces[::2], pieces[1::2]).fill(numbers)
        if filled != Expansion({**constants, **numbers}, path, finder).run_file():
            return None
    except _UNTRACEABLE:
        return None
    return pieces[::2], pieces[1::2]


def _translated(texts: Sequence[str], expressions: Sequence[str]) -> CompiledXacro:
    distinct = list(dict.fromkeys(expressions))
    order = tuple(map(distinct.index, expressions))
    return CompiledXacro(tuple(texts), tuple(map(Expression, distinct)), order)


def _lifted(name: str, function: Callable[..., object]) -> Callable[..., object]:
    """Return a function that records its call if an argument is a symbol."""

    def call(*operands: object) -> object:
        if any(isinstance(operand, Traced) for operand in operands):
            return Traced(f"{name}({', '.join(map(_code, operands))})")
        return function(*operands)

    return call


def _code(operand: object) -> str:
    if isinstance(operand, Traced):
        return operand.code
    if isinstance(operand, bool) or not isinstance(operand, int | float):
        raise UntraceableError(f"{operand!r} is not a number")
    return f"({operand!r})"


def _symbol(name: str) -> str:
    """Return the name of a parameter in the expressions of a compiled document."""
    return f"p_{name}"


def _literal(text: str) -> int | float:
    """Convert a xacro argument as xacro does: whole numbers become int."""
    try:
        return int(text)
    except ValueError:
        return float(text)
