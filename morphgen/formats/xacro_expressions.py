"""Evaluate the expressions of xacro files and manifests by an allow-list.

An expression is parsed with ``ast`` and translated, node by node, into the functions of
``xacro_nodes``. Other nodes are refused, and nothing is passed to ``eval`` or ``exec``. Names refer
to values of the document and functions of ``xacro_functions``. A dot accesses entries of
dictionaries and of xacro's namespaces, and some methods of texts, lists and dictionaries, but no
attribute of a Python object: from ``"".__class__`` a document could reach any code in the process.

The packages ``asteval`` and ``simpleeval`` are not used: they allow attributes of objects unless a
deny-list names them, and do not bound the size of the results of all operations below.
"""

from __future__ import annotations

import ast
import threading
import warnings
from collections.abc import Mapping
from functools import lru_cache

from morphgen.formats.xacro_functions import Function, RefusedError
from morphgen.formats.xacro_nodes import Scope, Translation

MAX_LENGTH = 10_000
"""Longest expression [characters]."""

_ORIGIN = "<expression>"
_PARSING = threading.Lock()
"""Held while Python's warnings are off: they are those of all threads."""


class Expression:
    """A translated expression; it can be evaluated for any values of its names."""

    def __init__(self, text: str) -> None:
        """Translate.

        Raises:
            SyntaxError: If it is not an expression.
            RefusedError: If it contains a construct that is not allowed, or is too long.
        """
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
        """Return the value of the expression.

        Args:
            names: Values and functions by name.
            inner: Further values; they hide those of ``names``.

        Raises:
            RefusedError: If the evaluation exceeds a bound, or its value is not data.
            NameError: If a name is unknown.
            Exception: Any exception of the operation in Python, such as ``ZeroDivisionError``.
        """
        value = self._node(Scope(names, dict(inner or {})))
        if isinstance(value, Function) or (isinstance(value, dict) and type(value) is not dict):
            raise RefusedError("its value is a function or namespace, not data")
        return value


@lru_cache(maxsize=4096)
def expression(text: str) -> Expression:
    """Return a translated expression; memoised.

    Raises:
        SyntaxError: As ``Expression``.
        RefusedError: As ``Expression``.
    """
    return Expression(text)
