"""The ``xacro`` package's evaluator, in a private copy per thread.

``xacro`` keeps the file stack, the arguments and the package lookup in module globals, prints its
warnings and replaces a method of ``xml.dom.minidom``. Here its module body runs under a private
name, so that none of this reaches, or is reached by, another user of the package in the process.
"""

from __future__ import annotations

import ast
import importlib.util
import logging
import sys
import threading
from collections.abc import Callable
from functools import lru_cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeAlias
from xml.dom import minidom

import yaml

Engine: TypeAlias = Any
"""A ``xacro`` module, which has no type hints."""

_NAME = "morphgen.formats._xacro"
_FRAMES = frozenset({"gi_frame", "cr_frame", "ag_frame", "tb_frame", "f_back", "f_builtins"})
_log = logging.getLogger("morphgen.formats.xacro")
_per_thread = threading.local()


def thread_engine() -> Engine:
    """Return this thread's copy of the ``xacro`` module, without anything of an earlier call.

    Two things differ from the package: expressions cannot reach Python's internals through names
    with a double underscore or through frames, wherever they stand in the expression; and warnings
    go to the logger ``morphgen.formats.xacro`` (level INFO) instead of the terminal.
    """
    if not hasattr(_per_thread, "engine"):
        _per_thread.engine = _fresh_module()
        _per_thread.symbols = _per_thread.engine.create_global_symbols()
    engine = _per_thread.engine
    engine.init_stacks(None)
    engine.all_includes = []
    engine.substitution_args_context = {}
    engine.verbosity = 0
    engine._global_symbols = _copied(_per_thread.symbols, engine)
    return engine


def _fresh_module() -> Engine:
    module: Engine = ModuleType(_NAME)
    module.__package__ = _NAME
    module.__path__ = sys.modules[_NAME].__path__
    module.print = _record
    exec(_BODY, module.__dict__)
    module.eval_text = _shortcut(module.eval_text)
    module.safe_eval = _safe_eval
    module.load_yaml = _yaml_loader(module)
    return module


def _shortcut(eval_text: Callable[[str, Any], object]) -> Callable[[str, Any], object]:
    """Most texts hold nothing to evaluate; the lexer takes a quarter of an expansion's time."""
    return lambda text, symbols: eval_text(text, symbols) if "$" in text else text


def _copied(symbols: dict[str, Any], engine: Engine) -> dict[str, Any]:
    """Global symbols whose namespaces an expression may change without lasting effect."""
    copies = dict(symbols)
    for name, value in symbols.items():
        if isinstance(value, engine.NameSpace):
            copies[name] = engine.NameSpace()
            dict.update(copies[name], value)
    return copies


def _safe_eval(
    expression: str, symbols: dict[str, Any], local: dict[str, Any] | None = None
) -> object:
    symbols.update(__builtins__={})
    return eval(_compiled(expression.strip()), symbols, local)


@lru_cache(maxsize=4096)
def _compiled(expression: str) -> CodeType:
    tree = ast.parse(expression, "<expression>", "eval")
    for node in ast.walk(tree):
        name = getattr(node, "attr", None) or getattr(node, "id", None) or ""
        if name.startswith("__") or name in _FRAMES:
            raise NameError(f"{name!r} is not allowed in an expression")
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Pow) and _is_huge(node.right):
            raise ValueError("an exponent is beyond 1000")
    return compile(tree, "<expression>", "eval")


def _is_huge(exponent: ast.expr) -> bool:
    """Whether an exponent holds numbers that no robot needs and that would take for ever."""
    numbers = [node.value for node in ast.walk(exponent) if isinstance(node, ast.Constant)]
    tower = any(isinstance(node, ast.Pow) for node in ast.walk(exponent))
    return tower or any(isinstance(n, int | float) and abs(n) > 1000 for n in numbers)


def _yaml_loader(engine: Engine) -> Callable[[str], object]:
    class Loader(yaml.SafeLoader):
        """YAML with xacro's unit tags, which the shared loader must not learn."""

    for unit in engine.ConstructUnits:
        Loader.add_constructor(unit.value.tag, unit.constructor)

    def load_yaml(filename: str) -> object:
        text = Path(engine.abs_filename_spec(filename)).read_text(encoding="utf-8")
        return engine.YamlListWrapper.wrap(yaml.load(text, Loader))

    return load_yaml


def _record(*words: object, **_: object) -> None:
    _log.info(" ".join(map(str, words)))


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
