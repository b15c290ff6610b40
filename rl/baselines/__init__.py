"""Baselines: controllers that learn nothing; they show that a task can be done.

Importing the registry loads nothing heavy, so that the command line lists baselines at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.benchmark.split import Task
    from morphgen.rl.rollouts import Controller
    from morphgen.tasks.batch import TaskBatch

BASELINES: dict[str, tuple[Task, ...]] = {
    "random": ("reach", "push"),
    "zero": ("reach", "push"),
    "ik": ("reach",),
    "scripted": ("push",),
}
"""Tasks of each baseline by its name; those that solve a task come last."""


def baselines_for(task: Task) -> tuple[str, ...]:
    """Return the baselines for a task; the first one solves it."""
    return tuple(name for name in reversed(BASELINES) if task in BASELINES[name])


def make_baseline(name: str, batch: TaskBatch, seed: int) -> Controller:
    """Return the baseline of a name in ``BASELINES``, for a batch.

    Raises:
        BenchmarkError: If a robot has hardly any collision-free configuration.
    """
    from morphgen.rl.baselines.simple import Random, Zero

    if name == "ik":
        from morphgen.rl.references import InverseKinematics
        from morphgen.tasks.free_space import FreeSpace

        return InverseKinematics(seed, [FreeSpace(setting.scene) for setting in batch.settings])
    if name == "scripted":
        from morphgen.rl.scripted_push import ScriptedPush

        return ScriptedPush(seed)
    return Random(seed) if name == "random" else Zero()
