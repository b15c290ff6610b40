"""Evaluate the expressions of xacro files and manifests by an allow-list.

An expression is parsed with ``ast`` and translated, node by node, into the functions of
``xacro_nodes``. A node that is not listed there is refused; nothing is ever given to ``eval`` or
``exec``. Names stand for the document's own values and for the functions of ``xacro_functions``; a
dot reaches entries of dictionaries and xacro's namespaces, and a few methods of texts, lists and
dictionaries, but no attribute of a Python object.

The packages ``asteval`` and ``simpleeval`` do not fit: both let a dot read attributes of objects
unless their name is on a deny-list, which is the design that failed here, and neither bounds the
size of results in all the operations below.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping
from functools import lru_cache

from morphgen.formats.xacro_functions import Function, RefusedError
from morphgen.formats.xacro_nodes import Scope, Translation

MAX_LENGTH = 10_000
"""Longest expression [characters]."""

_ORIGIN = "<expression>"
# Python would print what it finds odd about an expression, such as ``2if x else 3``.
warnings.filterwarnings("ignore", category=SyntaxWarning, module=_ORIGIN)
warnings.filterwarnings("ignore", category=DeprecationWarning, module=_ORIGIN)


class Expression:
    """A translated expression, for any values of its names."""

    def __init__(self, text: str) -> None:
        """Translate.

        Raises:
            SyntaxError: If it is no expression.
            RefusedError: If it holds what is not allowed, or is too long.
        """
        if len(text) > MAX_LENGTH:
            raise RefusedError(f"an expression is longer than {MAX_LENGTH} characters")
        try:
            tree = ast.parse(text, _ORIGIN, "eval")
            self._node = Translation(text).of(tree.body)
        except (MemoryError, RecursionError) as error:
            raise RefusedError("an expression is nested too deeply") from error
        except ValueError as error:
            raise RefusedError(str(error)) from error

    def evaluate(
        self, names: Mapping[str, object], inner: Mapping[str, object] | None = None
    ) -> object:
        """The value.

        Args:
            names: Values and functions by name.
            inner: Further ones, which hide those.

        Raises:
            RefusedError: If it does too much, or its value is no data.
            NameError: If a name is unknown.
            Exception: What Python raises for the operation, such as ``ZeroDivisionError``.
        """
        value = self._node(Scope(names, dict(inner or {})))
        if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
            raise RefusedError("its value is a function or namespace, no data")
        return value


@lru_cache(maxsize=4096)
def expression(text: str) -> Expression:
    """A translated expression; memoised.

    Raises:
        SyntaxError: As ``Expression``.
        RefusedError: As ``Expression``.
    """
    return Expression(text)
