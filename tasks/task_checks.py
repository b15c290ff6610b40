"""Check what tasks, also those of other packages, return: types and shapes, not values.

A check reads no tensor, so that a step on a GPU never waits for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from morphgen.errors import TaskError
from morphgen.tasks.step_result import StepResult
from morphgen.tasks.task import Task, TaskEnvs


def require_envs(task: Task[Any, Any], envs: object) -> None:
    """Require what ``Task.make_envs`` returns.

    Raises:
        TaskError: If it is something else.
    """
    if not isinstance(envs, TaskEnvs):
        raise TaskError(
            f"task {task.name!r}: make_envs returned {type(envs).__name__}; expected TaskEnvs"
        )


def require_start(task: str, start: object, k: int, num_joints: int) -> None:
    """Require what ``TaskEnvs.begin`` returns.

    Raises:
        TaskError: If it is something else.
    """
    if not isinstance(start, tuple) or len(start) != 2:
        raise TaskError(
            f"task {task!r}: begin returned {type(start).__name__}; expected two tensors: joint "
            "positions and poses of the block"
        )
    _require_shape(task, "begin: the joint positions", start[0], (k, num_joints))
    _require_shape(task, "begin: the poses of the block", start[1], (k, 7))


def require_result(task: str, result: object, k: int) -> None:
    """Require what ``TaskEnvs.evaluate`` returns.

    Raises:
        TaskError: If it is something else; the message names the part.
    """
    if not isinstance(result, StepResult):
        raise TaskError(
            f"task {task!r}: evaluate returned {type(result).__name__}; expected a StepResult"
        )
    if not result.terms:
        raise TaskError(f"task {task!r}: evaluate: no reward terms; expected one or more")
    for name in ("success", "terminated", "distance", "score"):
        value = getattr(result, name)
        _require_shape(task, f"evaluate: {name}", value, (k,))
        is_flag = name in ("success", "terminated")
        if is_flag != (value.dtype == torch.bool):
            expected = "bool" if is_flag else "numbers"
            raise TaskError(
                f"task {task!r}: evaluate: {name} is {value.dtype}; expected {expected}"
            )
    for name, value in result.terms.items():
        _require_shape(task, f"evaluate: the reward term {name!r}", value, (k,))


def require_fields(task: Task[Any, Any], values: Mapping[str, torch.Tensor], k: int) -> None:
    """Require what ``TaskEnvs.observe`` returns: every field that the task declares.

    Raises:
        TaskError: If a field is missing, is not declared, or has another shape.
    """
    declared = {field.name: field for field in task.fields}
    for name in declared.keys() ^ values.keys():
        if name in declared:
            raise TaskError(f"task {task.name!r}: observe: the field {name!r} is missing")
        raise TaskError(
            f"task {task.name!r}: observe: {name!r} is no ObservationField in the task's `fields`"
        )
    for name, value in values.items():
        _require_shape(task.name, f"observe: the field {name!r}", value, (k, declared[name].size))


def _require_shape(task: str, what: str, value: object, shape: tuple[int, ...]) -> None:
    if not isinstance(value, torch.Tensor):
        raise TaskError(f"task {task!r}: {what}: {type(value).__name__}; expected a tensor")
    if tuple(value.shape) != shape:
        raise TaskError(f"task {task!r}: {what} has shape {tuple(value.shape)}; expected {shape}")
