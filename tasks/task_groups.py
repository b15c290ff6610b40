"""The environments of a batch grouped by task, so that each task evaluates only its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError
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

_RESULTS = ("success", "terminated", "distance", "score")


@dataclass(frozen=True, eq=False)
class _Group:
    """The environments of one task."""

    task: Task[Any, Any]
    envs: TaskEnvs
    rows: torch.Tensor  # indices of its environments in the batch, shape (k,), int64

    def start(self, start: Any, num_joints: int) -> dict[str, torch.Tensor]:  # noqa: ANN401
        """Return what ``TaskEnvs.begin`` returned by name, if that is sound."""
        q, object_pose = start
        self._require("begin: the joint positions", q, num_joints)
        self._require("begin: the poses of the block", object_pose, 7)
        return {"q": q, "object_pose": object_pose}

    def result(self, state: TaskState[torch.Tensor]) -> StepResult[torch.Tensor]:
        """Return the result of ``StepFormulas.evaluate``."""
        result = self.envs.formulas.evaluate(state)
        for name in _RESULTS:
            self._require(f"evaluate: {name}", getattr(result, name))
        for name, value in result.terms.items():
            self._require(f"evaluate: the reward term {name!r}", value)
        return result

    def fields(self, object_pose: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return what ``StepFormulas.observe`` does: a value for each field of the task."""
        values = self.envs.formulas.observe(object_pose)
        sizes = {field.name: field.size for field in self.task.fields}
        if sizes.keys() != values.keys():
            raise TaskError(
                f"task {self.task.name!r}: observe returned {', '.join(values)}; expected the "
                f"task's `fields`: {', '.join(sizes)}"
            )
        for name, value in values.items():
            self._require(f"observe: the field {name!r}", value, sizes[name])
        return values

    def _require(self, part: str, value: torch.Tensor, *size: int) -> None:
        """Require a row per environment, lest other shapes are broadcast."""
        if tuple(value.shape) != (shape := (len(self.rows), *size)):
            raise TaskError(
                f"task {self.task.name!r}: {part} has shape {tuple(value.shape)}; expected {shape}"
            )


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
        device, self._num_joints = env_robot_index.device, num_joints
        index = env_robot_index.tolist()
        self._groups: dict[str, _Group] = {}
        self._row = torch.zeros_like(env_robot_index)  # row of each environment in its group
        self.max_episode_steps = torch.zeros_like(env_robot_index)
        self.moves_fingers = torch.zeros_like(env_robot_index, dtype=torch.bool)
        for name in dict.fromkeys(specs[i].task for i in index):
            members = [i for i, spec in enumerate(specs) if spec.task == name]
            task, config = TASKS[name], specs[members[0]].config
            if any(specs[i].config != config for i in members):
                raise TaskError(f"environments at {name} have different constants; expected one")
            member_of = {i: k for k, i in enumerate(members)}
            pairs = [(env, member_of[i]) for env, i in enumerate(index) if i in member_of]
            rows, member_index = torch.tensor(pairs, device=device).T.contiguous()
            envs = task.make_envs([specs[i] for i in members], member_index, num_joints)
            if not isinstance(getattr(envs, "formulas", None), StepFormulas):
                kind = type(envs).__name__
                raise TaskError(f"task {name!r}: {kind} has no `formulas`; expected StepFormulas")
            self._groups[name] = _Group(task, envs, rows)
            self._row[rows] = torch.arange(len(rows), device=device)
            self.max_episode_steps[rows] = config.max_episode_steps
            self.moves_fingers[rows] = task.moves_fingers
        groups = self._groups.values()
        task_fields = (field for group in groups for field in group.task.fields)
        self.observation_fields = tuple(dict.fromkeys((*STANDARD_FIELDS, *task_fields)))
        self.needs_tool_rotation = any(group.envs.needs_tool_rotation for group in groups)
        self.masks = {
            field.mask: torch.zeros_like(self.moves_fingers) for field in self.observation_fields
        }
        for group in groups:
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
            starts.append(group.start(start, self._num_joints))
        merged = self._merged(starts)
        return merged["q"], merged["object_pose"]

    def evaluate(
        self, state: TaskState[torch.Tensor]
    ) -> tuple[StepResult[torch.Tensor], torch.Tensor]:
        """Evaluate a step of all environments; return also the rewards, shape (n,)."""
        results = []
        for group in self._groups.values():
            values: dict[str, Any] = {
                name: None if value is None else self._rows_of(group, value)
                for name, value in vars(state).items()
            }
            results.append(group.result(TaskState(**values)))
        terms = self._merged([result.terms for result in results])
        angles = [{} if each.angle is None else {"angle": each.angle} for each in results]
        merged = self._merged(
            [
                {name: getattr(result, name) for name in _RESULTS}
                | {"reward": torch.stack([*result.terms.values()]).sum(dim=0)}
                for result in results
            ]
        )
        reward = merged.pop("reward")
        return StepResult(**merged, terms=terms, **self._merged(angles, torch.nan)), reward

    def fields(self, object_pose: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the observation fields of all tasks, shape (n, size) each, as copies."""
        n, device = len(self._row), self._row.device
        values = self._merged(
            [group.fields(self._rows_of(group, object_pose)) for group in self._groups.values()]
        )
        return {
            field.name: values[field.name].clone()
            if field.name in values
            else torch.zeros(n, field.size, device=device)
            for field in self.observation_fields
        }

    def tool_targets(self, object_pose: torch.Tensor, least: int = 0) -> ToolTargets:
        """Return the points, padded to a least number, and orientations that tasks want.

        A task with fewer points than others repeats its last one, where the tool is to stay. Were
        the others missing, robots that only reach would learn that the first point is the goal,
        and would stop there at push, behind the block.
        """
        groups = self._groups.values()
        points = [group.envs.target_points(self._rows_of(group, object_pose)) for group in groups]
        count = max(least, *(each.shape[1] for each in points))
        targets = []
        for group, values in zip(groups, points, strict=True):
            k, own = len(group.rows), values.shape[1]
            last = values[:, -1:] if own else values.new_zeros(k, 1, 3)
            repeated = torch.cat([values, last.expand(k, count - own, 3)], dim=1)
            exists = torch.full((k, count), own > 0, device=object_pose.device)
            target = {"points": repeated, "exists": exists}
            if (rotations := group.envs.target_rotations()) is not None:
                wanted = torch.ones_like(group.rows, dtype=torch.bool)
                target |= {"rotations": rotations, "has_rotation": wanted}
            targets.append(target)
        merged = self._merged(targets)
        if "rotations" in merged:  # any rotation where no task wants one, rather than zeros
            wanted, identity = merged["has_rotation"], torch.eye(3, device=object_pose.device)
            merged["rotations"] = merged["rotations"].where(wanted[:, None, None], identity)
        return ToolTargets(**merged)

    def marker_poses(self, env: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of each marker of an environment's task, shape (7,) each."""
        envs = next(g.envs for g in self._groups.values() if bool((g.rows == env).any()))
        return envs.marker_poses(int(self._row[env]))

    def advance(self, progress: float) -> None:
        """Advance the curricula; the progress of the training is from 0 to 1."""
        for group in self._groups.values():
            group.envs.advance(progress)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the states of the tasks, n rows each, zero where another task is."""
        return self._merged([group.envs.state_dict() for group in self._groups.values()])

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

    def _merged(
        self, tensors: Sequence[Mapping[str, torch.Tensor]], fill: float = 0
    ) -> dict[str, torch.Tensor]:
        """Return tensors of the batch from those of all groups; some groups may lack some."""
        if self._is_one:
            return dict(tensors[0])
        merged: dict[str, torch.Tensor] = {}
        for group, values in zip(self._groups.values(), tensors, strict=True):
            for name, rows in values.items():
                if name not in merged:
                    merged[name] = rows.new_full((len(self._row), *rows.shape[1:]), fill)
                merged[name][group.rows] = rows
        return merged
