"""The environments of a batch grouped by task, so that each task evaluates only its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.kinematic_channels import ToolTargets
from morphgen.tasks.random_numbers import EpisodeRandom
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import (
    STANDARD_FIELDS,
    EnvSpec,
    StepFormulas,
    StepResult,
    Task,
    TaskEnvs,
    TaskState,
)
from morphgen.typing import Array


def _wrong_type(task: str, method: str, result: object, expected: str) -> TaskError:
    returned = type(result).__name__
    return TaskError(f"task {task!r}: {method} returned {returned}; expected {expected}")


def _require_start(task: str, start: object, k: int, num_joints: int) -> None:
    """Require what ``TaskEnvs.begin`` returns."""
    if not isinstance(start, tuple) or len(start) != 2:
        expected = "two tensors: joint positions and poses of the block"
        raise _wrong_type(task, "begin", start, expected)
    _require_shape(task, "begin: the joint positions", start[0], (k, num_joints))
    _require_shape(task, "begin: the poses of the block", start[1], (k, 7))


def _require_methods(task: str, envs: TaskEnvs) -> None:
    """Require ``evaluate`` and ``observe``, or the formulas that ``TaskEnvs`` calls for them."""
    kind = type(envs)
    lacking = [
        name for name in ("evaluate", "observe") if getattr(kind, name) is getattr(TaskEnvs, name)
    ]
    if lacking and not isinstance(getattr(envs, "formulas", None), StepFormulas):
        raise TaskError(
            f"task {task!r}: {kind.__name__} has no {' and no '.join(lacking)}; expected "
            f"{'this method' if len(lacking) == 1 else 'these methods'}, or `formulas`: "
            "StepFormulas, which have both"
        )


def _require_result(task: str, result: object, k: int) -> None:
    """Require what ``TaskEnvs.evaluate`` returns."""
    if not isinstance(result, StepResult):
        raise _wrong_type(task, "evaluate", result, "a StepResult")
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


def _require_fields(task: Task[Any, Any], values: Mapping[str, torch.Tensor], k: int) -> None:
    """Require what ``TaskEnvs.observe`` returns: every field that the task declares."""
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


@dataclass(frozen=True, eq=False)
class _Group:
    """The environments of one task."""

    task: Task[Any, Any]
    envs: TaskEnvs
    rows: torch.Tensor  # indices of its environments in the batch, shape (k,), int64


class TaskGroups:
    """The environments of a batch by task; tensors of the batch have n rows.

    Attributes:
        max_episode_steps: Time limit of episodes, shape (n,) [control steps].
        needs_tool_rotation: Whether a task needs the rotation of the tool in its state.
        moves_fingers: Whether actions move joints beyond the tool, shape (n,), bool.
        observation_fields: The standard fields, and those that the tasks declare.
        masks: Which environments have the fields of each mask, shape (n,) each, bool.
    """

    def __init__(
        self, specs: Sequence[EnvSpec], env_robot_index: torch.Tensor, num_joints: int
    ) -> None:
        """Group environments by the tasks of their specifications."""
        n, device = len(env_robot_index), env_robot_index.device
        env_specs = [specs[i] for i in env_robot_index.tolist()]
        self._num_joints = num_joints
        self._groups: dict[str, _Group] = {}
        self._row = torch.zeros(n, dtype=torch.int64, device=device)
        """Row of each environment in its group."""
        self.max_episode_steps = torch.zeros(n, dtype=torch.int64, device=device)
        self.moves_fingers = torch.zeros(n, dtype=torch.bool, device=device)
        for name in dict.fromkeys(spec.task for spec in env_specs):
            members = [i for i, spec in enumerate(specs) if spec.task == name]
            task, config = TASKS[name], specs[members[0]].config
            if any(specs[i].config != config for i in members):
                raise TaskError(f"environments at {name} have different constants; expected one")
            row_of_spec = torch.zeros(len(specs), dtype=torch.int64)
            row_of_spec[members] = torch.arange(len(members))
            is_at_task = torch.tensor([spec.task == name for spec in env_specs], device=device)
            rows = torch.nonzero(is_at_task)[:, 0]
            member_index = row_of_spec.to(device)[env_robot_index[rows]]
            envs = task.make_envs([specs[i] for i in members], member_index, num_joints)
            if not isinstance(envs, TaskEnvs):
                raise _wrong_type(name, "make_envs", envs, "TaskEnvs")
            _require_methods(name, envs)
            self._groups[name] = _Group(task, envs, rows)
            self._row[rows] = torch.arange(len(rows), device=device)
            self.max_episode_steps[rows] = config.max_episode_steps
            self.moves_fingers[rows] = task.moves_fingers
        task_fields = (field for group in self._groups.values() for field in group.task.fields)
        self.observation_fields = tuple(dict.fromkeys((*STANDARD_FIELDS, *task_fields)))
        self.needs_tool_rotation = any(
            group.envs.needs_tool_rotation for group in self._groups.values()
        )
        self.masks = {
            mask: torch.zeros(n, dtype=torch.bool, device=device)
            for mask in dict.fromkeys(field.mask for field in self.observation_fields)
        }
        for group in self._groups.values():
            for field in group.task.fields:
                self.masks[field.mask][group.rows] = True

    def __getitem__(self, task: str) -> TaskEnvs:
        """Return the environments of a task."""
        return self._groups[task].envs

    def task_mask(self, task: str) -> torch.Tensor:
        """Return which environments are at a task, shape (n,), bool."""
        mask = torch.zeros_like(self.moves_fingers)
        if task in self._groups:
            mask[self._groups[task].rows] = True
        return mask

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, layout: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Begin episodes; the arguments and the result are those of ``TaskEnvs.begin``, n rows."""
        starts = []
        for group in self._groups.values():
            start = group.envs.begin(
                self._rows_of(group, mask),
                random if self._is_one else random.select(group.rows),
                None if layout is None else self._rows_of(group, layout),
            )
            _require_start(group.task.name, start, len(group.rows), self._num_joints)
            starts.append(start)
        q, block_pose = map(self._merged, zip(*starts, strict=True))
        return q, block_pose

    @property
    def reset_options(self) -> dict[str, tuple[int, ...]]:
        """Options of ``reset`` that all tasks of the batch have; see ``Task.reset_options``."""
        first, *others = [group.task.reset_options for group in self._groups.values()]
        return {
            name: sizes
            for name, sizes in first.items()
            if all(other.get(name) == sizes for other in others)
        }

    def place(
        self, env: int, options: Mapping[str, Array], space: FreeSpace, q: Array, block_pose: Array
    ) -> tuple[Array, Array]:
        """Begin an episode as options ask for; see ``TaskEnvs.place``."""
        return self._group_of(env).envs.place(int(self._row[env]), options, space, q, block_pose)

    def evaluate(
        self, state: TaskState[torch.Tensor]
    ) -> tuple[StepResult[torch.Tensor], torch.Tensor]:
        """Evaluate a step of all environments; return also the rewards, shape (n,)."""
        results: list[StepResult[torch.Tensor]] = []
        for group in self._groups.values():
            values: dict[str, Any] = {
                name: None if value is None else self._rows_of(group, value)
                for name, value in vars(state).items()
            }
            result = group.envs.evaluate(TaskState(**values))
            _require_result(group.task.name, result, len(group.rows))
            results.append(result)
        rewards = [torch.stack(list(result.terms.values())).sum(dim=0) for result in results]
        merged: dict[str, Any] = {
            name: self._merged([getattr(result, name) for result in results])
            for name in ("success", "terminated", "distance", "score")
        }
        merged["terms"] = {
            name: self._merged(
                [
                    result.terms[name] if name in result.terms else torch.zeros_like(reward)
                    for result, reward in zip(results, rewards, strict=True)
                ]
            )
            for name in dict.fromkeys(name for result in results for name in result.terms)
        }
        if any(result.angle is not None for result in results):
            merged["angle"] = self._merged(
                [
                    torch.full_like(result.distance, torch.nan)
                    if result.angle is None
                    else result.angle
                    for result in results
                ]
            )
        return StepResult(**merged), self._merged(rewards)

    def fields(self, block_pose: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the observation fields of all tasks, shape (n, size) each, as copies."""
        n = len(self._row)
        values = {
            field.name: torch.zeros(n, field.size, device=self._row.device)
            for field in self.observation_fields
        }
        for group in self._groups.values():
            task_values = group.envs.observe(self._rows_of(group, block_pose))
            _require_fields(group.task, task_values, len(group.rows))
            for name, value in task_values.items():
                if self._is_one:
                    values[name] = value.clone()
                else:
                    values[name][group.rows] = value
        return values

    def tool_targets(self, block_pose: torch.Tensor) -> ToolTargets:
        """Return the points and orientations that the tasks want the tool at."""
        n, device = len(self._row), self._row.device
        groups = list(self._groups.values())
        task_points = [group.envs.target_points(block_pose[group.rows]) for group in groups]
        num_points = max(points.shape[1] for points in task_points)
        points = torch.zeros(n, num_points, 3, device=device)
        exists = torch.zeros(n, num_points, dtype=torch.bool, device=device)
        rotations, has_rotation = None, None
        for group, values in zip(groups, task_points, strict=True):
            points[group.rows, : values.shape[1]] = values
            exists[:, : values.shape[1]].index_fill_(0, group.rows, True)
            task_rotations = group.envs.target_rotations()
            if task_rotations is not None:
                if rotations is None or has_rotation is None:
                    rotations = torch.eye(3, device=device).repeat(n, 1, 1)
                    has_rotation = torch.zeros(n, dtype=torch.bool, device=device)
                rotations[group.rows] = task_rotations
                has_rotation.index_fill_(0, group.rows, True)
        return ToolTargets(points, exists, rotations, has_rotation)

    def marker_poses(self, env: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of each marker of an environment's task, shape (7,) each."""
        return self._group_of(env).envs.marker_poses(int(self._row[env]))

    def _group_of(self, env: int) -> _Group:
        return next(group for group in self._groups.values() if bool((group.rows == env).any()))

    def advance(self, progress: float) -> None:
        """Advance the curricula; the progress of the training is from 0 to 1."""
        for group in self._groups.values():
            group.envs.advance(progress)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the states of the tasks, n rows each, zero where another task is."""
        state: dict[str, torch.Tensor] = {}
        for group in self._groups.values():
            for name, values in group.envs.state_dict().items():
                state.setdefault(name, values.new_zeros(len(self._row), *values.shape[1:]))
                state[name][group.rows] = values
        return state

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what ``state_dict`` returned."""
        for group in self._groups.values():
            group_state = {
                name: state[name].to(self._row.device)[group.rows]
                for name in group.envs.state_dict()
            }
            group.envs.load_state_dict(group_state)

    @property
    def _is_one(self) -> bool:
        """Whether all environments are at one task, so that its tensors are those of the batch."""
        return len(self._groups) == 1

    def _rows_of(self, group: _Group, values: torch.Tensor) -> torch.Tensor:
        """Return the rows of a tensor of the batch that belong to a group."""
        return values if self._is_one else values[group.rows]

    def _merged(self, values: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return a tensor of the batch from those of all groups."""
        if self._is_one:
            return values[0]
        merged = values[0].new_empty(len(self._row), *values[0].shape[1:])
        for group, rows in zip(self._groups.values(), values, strict=True):
            merged[group.rows] = rows
        return merged
