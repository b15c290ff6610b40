"""Functions and bounded operators for the expressions of xacro files and manifests.

Values are bounded by ``MAX_SIZE`` and ``MAX_BITS``. An operation with a larger result is refused
before it is executed, so that no single operation takes long or needs much memory.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

MAX_BITS = 1024
"""Largest whole number of an expression [bits]: what a float can hold."""
MAX_SIZE = 200_000
"""Largest text, list or dictionary of an expression [characters and entries, nested ones too]."""
MAX_FACTORIAL = 170
"""Largest argument of ``factorial``; the factorial of 171 is beyond a float."""
MAX_CHOOSE = 1000
"""Largest argument of ``comb`` and ``perm``."""
MAX_DIGITS = 1000
"""Largest width, precision or rounding place [digits]."""

_CONVERSION = re.compile(r"%[-+ #0]*(\(|\*|\d*)(?:\.(\*|\d*))?")


Value: TypeAlias = Any
"""Value of an expression: a number, a text, a list, ..., or a symbol for one."""


class RefusedError(ValueError):
    """A document asks for something that is not allowed, or exceeds a bound."""


@dataclass(frozen=True)
class Function:
    """A function that expressions may call."""

    name: str
    call: Callable[..., object]
    applies: bool = False
    """Whether its first argument is a function, as of ``map``; ``call`` then takes, before it, a
    caller that calls that function within the limits."""

    def __str__(self) -> str:
        """Return its name, for messages."""
        return f"{self.name}()"


def size_of(value: object) -> int:
    """Count the characters and entries of a value, nested ones included.

    This is the work of copying or printing it.

    Raises:
        RefusedError: If there are more than ``MAX_SIZE``; a value that contains itself has.
    """
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
    """Return a value unchanged if it is small enough.

    Raises:
        RefusedError: If it is too large.
    """
    if isinstance(value, int):
        if value.bit_length() > MAX_BITS:
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


def _shift(left: Value, right: Value) -> object:
    _require(right, MAX_BITS, "a shift")
    return left << right


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


OPERATORS: Mapping[str, Callable[[Value, Value], object]] = {
    "Add": operator.add,
    "Sub": operator.sub,
    "Mult": _multiply,
    "Div": operator.truediv,
    "FloorDiv": operator.floordiv,
    "Mod": _modulo,
    "Pow": _power,
    "LShift": _shift,
    "RShift": operator.rshift,
    "BitAnd": operator.and_,
    "BitOr": operator.or_,
    "BitXor": operator.xor,
}
"""Binary operators by the name of their node."""


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


def _prod(numbers: Iterable[Value], *, start: Value = 1) -> object:
    product = start
    for number in numbers:
        product = checked(_multiply(product, number))
    return product


def _limited(function: Callable[..., int], limit: int) -> Function:
    """Return a function of ``math`` whose first argument is bounded."""

    def call(n: int, *rest: int) -> int:
        _require(n, limit, f"an argument of {function.__name__}()")
        return function(n, *rest)

    return Function(function.__name__, call)


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


def _map(caller: Callable[..., object], function: object, *items: Iterable[object]) -> list[object]:
    return [caller(function, *operands) for operands in zip(*items, strict=False)]


def _filter(
    caller: Callable[..., object], function: object, items: Iterable[object]
) -> list[object]:
    return [item for item in items if (item if function is None else caller(function, item))]


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
    "factorial": _limited(math.factorial, MAX_FACTORIAL),
    "comb": _limited(math.comb, MAX_CHOOSE),
    "perm": _limited(math.perm, MAX_CHOOSE),
    "prod": Function("prod", _prod),
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
    "max": lambda *items: max(*items),
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

BUILTINS: Mapping[str, Function] = {
    **{name: Function(name, call) for name, call in _CALLS.items()},
    "map": Function("map", _map, applies=True),
    "filter": Function("filter", _filter, applies=True),
}
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
