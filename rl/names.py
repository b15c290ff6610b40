"""Controllers that learn nothing: their names, known before anything is loaded that they need."""

from __future__ import annotations

from collections.abc import Iterable

REFERENCES: dict[str, tuple[str, ...] | None] = {
    "random": None,
    "zero": None,
    "ik": ("reach",),
    "scripted": ("push",),
}
"""Their names, and the tasks that they are for, None for all; those that solve a task come last."""


def references_for(task: str) -> tuple[str, ...]:
    """Return the names of those for a task, the one that solves it first."""
    return tuple(name for name in reversed(REFERENCES) if is_for(name, (task,)))


def is_for(name: str, tasks: Iterable[str]) -> bool:
    """Return whether a controller is for any of some tasks."""
    own = REFERENCES[name]
    return own is None or bool(set(own) & set(tasks))
