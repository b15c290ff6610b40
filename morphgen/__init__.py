"""morphgen: procedural robot morphologies with embedded tasks.

``compose``, ``sample``, ``read``, ``write``, ``check``, ``fix`` and the room ``tasks`` are loaded
when first used, so that ``import morphgen`` costs nothing; it tells Gymnasium of the environments
``morphgen/Reach-v0`` and ``morphgen/Push-v0``.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from morphgen.tasks.registration import register as _register_environments

if TYPE_CHECKING:
    from morphgen.api import check, compose, fix, read, sample, write

__all__ = ["check", "compose", "fix", "read", "sample", "tasks", "write"]


def __getattr__(name: str) -> object:
    if name == "tasks":
        return import_module("morphgen.tasks")
    if name in __all__:
        return getattr(import_module("morphgen.api"), name)
    raise AttributeError(f"module 'morphgen' has no attribute {name!r}")


_register_environments()
