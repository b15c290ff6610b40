"""Registry of baselines: controllers without learning, floors and ceilings of every table.

Importing the registry loads no simulator and no torch, so that the command line starts quickly.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Protocol

from morphgen.tasks.registry import Registry

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.batch import TaskBatch


class Controller(Protocol):
    """Source of actions for a batch: a baseline, or a policy (``inference.PolicyController``)."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L)."""


@dataclass(frozen=True)
class Baseline:
    """Entry of the registry: a baseline's controller and its tasks."""

    name: str
    """Name in ``BASELINES``."""
    controller: str
    """Import path of the controller's class, as ``module:class``; imported when it is used."""
    tasks: tuple[str, ...] | None = None
    """Tasks that the baseline is for; None for all tasks."""
    is_independent: bool = False
    """Whether an action depends on the state of its environment alone."""

    def suits(self, tasks: Iterable[str]) -> bool:
        """Return whether the baseline is for any of the tasks."""
        return self.tasks is None or not set(self.tasks).isdisjoint(tasks)

    def make(self, seed: int) -> Controller:
        """Return a new controller; its random numbers depend on the seed alone."""
        module, _, name = self.controller.partition(":")
        controller: Controller = getattr(import_module(module), name)(seed)
        return controller


RANDOM = Baseline("random", "morphgen.rl.baselines.reach:Random")
ZERO = Baseline("zero", "morphgen.rl.baselines.reach:Zero", is_independent=True)
JACOBIAN = Baseline(
    "jacobian", "morphgen.rl.baselines.reach:JacobianColumns", ("reach",), is_independent=True
)
IK = Baseline("ik", "morphgen.rl.baselines.reach:InverseKinematics", ("reach",))
_WITH_OBJECTS = ("push", "drawer", "door", "dial")
PATH = Baseline("path", "morphgen.rl.baselines.path_push:PathPush", _WITH_OBJECTS)
SCRIPTED = Baseline(
    "scripted", "morphgen.rl.baselines.scripted_articulated:Scripted", _WITH_OBJECTS
)

BASELINES: Registry[Baseline] = Registry(
    "baseline",
    "morphgen.baselines",
    {each.name: each for each in (RANDOM, ZERO, JACOBIAN, IK, PATH, SCRIPTED)},
)
"""Baselines by name; those that solve a task come last."""


def baselines_for(task: str) -> tuple[str, ...]:
    """Return the names of a task's baselines; one that solves the task comes first."""
    return tuple(name for name in reversed(tuple(BASELINES)) if BASELINES[name].suits((task,)))
