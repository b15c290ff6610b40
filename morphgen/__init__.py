"""morphgen: procedural robot morphologies with embedded tasks.

The public functions and the package ``tasks`` are loaded when first used, so that
``import morphgen`` costs nothing. If Gymnasium has been imported before, the tasks, such as
``morphgen/Reach-v0``, are registered with it; see ``morphgen.tasks``.
"""

from __future__ import annotations

import sys as _sys
from importlib import import_module as _import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen import tasks as tasks
    from morphgen.api.checks import check, conform, fix
    from morphgen.api.demonstrations import clone, demos, record, verify
    from morphgen.api.evaluation import evaluate, play
    from morphgen.api.export import export
    from morphgen.api.robots import compose, fit, make_env, read, sample, similarity, tokens, write
    from morphgen.api.splits import goals, split
    from morphgen.api.training import train
    from morphgen.errors import MorphgenError
    from morphgen.model.robot import Robot

    __version__: str

__all__ = [
    "MorphgenError",
    "Robot",
    "__version__",
    "check",
    "clone",
    "compose",
    "conform",
    "demos",
    "evaluate",
    "export",
    "fit",
    "fix",
    "goals",
    "make_env",
    "play",
    "read",
    "record",
    "sample",
    "similarity",
    "split",
    "tokens",
    "train",
    "verify",
    "write",
]

_MODULES = {
    "MorphgenError": "morphgen.errors",
    "Robot": "morphgen.model.robot",
    "check": "morphgen.api.checks",
    "clone": "morphgen.api.demonstrations",
    "compose": "morphgen.api.robots",
    "conform": "morphgen.api.checks",
    "demos": "morphgen.api.demonstrations",
    "evaluate": "morphgen.api.evaluation",
    "export": "morphgen.api.export",
    "fit": "morphgen.api.robots",
    "fix": "morphgen.api.checks",
    "goals": "morphgen.api.splits",
    "make_env": "morphgen.api.robots",
    "play": "morphgen.api.evaluation",
    "read": "morphgen.api.robots",
    "record": "morphgen.api.demonstrations",
    "sample": "morphgen.api.robots",
    "similarity": "morphgen.api.robots",
    "split": "morphgen.api.splits",
    "tokens": "morphgen.api.robots",
    "train": "morphgen.api.training",
    "verify": "morphgen.api.demonstrations",
    "write": "morphgen.api.robots",
}
"""Module of each public name."""

if not TYPE_CHECKING:  # to type checkers, a name that is not imported above is an error

    def __getattr__(name: str) -> object:
        if name == "__version__":
            return _import_module("importlib.metadata").version("morphgen")
        if name == "tasks":
            return _import_module("morphgen.tasks")
        if name not in _MODULES:
            raise AttributeError(f"module 'morphgen' has no attribute {name!r}")
        try:
            return getattr(_import_module(_MODULES[name]), name)
        except ModuleNotFoundError:
            # Said when the function is called, so that `import *` works without optional packages.
            errors = _import_module("morphgen.errors")
            return errors.explain_missing_extras("rl")(
                lambda *_, **__: _import_module(_MODULES[name])
            )

    def __dir__() -> list[str]:
        return list(__all__)


if "gymnasium" in _sys.modules:
    _import_module("morphgen.tasks")
