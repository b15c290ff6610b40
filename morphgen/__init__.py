"""morphgen: procedural robot morphologies with embedded tasks.

``compose``, ``sample``, ``read``, ``write``, ``check`` and ``fix`` are loaded when first used, so
that ``import morphgen`` costs nothing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.api import check, compose, fix, read, sample, write

__all__ = ["check", "compose", "fix", "read", "sample", "write"]


def __getattr__(name: str) -> object:
    if name in __all__:
        from morphgen import api

        return getattr(api, name)
    raise AttributeError(f"module 'morphgen' has no attribute {name!r}")
