"""The ``xacro`` package's document processing, in a private copy per thread.

``xacro`` keeps the file stack, the arguments and the package lookup in module globals, prints its
warnings and replaces a method of ``xml.dom.minidom``. Here its module body runs under a private
name, which isolates it from other users of the package in the same process.

Security: the package passes text of a document to Python's ``eval`` in one function, ``safe_eval``.
The allow-list of ``xacro_expressions`` replaces it. (``is_valid_name`` only parses.) The functions
that open files are replaced, too: ``xacro.Expansion`` sets them for each expansion, and
``xacro_files`` reads YAML, so that tags of a document reach no other constructor.
"""

from __future__ import annotations

import importlib.util
import logging
import sys
import threading
from collections.abc import Callable, Mapping
from importlib.machinery import SourceFileLoader
from types import CodeType, ModuleType, SimpleNamespace
from typing import Any, TypeAlias
from xml.dom import minidom

from morphgen.formats.xacro_expressions import expression
from morphgen.formats.xacro_functions import BUILTINS, MATH, Function, RefusedError

Engine: TypeAlias = Any
"""A ``xacro`` module, which has no type hints."""
Untyped: TypeAlias = Any
"""Elements and symbol tables of the module, which have no type hints either."""

MAX_ELEMENTS = 50_000
"""Largest number of elements that an expansion may process; the PR2 has 2,734."""
MAX_TEXT = 20_000_000
"""Largest text that the substitutions of an expansion may create [characters]."""

_NAME = "morphgen.formats._xacro"
_READERS = ("parse", "load_yaml", "list_files", "eval_extension")
"""Functions of the module through which a document accesses files; the caller sets them."""
_log = logging.getLogger("morphgen.formats.xacro")
_per_thread = threading.local()


def thread_engine() -> Engine:
    """Return this thread's copy of the ``xacro`` module, reset to its initial state.

    Differences from the package: an allow-list evaluates expressions, the number of elements and
    the size of text are bounded, ``node`` is the element being processed, and warnings go to the
    logger ``morphgen.formats.xacro`` (level INFO) instead of the terminal.
    """
    if not hasattr(_per_thread, "engine"):
        _per_thread.engine = _fresh_module()
    engine = _per_thread.engine
    engine.init_stacks(None)
    engine.all_includes = []
    engine.substitution_args_context = {}
    engine.verbosity = 0
    engine.node = None
    for name in _READERS:  # the readers of the last expansion must not remain
        setattr(engine, name, _refuse_access)
    engine.elements = engine.text = 0
    engine._global_symbols = _symbols(engine)
    return engine


def _fresh_module() -> Engine:
    module: Engine = ModuleType(_NAME)
    module.__package__ = _NAME
    module.__path__ = sys.modules[_NAME].__path__
    module.print = _record
    exec(_BODY, module.__dict__)
    module.eval_text = _shortcut(module)
    module.safe_eval = _safe_eval
    module.glob = SimpleNamespace(glob=lambda pattern: module.list_files(pattern))
    module.eval_all = _counting(module)
    for name in ("handle_macro_call", "process_include", "check_attrs", "reqd_attrs"):
        setattr(module, name, _returning(module, getattr(module, name)))
    return module


def _safe_eval(
    text: str, symbols: Mapping[str, object], local: Mapping[str, object] | None = None
) -> object:
    return expression(text.strip()).evaluate(symbols, local)


def _shortcut(engine: Engine) -> Callable[[str, Any], object]:
    """Return ``eval_text`` with a limit on the size of its results.

    It skips the lexer, a quarter of an expansion's time, for texts without expressions.
    """
    eval_text = engine.eval_text

    def evaluated(text: str, symbols: Untyped) -> object:
        if "$" not in text:
            return text
        result = eval_text(text, symbols)
        if isinstance(result, str):
            engine.text += len(result)
            if engine.text > MAX_TEXT:
                raise RefusedError(f"the expansion creates more than {MAX_TEXT} characters")
        return result

    return evaluated


def _counting(engine: Engine) -> Callable[[Any, Any, Any], None]:
    """Return ``eval_all`` with a limit on the number of elements; it stores the element."""
    eval_all = engine.eval_all

    def counted(node: Untyped, macros: Untyped, symbols: Untyped) -> None:
        engine.elements += 1
        if engine.elements > MAX_ELEMENTS:
            raise RefusedError(f"the expansion processes more than {MAX_ELEMENTS} elements")
        engine.node = node
        eval_all(node, macros, symbols)

    return counted


def _returning(engine: Engine, function: Callable[..., object]) -> Callable[..., object]:
    """Wrap a function so that ``node`` is its element again after it processed other elements."""

    def call_and_restore(node: Untyped, *rest: Untyped) -> object:
        engine.node = node
        result = function(node, *rest)
        engine.node = node
        return result

    return call_and_restore


def _symbols(engine: Engine) -> dict[str, object]:
    """Return the names that every document may use, with and without a namespace."""

    def space(members: Mapping[str, object]) -> object:
        names = engine.NameSpace()
        dict.update(names, members)
        return names

    def fatal(*words: object) -> None:
        raise engine.XacroException(" ".join(map(str, words)))

    def tokenize(text: str, sep: str = ",; ", skip_empty: bool = True) -> list[str]:
        for character in sep[1:]:
            text = text.replace(character, sep[0])
        return [word for word in text.split(sep[0]) if word or not skip_empty]

    files = {
        "load_yaml": lambda name: engine.load_yaml(name),
        "abs_filename": engine.abs_filename_spec,
        "dotify": _same,
    }
    calls = {
        **files,
        "arg": lambda name: engine.substitution_args_context["arg"][name],
        "fatal": fatal,
        "tokenize": tokenize,
        **dict.fromkeys(("message", "warning", "error", "print_location"), _record),
    }
    functions = {name: Function(name, call) for name, call in calls.items()}
    return {
        **MATH,
        **BUILTINS,
        **{name: functions[name] for name in files},
        "math": space(MATH),
        "python": space(BUILTINS),
        "xacro": space(functions),
    }


def _same(dictionary: dict[str, object]) -> dict[str, object]:
    """Return a dictionary unchanged: ``xacro.dotify``, but dots work on every dictionary here."""
    if not isinstance(dictionary, dict):
        raise TypeError("dotify() takes a dictionary")
    return dictionary


def _refuse_access(*_: object) -> object:
    raise RefusedError("files and substitutions are not available here")


def _record(*words: object, **_: object) -> str:
    _log.info(" ".join(map(str, words)))
    return ""


def _load_package() -> CodeType:
    """Import the package's modules under the private name and return its compiled body."""
    spec = importlib.util.find_spec("xacro")
    if spec is None or not isinstance(spec.loader, SourceFileLoader):
        raise ModuleNotFoundError("morphgen needs the package xacro: pip install xacro")
    private = importlib.util.spec_from_file_location(
        _NAME, spec.origin, submodule_search_locations=list(spec.submodule_search_locations or ())
    )
    assert private is not None
    assert private.loader is not None
    module = importlib.util.module_from_spec(private)
    sys.modules[_NAME] = module
    writer = minidom.Element.writexml
    private.loader.exec_module(module)
    minidom.Element.writexml = writer  # type: ignore[method-assign]
    sys.modules[f"{_NAME}.color"].print = _record  # type: ignore[attr-defined]
    body = spec.loader.get_code("xacro")
    assert body is not None
    return body


_BODY = _load_package()
