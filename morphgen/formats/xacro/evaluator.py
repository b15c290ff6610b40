"""Evaluate the expressions of xacro files by an allow-list."""

from __future__ import annotations

import ast
import math
import operator
import re
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, TypeAlias

MAX_BITS = 1024  # largest whole number of an expression [bits]: what a float can hold
MAX_SIZE = 200_000
"""Largest text, list or dictionary of an expression [characters and entries, nested ones too]."""
MAX_FACTORIAL = 170  # largest argument of factorial; the factorial of 171 is beyond a float
MAX_CHOOSE = 1000  # largest argument of comb and perm
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
    applies: bool = False
    """Whether its first argument is a function, as of ``map``; ``call`` then takes, before it, a
    caller that calls that function within the limits."""

    def __str__(self) -> str:
        """Return its name, for messages."""
        return f"{self.name}()"


def size_of(value: object) -> int:
    """Count the characters and entries of a value, nested ones included.

    This is the work of copying or printing it.
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
    ast.Invert: operator.invert,
}


@dataclass
class Scope:
    """Names and remaining work of one evaluation."""

    names: Mapping[str, object]
    inner: dict[str, object] = field(default_factory=dict)
    """Arguments and variables of comprehensions; they hide ``names``."""
    work: int = MAX_WORK

    def spend(self, work: int) -> None:
        """Subtract work from the remaining work."""
        self.work -= work
        if self.work < 0:
            raise RefusedError(f"it takes more than {MAX_WORK} steps")

    def result(self, value: object) -> object:
        """Return a new value after checking its size and counting it as work."""
        if type(value) is float:
            return value
        if type(value) in _NUMBERS:
            return checked(value)
        self.spend(size_of(value))
        return value


Node: TypeAlias = Callable[[Scope], Value]


class Translation:
    """Translates the nodes of one expression, with one method for each allowed kind of node."""

    def __init__(self, text: str) -> None:
        self.text = text

    def of(self, node: ast.AST) -> Node:
        """Return the function that evaluates a node."""
        translate = getattr(self, f"_{type(node).__name__.lower()}", None)
        if translate is None:
            raise self.refused(node)
        function: Node = translate(node)
        return function

    def refused(self, node: ast.AST) -> RefusedError:
        """Return the error for a construct that is not allowed."""
        source = ast.get_source_segment(self.text, node) or self.text
        return RefusedError(f"{type(node).__name__} {source[:80]!r} is not allowed")

    def _constant(self, node: ast.Constant) -> Node:
        value = node.value
        if type(value) not in _SCALARS:
            raise self.refused(node)
        checked(value)
        return lambda scope: value

    def _name(self, node: ast.Name) -> Node:
        name = node.id

        def look_up(scope: Scope) -> object:
            if name in scope.inner:
                return scope.inner[name]
            try:
                return scope.names[name]
            except KeyError:
                raise NameError(f"name {name!r} is not defined", name=name) from None

        return look_up

    def _binop(self, node: ast.BinOp) -> Node:
        left, right = self.of(node.left), self.of(node.right)
        apply = OPERATORS.get(type(node.op).__name__)
        if apply is None:
            raise self.refused(node)
        return lambda scope: scope.result(apply(_data(left(scope)), _data(right(scope))))

    def _unaryop(self, node: ast.UnaryOp) -> Node:
        operand, apply = self.of(node.operand), _SIGNS[type(node.op)]
        return lambda scope: apply(_data(operand(scope)))

    def _boolop(self, node: ast.BoolOp) -> Node:
        operands = [self.of(value) for value in node.values]
        stops_at = isinstance(node.op, ast.Or)

        def decide(scope: Scope) -> object:
            value: object = None
            for operand in operands:
                value = operand(scope)
                if bool(value) is stops_at:
                    break
            return value

        return decide

    def _ifexp(self, node: ast.IfExp) -> Node:
        test, then, other = self.of(node.test), self.of(node.body), self.of(node.orelse)
        return lambda scope: then(scope) if test(scope) else other(scope)

    def _compare(self, node: ast.Compare) -> Node:
        first = self.of(node.left)
        rest = [
            (_COMPARISONS[type(op)], self.of(operand))
            for op, operand in zip(node.ops, node.comparators, strict=True)
        ]

        def compare(scope: Scope) -> object:
            left = _charged(first(scope), scope)
            value: object = True
            for apply, operand in rest:
                right = _charged(operand(scope), scope)
                value = apply(left, right)
                if not value:
                    break
                left = right
            return value

        return compare

    def _subscript(self, node: ast.Subscript) -> Node:
        container, index = self.of(node.value), self.of(node.slice)

        def pick(scope: Scope) -> object:
            chosen = index(scope)
            value = container(scope)[chosen]
            return scope.result(value) if isinstance(chosen, slice) else value

        return pick

    def _slice(self, node: ast.Slice) -> Node:
        ends = [
            None if end is None else self.of(end) for end in (node.lower, node.upper, node.step)
        ]
        return lambda scope: slice(*(None if end is None else end(scope) for end in ends))

    def _attribute(self, node: ast.Attribute) -> Node:
        owner, entry = self.of(node.value), self._entry(node)
        return lambda scope: entry(owner(scope))

    def _entry(self, node: ast.Attribute) -> Callable[[Value], Value]:
        """Return a function for the entry after the dot of a dictionary or namespace."""
        name = node.attr
        if name.startswith("__"):
            raise self.refused(node)

        def entry(owner: Value) -> object:
            if not isinstance(owner, dict):
                raise self.refused(node)
            try:
                return owner[name]
            except KeyError:
                raise NameError(f"name {name!r} is not defined", name=name) from None

        return entry

    def _call(self, node: ast.Call) -> Node:
        arguments = self._items(node.args)
        keywords = [(keyword.arg, self.of(keyword.value)) for keyword in node.keywords]
        find = self._callee(node.func)

        def call(scope: Scope) -> object:
            function, owners = find(scope)
            if not isinstance(function, Function):
                raise self.refused(node)
            return _call_function(
                scope, function, [*owners, *arguments(scope)], _keywords(keywords, scope)
            )

        return call

    def _callee(self, node: ast.expr) -> Callable[[Scope], tuple[object, tuple[object, ...]]]:
        """Return a function for the callee of a call, and for the owner if it is a method."""
        if not isinstance(node, ast.Attribute):
            function = self.of(node)
            return lambda scope: (function(scope), ())
        name, owner, entry = node.attr, self.of(node.value), self._entry(node)

        def find(scope: Scope) -> tuple[object, tuple[object, ...]]:
            target = owner(scope)
            method = METHODS.get(type(target), {}).get(name)
            return (entry(target), ()) if method is None else (Function(name, method), (target,))

        return find

    def _list(self, node: ast.List) -> Node:
        items = self._items(node.elts)
        return lambda scope: scope.result([_data(item) for item in items(scope)])

    def _tuple(self, node: ast.Tuple) -> Node:
        items = self._items(node.elts)
        return lambda scope: scope.result(tuple(map(_data, items(scope))))

    def _dict(self, node: ast.Dict) -> Node:
        entries = [
            (None if key is None else self.of(key), self.of(value))
            for key, value in zip(node.keys, node.values, strict=True)
        ]

        def build(scope: Scope) -> object:
            result: dict[object, object] = {}
            for key, value in entries:
                if key is None:
                    result.update(_charged(value(scope), scope))
                else:
                    result[key(scope)] = _data(value(scope))
            return scope.result(result)

        return build

    def _listcomp(self, node: ast.ListComp | ast.GeneratorExp) -> Node:
        element = self.of(node.elt)
        rounds = [self._round(generator) for generator in node.generators]

        def walk(scope: Scope, depth: int) -> Iterator[object]:
            if depth == len(rounds):
                yield _data(element(scope))
                return
            names, items, tests = rounds[depth]
            for item in _charged(items(scope), scope):
                scope.spend(1)
                scope.inner.update(names(item))
                if all(test(scope) for test in tests):
                    yield from walk(scope, depth + 1)

        def build(scope: Scope) -> object:
            outer = scope.inner
            scope.inner = dict(outer)
            try:
                return scope.result(list(walk(scope, 0)))
            finally:
                scope.inner = outer

        return build

    _generatorexp = _listcomp

    def _round(
        self, generator: ast.comprehension
    ) -> tuple[Callable[[Value], dict[str, object]], Node, list[Node]]:
        """Translate ``for ... in ... if ...``: variables of an item, the items, the conditions."""
        target = generator.target
        targets = target.elts if isinstance(target, ast.Tuple) else [target]
        names = [name.id for name in targets if isinstance(name, ast.Name)]
        if len(names) != len(targets) or generator.is_async:
            raise self.refused(target)

        def named(item: Value) -> dict[str, object]:
            values = (item,) if isinstance(target, ast.Name) else tuple(item)
            if len(values) != len(names):
                raise ValueError(f"{len(names)} names for {len(values)} values")
            return dict(zip(names, values, strict=True))

        return named, self.of(generator.iter), [self.of(test) for test in generator.ifs]

    def _items(self, nodes: list[ast.expr]) -> Callable[[Scope], Iterator[Value]]:
        """Translate elements or arguments, some of them starred."""
        items = [
            (self.of(node.value), True) if isinstance(node, ast.Starred) else (self.of(node), False)
            for node in nodes
        ]

        def values(scope: Scope) -> Iterator[Value]:
            for item, starred in items:
                if starred:
                    yield from _charged(item(scope), scope)
                else:
                    yield item(scope)

        return values


def _keywords(keywords: list[tuple[str | None, Node]], scope: Scope) -> dict[str, object]:
    named: dict[str, object] = {}
    for name, value in keywords:
        named.update(_charged(value(scope), scope) if name is None else {name: value(scope)})
    return named


def _call_function(
    scope: Scope, function: Function, operands: list[Value], named: dict[str, Value]
) -> object:
    """Call a function; its operands and its result count as work."""
    scope.spend(1)
    for operand in (*operands, *named.values()):
        if not (function.applies and isinstance(operand, Function)):
            _charged(operand, scope)
    if not function.applies:
        return scope.result(function.call(*operands, **named))

    def apply(inner: object, *items: object) -> object:
        if not isinstance(inner, Function) or inner.applies:
            raise TypeError(f"{function} applies one of the listed functions")
        return _call_function(scope, inner, list(items), {})

    return scope.result(function.call(apply, *operands, **named))


def _data(value: Value) -> Value:
    """Return a value unchanged if it is neither a function nor a namespace."""
    if type(value) in _NUMBERS:
        return value
    if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
        raise TypeError(f"{value if isinstance(value, Function) else 'a namespace'} is not data")
    return value


def _charged(value: Value, scope: Scope) -> Value:
    """Return a value unchanged if it is data; reading all of it counts as work."""
    if type(value) not in _NUMBERS:
        scope.spend(size_of(_data(value)))
    return value


MAX_LENGTH = 10_000  # longest expression [characters]

_ORIGIN = "<expression>"
_PARSING = threading.Lock()  # held while Python's warnings are off: they are those of all threads


class Expression:
    """A translated expression; it can be evaluated for any values of its names."""

    def __init__(self, text: str) -> None:
        """Translate."""
        if len(text) > MAX_LENGTH:
            raise RefusedError(f"an expression is longer than {MAX_LENGTH} characters")
        try:
            with _PARSING, warnings.catch_warnings():  # of texts such as ``2if x else 3``
                warnings.simplefilter("ignore")
                tree = ast.parse(text, _ORIGIN, "eval")
            self._node = Translation(text).of(tree.body)
        except (MemoryError, RecursionError) as error:
            raise RefusedError("an expression is nested too deeply") from error
        except ValueError as error:
            raise RefusedError(str(error)) from error

    def evaluate(
        self, names: Mapping[str, object], inner: Mapping[str, object] | None = None
    ) -> object:
        """Return the value of the expression."""
        value = self._node(Scope(names, dict(inner or {})))
        if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
            raise RefusedError("its value is a function or namespace, not data")
        return value


@lru_cache(maxsize=4096)
def expression(text: str) -> Expression:
    """Return a translated expression; memoised."""
    return Expression(text)
