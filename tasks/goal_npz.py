"""A goal set as a file: the same set gives the same bytes."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeAlias
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.split import Task
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Pose
from morphgen.tasks.goals import GoalSet
from morphgen.tasks.push_sets import PushSet
from morphgen.tasks.sim.base import Block

Goals: TypeAlias = GoalSet | PushSet
"""What episodes start from and aim at, whatever the task."""

_KINDS: Mapping[Task, type[GoalSet] | type[PushSet]] = {"reach": GoalSet, "push": PushSet}


def goals_npz(goals: Goals) -> bytes:
    """A set as a file: an array a field.

    Blocks are rows of 12: edges, pose (x, y, z, qw, qx, qy, qz), mass and friction.
    """
    content = io.BytesIO()
    np.savez(content, **arrays_of(goals))  # type: ignore[arg-type]  # they are not allow_pickle
    return content.getvalue()


def goals_from_npz(content: bytes, task: Task, path: Path) -> Goals:
    """Read what ``goals_npz`` wrote.

    Args:
        content: The file.
        task: Which kind of set it is.
        path: Where it stands, for messages.

    Raises:
        BenchmarkError: If it is no such set.
    """
    kind = _KINDS[task]
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            values: dict[str, Any] = {
                each.name: _value(each.name, data[each.name]) for each in fields(kind)
            }
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise BenchmarkError(f"{path}: no goal set for {task}: {error}") from error
    goals = kind(**values)
    shapes = goals.q.shape, poses_of(goals).shape
    if len(shapes[0]) != 2 or shapes[1] != (shapes[0][0], 7):
        raise BenchmarkError(
            f"{path}: configurations and poses are of shapes {shapes[0]} and {shapes[1]}"
        )
    return goals


def poses_of(goals: Goals) -> NDArray[np.float64]:
    """Where goals are: of the tool (reach), or of the block at the start (push), (n, 7)."""
    return goals.poses if isinstance(goals, GoalSet) else goals.blocks


def arrays_of(goals: Goals) -> dict[str, NDArray[Any]]:
    """The fields of a set as arrays, by name; see ``goals_npz``."""
    return {each.name: _array(getattr(goals, each.name)) for each in fields(goals)}


def _array(value: object) -> NDArray[Any]:
    if isinstance(value, Block):
        return np.array(_row(value))
    if isinstance(value, tuple):
        return np.array([_row(block) for block in value], dtype=np.float64).reshape(-1, 12)
    return np.asarray(value)


def _value(name: str, array: NDArray[Any]) -> object:
    if name == "block":
        return _block(array.tolist())
    if name == "obstacles":
        return tuple(_block(row) for row in array.tolist())
    return array if array.ndim else array.item()


def _row(block: Block) -> list[float]:
    return [*block.size, *block.pose.position, *block.pose.quaternion, block.mass, block.friction]


def _block(row: list[float]) -> Block:
    a, b, c, x, y, z, qw, qx, qy, qz, mass, friction = row
    return Block((a, b, c), Pose((x, y, z), (qw, qx, qy, qz)), mass, friction)
