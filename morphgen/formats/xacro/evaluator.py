"""Evaluate the expressions of xacro files and part manifests by an allow-list.

They are Python's syntax, but Python never runs them: ``_Evaluation`` walks the nodes that
``Expression`` allows.
"""

from __future__ import annotations

import ast
import math
import operator
import re
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeAlias

from morphgen.errors import MALFORMED, FormatError, nearest, shortened

_MAX_REASON = 400  # longest reason in an error [characters]; expressions can be long
MAX_BITS = 1024  # largest whole number of an expression [bits]: what a float can hold
MAX_SIZE = 200_000
"""Largest text, list or dictionary of an expression [characters and entries, nested ones too]."""
MAX_DIGITS = 1000  # largest width, precision or rounding place [digits]

_CONVERSION = re.compile(r"%[-+ #0]*(\(|\*|\d*)(?:\.(\*|\d*))?")


Value: TypeAlias = Any  # value of an expression: a number, a text, a list, ..., or a symbol for one


class RefusedError(ValueError):
    """A document asks for something that is not allowed, or exceeds a bound."""


@dataclass(frozen=True)
class Function:
    """A function that expressions may call."""

    name: str
    call: Callable[..., object]

    def __str__(self) -> str:
        """Return its name, for messages."""
        return f"{self.name}()"


def size_of(value: object) -> int:
    """Count the characters and entries of a value, the work of copying or printing it."""
    size = 0
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, str):
            size += len(item)
        elif isinstance(item, list | tuple):
            pending.extend(item)
        elif isinstance(item, dict):
            pending.extend(item)
            pending.extend(item.values())
        size += 1
        if size + len(pending) > MAX_SIZE:
            raise RefusedError(f"a value has more than {MAX_SIZE} characters and entries")
    return size


def checked(value: object) -> object:
    """Return a value unchanged if it is small enough."""
    if isinstance(value, int):
        if value.bit_length() > MAX_BITS:  # not of its text, whose conversion takes quadratic time
            raise RefusedError(f"a whole number has more than {MAX_BITS} bits")
    elif isinstance(value, str | list | tuple | dict):
        size_of(value)
    return value


def _require(size: float, limit: int, what: str) -> None:
    """Require that a size is within a limit; ``what`` names it in the error."""
    if size > limit:
        raise RefusedError(f"{what} is beyond {limit}")


def _multiply(left: Value, right: Value) -> object:
    for value, times in ((left, right), (right, left)):
        if isinstance(value, str | list | tuple) and isinstance(times, int):
            _require(size_of(value) * times, MAX_SIZE, "the length of a repetition")
    return left * right


def _power(left: Value, right: Value) -> object:
    if isinstance(left, int) and isinstance(right, int):
        _require(left.bit_length() * right, 2 * MAX_BITS, "the bits of a power")
    result = left**right
    if isinstance(result, complex):
        raise RefusedError(f"{left} ** {right} is not a real number")
    return result


def _modulo(left: Value, right: Value) -> object:
    if not isinstance(left, str):
        return left % right
    conversions = 0
    for width, precision in _CONVERSION.findall(left):
        conversions += 1
        for digits in (width, precision):
            if digits in ("*", "(") or len(digits) > 4 or int(digits or 0) > MAX_DIGITS:
                raise RefusedError(
                    f"the format {left[:40]!r} is not allowed: no keys, no *, at most "
                    f"{MAX_DIGITS} digits"
                )
    max_length = conversions * (MAX_DIGITS + size_of(right))
    _require(max_length, 10 * MAX_SIZE, "the length of a formatted text")
    return left % right


OPERATORS: Mapping[type, Callable[[Value, Value], object]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: _multiply,
    ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv,
    ast.Mod: _modulo,
    ast.Pow: _power,
}
"""Binary operators by the type of their node."""


def _range(*bounds: int) -> list[int]:
    numbers = range(*bounds)
    _require(len(numbers), MAX_SIZE, "the length of a range")
    return list(numbers)


def _round(number: Value, ndigits: int | None = None) -> object:
    if ndigits is not None:
        _require(abs(ndigits), MAX_DIGITS, "a place to round to")
    return round(number, ndigits)


def _sum(numbers: Iterable[Value], start: Value = 0) -> object:
    total = start
    for number in numbers:
        if isinstance(number, str | list | tuple | dict):
            raise TypeError("sum() adds numbers only")
        total = checked(total + number)
    return total


def _replace(text: str, old: str, new: str, count: int = -1) -> str:
    occurrences = text.count(old)
    times = occurrences if count < 0 else min(count, occurrences)
    _require(len(text) + times * len(new), MAX_SIZE, "the length of a replacement")
    return text.replace(old, new, count)


def _join(separator: str, items: Iterable[str]) -> str:
    texts = list(items)
    length = len(separator) * len(texts) + sum(map(len, texts))
    _require(length, MAX_SIZE, "the length of a joined text")
    return separator.join(texts)


def _zfill(text: str, width: int) -> str:
    _require(width, MAX_DIGITS, "a width")
    return text.zfill(width)


def _as_list(call: Callable[..., Iterable[object]]) -> Callable[..., list[object]]:
    """Wrap a function to return a list instead of an iterator."""
    return lambda *operands, **named: list(call(*operands, **named))


_REAL = (  # noqa: SIM905
    "acos acosh asin asinh atan atan2 atanh cbrt ceil copysign cos cosh degrees dist erf erfc exp "
    "exp2 expm1 fabs floor fmod frexp fsum gamma gcd hypot isclose isfinite isinf isnan isqrt lcm "
    "ldexp lgamma log log10 log1p log2 modf nextafter pow radians remainder sin sinh sqrt tan tanh "
    "trunc ulp"
).split()

MATH: Mapping[str, object] = {
    "pi": math.pi,
    "e": math.e,
    "tau": math.tau,
    "inf": math.inf,
    "nan": math.nan,
    **{name: Function(name, getattr(math, name)) for name in _REAL if hasattr(math, name)},
}
"""Names of ``math`` that expressions may use."""

_CALLS: Mapping[str, Callable[..., object]] = {
    "abs": abs,
    "all": all,
    "any": any,
    "bool": bool,
    "dict": dict,
    "divmod": divmod,
    "enumerate": _as_list(enumerate),
    "float": float,
    "int": int,
    "len": len,
    "list": list,
    "max": lambda *items: max(*items),  # without key=, which would call a function uncounted
    "min": lambda *items: min(*items),
    "range": _range,
    "reversed": _as_list(reversed),
    "round": _round,
    "sorted": lambda items, *, reverse=False: sorted(items, reverse=reverse),
    "str": lambda value="": str(value),
    "sum": _sum,
    "tuple": tuple,
    "zip": _as_list(zip),
}

BUILTINS: Mapping[str, Function] = {name: Function(name, call) for name, call in _CALLS.items()}
"""Python's own functions that expressions may call."""

METHODS: Mapping[type, Mapping[str, Callable[..., object]]] = {
    str: {
        **{
            name: getattr(str, name)
            for name in (  # noqa: SIM905
                "capitalize count endswith find index isalnum isalpha isdecimal isdigit islower "
                "isnumeric isspace isupper lower lstrip removeprefix removesuffix rfind rindex "
                "rsplit rstrip split splitlines startswith strip swapcase title upper"
            ).split()
        },
        "join": _join,
        "replace": _replace,
        "zfill": _zfill,
    },
    list: {"count": list.count, "index": list.index},
    tuple: {"count": tuple.count, "index": tuple.index},
    dict: {
        "get": dict.get,
        "items": _as_list(dict.items),
        "keys": _as_list(dict.keys),
        "values": _as_list(dict.values),
    },
}
"""Methods that expressions may call, by the exact type of the value."""


MAX_WORK = 1_000_000
"""Largest work of one evaluation [characters, entries and rounds of comprehensions]."""

_SCALARS = frozenset({int, float, bool, str, type(None)})
_NUMBERS = frozenset({int, float, bool})
_COMPARISONS: Mapping[type, Callable[[Value, Value], Value]] = {
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Is: operator.is_,
    ast.IsNot: operator.is_not,
    ast.In: lambda item, container: item in container,
    ast.NotIn: lambda item, container: item not in container,
}
_SIGNS: Mapping[type, Callable[[Value], Value]] = {
    ast.Not: operator.not_,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}
_ALLOWED = (
    *(ast.Constant, ast.Name, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.IfExp, ast.Compare, ast.Call),
    *(ast.Subscript, ast.Slice, ast.Attribute, ast.keyword, ast.List, ast.Tuple),
    *(ast.Dict, ast.ListComp, ast.GeneratorExp, ast.comprehension, ast.expr_context, ast.boolop),
    *(*OPERATORS, *_COMPARISONS, *_SIGNS),
)
"""Kinds of nodes that an expression may have."""


class Namespace(dict[str, object]):
    """Names that expressions write after a dot; unlike a dictionary it is no data."""


NAMES: Mapping[str, object] = {
    **MATH,
    **BUILTINS,
    "math": Namespace(MATH),
    "python": Namespace(BUILTINS),
}
"""Names that every expression may use."""


class _Evaluation:
    """One evaluation of an expression."""

    def __init__(
        self, text: str, names: Mapping[str, object], inner: Mapping[str, object] | None
    ) -> None:
        self._text, self._names, self._work = text, names, MAX_WORK
        self._inner = dict(inner or {})
        """Arguments and variables of comprehensions; they hide ``names``."""

    def value(self, node: ast.AST) -> Value:
        """Return the value of a node."""
        match node:
            case ast.Constant(value):
                return value
            case ast.Name(name):
                if name in self._inner:
                    return self._inner[name]
                return _entry(self._names, name)
            case ast.BinOp(left, sign, right):
                operands = _data(self.value(left)), _data(self.value(right))
                return self._result(OPERATORS[type(sign)](*operands))
            case ast.UnaryOp(sign, operand):
                return _SIGNS[type(sign)](_data(self.value(operand)))
            case ast.Call():
                return self._call(node)
            case ast.Attribute(owner, _):
                return self._attribute(node, self.value(owner))
            case ast.Subscript(container, index):
                chosen = self.value(index)
                value = self.value(container)[chosen]
                return self._result(value) if isinstance(chosen, slice) else value
        return self._composite(node)

    def _composite(self, node: ast.AST) -> Value:
        match node:
            case ast.IfExp(test, then, other):
                return self.value(then if self.value(test) else other)
            case ast.BoolOp():
                return self._decide(node)
            case ast.Compare():
                return self._compare(node)
            case ast.Slice(low, high, step):
                return slice(*(end and self.value(end) for end in (low, high, step)))
            case ast.List(items):
                return self._result([_data(self.value(item)) for item in items])
            case ast.Tuple(items):
                return self._result(tuple(_data(self.value(item)) for item in items))
            case ast.Dict(keys, values):
                pairs = zip(keys, values, strict=True)
                return self._result(
                    {self.value(key): _data(self.value(v)) for key, v in pairs if key}
                )
            case ast.ListComp() | ast.GeneratorExp():
                return self._comprehension(node)
        raise _refused(node, self._text)

    def _spend(self, work: int) -> None:
        self._work -= work
        if self._work < 0:
            raise RefusedError(f"it takes more than {MAX_WORK} steps")

    def _result(self, value: object) -> object:
        """Return a new value after checking its size and counting it as work."""
        if type(value) is float:
            return value
        if type(value) in _NUMBERS:
            return checked(value)
        self._spend(size_of(value))
        return value

    def _charged(self, value: Value) -> Value:
        """Return a value unchanged if it is data; reading all of it counts as work."""
        if type(value) not in _NUMBERS:
            self._spend(size_of(_data(value)))
        return value

    def _decide(self, node: ast.BoolOp) -> object:
        value: object = None
        for operand in node.values:
            value = self.value(operand)
            if bool(value) is isinstance(node.op, ast.Or):
                break
        return value

    def _compare(self, node: ast.Compare) -> object:
        left, value = self._charged(self.value(node.left)), True
        for sign, operand in zip(node.ops, node.comparators, strict=True):
            right = self._charged(self.value(operand))
            value = _COMPARISONS[type(sign)](left, right)
            if not value:
                break
            left = right
        return value

    def _attribute(self, node: ast.Attribute, owner: Value) -> object:
        """Return the entry after the dot of a dictionary or namespace."""
        if not isinstance(owner, dict):
            raise _refused(node, self._text)
        return _entry(owner, node.attr)

    def _call(self, node: ast.Call) -> object:
        operands: list[Value] = []
        function: object
        if isinstance(node.func, ast.Attribute):
            owner, name = self.value(node.func.value), node.func.attr
            if method := METHODS.get(type(owner), {}).get(name):
                function, operands = Function(name, method), [owner]
            else:
                function = self._attribute(node.func, owner)
        else:
            function = self.value(node.func)
        if not isinstance(function, Function):
            raise _refused(node, self._text)
        operands += map(self.value, node.args)
        named = {str(keyword.arg): self.value(keyword.value) for keyword in node.keywords}
        self._spend(1)
        for operand in (*operands, *named.values()):
            self._charged(operand)
        return self._result(function.call(*operands, **named))

    def _comprehension(self, node: ast.ListComp | ast.GeneratorExp) -> object:
        outer, self._inner = self._inner, dict(self._inner)
        try:
            return self._result(list(self._rounds(node, 0)))
        finally:
            self._inner = outer

    def _rounds(self, node: ast.ListComp | ast.GeneratorExp, depth: int) -> Iterator[object]:
        if depth == len(node.generators):
            yield _data(self.value(node.elt))
            return
        generator = node.generators[depth]
        for item in self._charged(self.value(generator.iter)):
            self._spend(1)
            self._inner.update(_variables(generator.target, item))
            if all(self.value(test) for test in generator.ifs):
                yield from self._rounds(node, depth + 1)


def _entry(names: Mapping[str, object], name: str) -> object:
    try:
        return names[name]
    except KeyError:
        raise NameError(f"name {name!r} is not defined", name=name) from None


def _variables(target: ast.expr, item: Value) -> dict[str, object]:
    if isinstance(target, ast.Name):
        return {target.id: item}
    names = [name.id for name in _targets(target) if isinstance(name, ast.Name)]
    values = tuple(item)
    if len(values) != len(names):
        raise ValueError(f"{len(names)} names for {len(values)} values")
    return dict(zip(names, values, strict=True))


def _targets(target: ast.expr) -> list[ast.expr]:
    return target.elts if isinstance(target, ast.Tuple) else [target]


def _data(value: Value) -> Value:
    """Return a value unchanged if it is neither a function nor a namespace."""
    if type(value) in _NUMBERS:
        return value
    if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
        raise TypeError(f"{value if isinstance(value, Function) else 'a namespace'} is not data")
    return value


MAX_LENGTH = 10_000  # longest expression [characters]
MAX_DEPTH = 200  # deepest nesting of an expression; a sum of 200 terms has it

_ORIGIN = "<expression>"
_PARSING = threading.Lock()  # held while Python's warnings are off: they are those of all threads


class Expression:
    """A parsed expression; it can be evaluated for any values of its names."""

    def __init__(self, text: str) -> None:
        """Parse, and require that every node is allowed."""
        if len(text) > MAX_LENGTH:
            raise RefusedError(f"an expression is longer than {MAX_LENGTH} characters")
        try:
            with _PARSING, warnings.catch_warnings():  # of texts such as ``2if x else 3``
                warnings.simplefilter("ignore")
                self._tree = ast.parse(text, _ORIGIN, "eval").body
        except (MemoryError, RecursionError) as error:
            raise RefusedError("an expression is nested too deeply") from error
        except ValueError as error:
            raise RefusedError(str(error)) from error
        self._text = text
        level: list[ast.AST] = [self._tree]
        for _ in range(MAX_DEPTH):
            for node in level:
                _require_allowed(node, text)
            level = [child for node in level for child in ast.iter_child_nodes(node)]
        if level:
            raise RefusedError("an expression is nested too deeply")

    def evaluate(
        self, names: Mapping[str, object], inner: Mapping[str, object] | None = None
    ) -> object:
        """Return the value of the expression."""
        value = _Evaluation(self._text, names, inner).value(self._tree)
        if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
            raise RefusedError("its value is a function or namespace, not data")
        return value


def _require_allowed(node: ast.AST, text: str) -> None:
    is_allowed = isinstance(node, _ALLOWED)
    if isinstance(node, ast.Constant):
        checked(node.value)
        is_allowed = type(node.value) in _SCALARS
    elif isinstance(node, ast.Attribute):
        is_allowed = not node.attr.startswith("__")
    elif isinstance(node, ast.keyword):
        is_allowed = node.arg is not None
    elif isinstance(node, ast.Dict):
        is_allowed = None not in node.keys
    elif isinstance(node, ast.comprehension):
        are_names = all(isinstance(name, ast.Name) for name in _targets(node.target))
        is_allowed = are_names and not node.is_async
        node = node.target
    if not is_allowed:
        raise _refused(node, text)


def _refused(node: ast.AST, text: str) -> RefusedError:
    source = ast.get_source_segment(text, node) or text
    return RefusedError(f"{type(node).__name__} {source[:80]!r} is not allowed")


@lru_cache(maxsize=4096)
def expression(text: str) -> Expression:
    """Return a parsed expression; memoised."""
    return Expression(text)


def evaluate_number(text: str, values: Mapping[str, float]) -> float:
    """Return the number that an expression with xacro's functions is, such as ``length / 2``."""
    try:
        result = expression(text.strip()).evaluate(NAMES, values)
        number = math.nan
        if isinstance(result, int | float) and not isinstance(result, bool):
            number = float(result)
    except MALFORMED as error:
        hint = nearest(error.name, values) if isinstance(error, NameError) and error.name else ""
        raise FormatError(f"{text!r}: {reason_of(error)}{hint}") from error
    if not math.isfinite(number):
        raise FormatError(f"{text!r} is {result!r}, not a finite number")
    return number


def reason_of(error: BaseException, suffix: str = "") -> str:
    """Return the message of an error in one line, or the name of its type if it has none."""
    return shortened(
        " ".join(f"{str(error) or type(error).__name__} {suffix}".split()), _MAX_REASON
    )
