"""Reach and push over a batch of bodies, on interchangeable simulators."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.tasks.make import make_batch, make_split_batch

__all__ = ["make_batch", "make_split_batch"]


def __getattr__(name: str) -> object:
    if name in __all__:
        from morphgen.tasks import make

        return getattr(make, name)
    raise AttributeError(f"module 'morphgen.tasks' has no attribute {name!r}")
