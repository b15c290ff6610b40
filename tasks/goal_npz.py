"""Goal sets of either task as files of a split."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import Task
from morphgen.errors import BenchmarkError
from morphgen.tasks.goals import GoalSet
from morphgen.tasks.push_sets import PushSet
from morphgen.tasks.set_files import set_from_npz

Goals: TypeAlias = GoalSet | PushSet
"""What episodes start from and aim at, whatever the task."""

_KINDS: Mapping[Task, type[GoalSet] | type[PushSet]] = {"reach": GoalSet, "push": PushSet}


def goals_from_npz(content: bytes, task: Task, path: Path) -> Goals:
    """Read a set that came with a split.

    Args:
        content: The file.
        task: Which kind of set it is.
        path: Where it stands, for messages.

    Raises:
        BenchmarkError: If it is no such set.
    """
    try:
        goals: Goals = set_from_npz(content, _KINDS[task])
    except ValueError as error:
        raise BenchmarkError(f"{path}: no goal set for {task}: {error}") from error
    shapes = goals.q.shape, poses_of(goals).shape
    if len(shapes[0]) != 2 or shapes[1] != (shapes[0][0], 7):
        raise BenchmarkError(
            f"{path}: configurations and poses are of shapes {shapes[0]} and {shapes[1]}"
        )
    return goals


def poses_of(goals: Goals) -> NDArray[np.float64]:
    """Where goals are: of the tool (reach), or of the block at the start (push), (n, 7)."""
    return goals.poses if isinstance(goals, GoalSet) else goals.blocks
