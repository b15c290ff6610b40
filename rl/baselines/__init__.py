"""Baselines: controllers that learn nothing; they show that a task can be done.

Importing the registry loads nothing heavy, so that the command line lists baselines at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.rl.rollouts import Controller
    from morphgen.tasks.batch import TaskBatch

BASELINES: dict[str, tuple[str, ...] | None] = {
    "random": None,
    "zero": None,
    "ik": ("reach",),
    "scripted": ("push",),
}
"""Tasks of each baseline by its name, None for all; those that solve a task come last."""


def baselines_for(task: str) -> tuple[str, ...]:
    """Return the baselines for a task; if one solves it, that is the first."""
    return tuple(name for name in reversed(BASELINES) if is_for(name, (task,)))


def is_for(name: str, tasks: Iterable[str]) -> bool:
    """Return whether a baseline is for any of the tasks."""
    own = BASELINES[name]
    return own is None or bool(set(own) & set(tasks))


def make_baseline(name: str, batch: TaskBatch, seed: int) -> Controller:
    """Return the baseline of a name in ``BASELINES``, for a batch.

    Raises:
        BenchmarkError: If a robot has hardly any collision-free configuration.
    """
    from morphgen.rl.baselines.simple import Random, Zero

    if name == "ik":
        from morphgen.rl.references import InverseKinematics
        from morphgen.tasks.free_space import FreeSpace

        return InverseKinematics(seed, [FreeSpace(spec.scene) for spec in batch.specs])
    if name == "scripted":
        from morphgen.rl.scripted_push import ScriptedPush

        return ScriptedPush(seed)
    return Random(seed) if name == "random" else Zero()
