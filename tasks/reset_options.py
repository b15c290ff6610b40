"""Episodes that begin where the caller says: ``reset(options=...)``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from morphgen.errors import TaskError, nearest
from morphgen.model.kinematics import joint_limits
from morphgen.tasks.free_space import outside_limits
from morphgen.tasks.observation import EpisodeLayouts
from morphgen.tasks.task import EnvSpec
from morphgen.tasks.task_groups import TaskGroups
from morphgen.typing import Array

Q = "q"  # option of every task: joint positions at the start
ROUNDING = 1e-6  # distance beyond a joint limit that single precision explains [rad or m]


def place_episodes(
    options: Mapping[str, Any],
    groups: TaskGroups,
    layouts: EpisodeLayouts,
    q: torch.Tensor,
    object_pose: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return q (n, J) and block poses (n, 7) of episodes that were drawn, after the options.

    Options name joint positions, and goals or blocks where the tasks allow it.
    """
    wanted_rows = _rows(options, groups, layouts.specs)
    q, object_pose = q.clone(), object_pose.clone()
    for env, (spec, wanted) in enumerate(zip(layouts.specs, wanted_rows, strict=True)):
        robot, space = spec.robot, layouts.space(env)
        drawn_q, drawn_block = (
            rows[env].double().cpu().numpy() for rows in (q[:, : robot.dof], object_pose)
        )
        start = drawn_q
        if Q in wanted:
            low, high = joint_limits(robot).T
            start = np.clip(wanted[Q], low - ROUNDING, high + ROUNDING)
            for _, fault in outside_limits(robot, wanted[Q][None]):
                if not np.array_equal(start, wanted[Q]):
                    raise TaskError(f"reset: option 'q' of {robot.name!r}: {fault}")
            start = np.clip(start, low, high)
        try:
            start, block = groups.place(env, wanted, space, start, drawn_block)
        except TaskError as error:
            raise TaskError(f"reset: {robot.name!r} at {spec.task}: {error}") from error
        if np.array_equal(start, drawn_q) and np.array_equal(block, drawn_block):
            continue  # which is free as it was drawn
        blocks = None if spec.scene.object is None else block[None]
        if not space.free(start[None], blocks)[0]:
            another = "; another seed draws another layout of the obstacles"
            another *= bool(spec.scene.obstacles)
            raise TaskError(
                f"reset: {robot.name!r} at {spec.task}: the start q {_text(start)} collides "
                f"with itself or the scene{another}"
            )
        q[env, : robot.dof] = torch.from_numpy(start)
        object_pose[env] = torch.from_numpy(block)
    return q, object_pose


def _rows(
    options: Mapping[str, Any], groups: TaskGroups, specs: Sequence[EnvSpec]
) -> list[dict[str, Array]]:
    """Return the options of each environment as vectors of finite numbers."""
    if not isinstance(options, Mapping):
        raise TaskError(f"reset: options {options!r}: expected a dictionary")
    known = groups.reset_options
    rows: list[dict[str, Array]] = [{} for _ in specs]
    for name, value in options.items():
        if name != Q and name not in known:
            tasks = " and ".join(dict.fromkeys(spec.task for spec in specs))
            hint = nearest(str(name), [Q, *known])
            raise TaskError(f"reset: unknown option {name!r} of {tasks}{hint}")
        for row, vector, spec in zip(rows, _each(name, value, len(specs)), specs, strict=True):
            dof = spec.robot.dof
            if name == Q and vector.ndim == 1 and len(vector) > dof and len(rows) > 1:
                vector = vector[:dof]  # rows of a batch are padded
            sizes = (dof,) if name == Q else known[name]
            if vector.ndim != 1 or len(vector) not in sizes:
                wanted = " or ".join(f"({size},)" for size in sizes)
                raise TaskError(
                    f"reset: option {name!r} of {spec.robot.name!r} has shape {vector.shape}; "
                    f"expected {wanted}"
                )
            if not np.isfinite(vector).all():
                raise TaskError(f"reset: option {name!r} {_text(vector)}: expected finite numbers")
            row[name] = vector
    return rows


def _each(name: str, value: Any, count: int) -> list[Array]:  # noqa: ANN401 - as the caller gave it
    """Return the vector of an option for each environment."""
    try:
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu()
        is_list = isinstance(value, Sequence | np.ndarray) and len(value) == count
        if is_list and all(np.ndim(each) == 1 for each in value):
            return [np.array(each, np.float64) for each in value]
        return [np.array(value, np.float64)] * count
    except (TypeError, ValueError) as error:
        raise TaskError(f"reset: option {name!r} {value!r}: expected numbers") from error


def unit_quaternion(values: Array, name: str) -> Array:
    """Return the quaternion of an option with unit length and w >= 0."""
    norm = float(np.linalg.norm(values))
    if abs(norm - 1) > 1e-2:
        raise TaskError(
            f"option {name!r} has the quaternion {_text(values)} of length {norm:.3g}; expected "
            "(qw, qx, qy, qz) of length 1"
        )
    return values / (norm if values[0] >= 0 else -norm)


def _text(vector: Array) -> str:
    return f"({', '.join(f'{number:g}' for number in vector)})"
