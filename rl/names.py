"""Controllers that learn nothing: their names, known before anything is loaded that they need."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.benchmark.split import Task

REFERENCES: dict[str, tuple[Task, ...]] = {
    "random": ("reach", "push"),
    "zero": ("reach", "push"),
    "ik": ("reach",),
    "scripted": ("push",),
}
"""Their names, and the tasks that they are for; whoever does a task comes after who does not."""


def references_for(task: Task) -> tuple[str, ...]:
    """Those for a task, the one that does it first."""
    return tuple(name for name in reversed(REFERENCES) if task in REFERENCES[name])
