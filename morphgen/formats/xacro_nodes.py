"""Translate the allowed nodes of a parsed expression into Python functions."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from morphgen.formats.xacro_functions import (
    METHODS,
    OPERATORS,
    Function,
    RefusedError,
    Value,
    checked,
    size_of,
)

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
        """Subtract work from the remaining work.

        Raises:
            RefusedError: If none remains.
        """
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
        """Return the function that evaluates a node.

        Raises:
            RefusedError: If the node or one inside it is of a kind that is not allowed.
        """
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

        def operate(scope: Scope) -> object:
            return scope.result(apply(_data(left(scope)), _data(right(scope))))

        return operate

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
