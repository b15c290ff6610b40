"""morphgen: procedural robot morphologies with embedded tasks.

The public functions and the package ``tasks`` are loaded when first used, so that
``import morphgen`` costs nothing. If Gymnasium has been imported before, the environments
``morphgen/Reach-v0`` and ``morphgen/Push-v0`` are registered with it; see ``morphgen.tasks``.
"""

from __future__ import annotations

import sys as _sys
from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen import tasks
    from morphgen.api import check, compose, fix, read, sample, write
    from morphgen.errors import MorphgenError
    from morphgen.model.robot import Robot

    __version__: str

__all__ = [
    "MorphgenError",
    "Robot",
    "__version__",
    "check",
    "compose",
    "fix",
    "read",
    "sample",
    "tasks",
    "write",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        return _import_module("importlib.metadata").version("morphgen")
    if name == "tasks":
        return _import_module("morphgen.tasks")
    if name not in __all__:
        raise AttributeError(f"module 'morphgen' has no attribute {name!r}")
    modules = {"MorphgenError": "morphgen.errors", "Robot": "morphgen.model.robot"}
    return getattr(_import_module(modules.get(name, "morphgen.api")), name)


def __dir__() -> list[str]:
    return __all__


if "gymnasium" in _sys.modules:
    _import_module("morphgen.tasks")
