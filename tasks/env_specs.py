"""Make environment specifications: robots at tasks, with their scenes and goal sets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.split import Member, compose_member
from morphgen.errors import TaskError
from morphgen.fitting.replace_collision import as_primitives
from morphgen.grammar.library import Library
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goal_sets import goal_set
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import EnvSpec, GoalSet, TaskConfig

_GROUND_STEP = 1e-4
"""A lower ground is on this grid, metres, so that all machines agree."""


@dataclass(frozen=True)
class GoalConfig:
    """What goal sets follow from, besides robots, tasks and obstacles."""

    seed: int = 0
    """Seed of all goals, the same in training and evaluation."""
    tasks: tuple[TaskConfig, ...] = ()
    """Constants of tasks, at most one config of a type; other tasks have their defaults."""

    def of(self, task: str) -> TaskConfig:
        """Return the constants of a task.

        Raises:
            TaskError: If the task is unknown.
        """
        default: TaskConfig = TASKS[task].config_type()
        return next((config for config in self.tasks if config.task == task), default)

    def as_data(self, used: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
        """Return constants by task, for JSON: of morphgen's own tasks, ours, and those used."""
        names = dict.fromkeys((*TASKS.builtin, *(config.task for config in self.tasks), *used))
        return {name: asdict(self.of(name)) for name in names}


def task_configs(data: Mapping[str, Mapping[str, Any]]) -> tuple[TaskConfig, ...]:
    """Read what JSON keeps of ``GoalConfig.as_data``.

    Raises:
        TaskError: If a task is unknown.
        TypeError: If a constant is unknown.
    """
    return tuple(
        TASKS[name].config_type(
            **{k: tuple(v) if isinstance(v, list) else v for k, v in constants.items()}
        )
        for name, constants in data.items()
    )


def default_configs() -> tuple[TaskConfig, ...]:
    """Return the default constants of morphgen's own tasks."""
    return tuple(TASKS[name].config_type() for name in TASKS.builtin)


BENCHMARK = GoalConfig()


def member_with_primitives(member: Member, library: Library) -> Robot:
    """Return the robot of a split's member with fitted primitives as its collision shapes.

    Raises:
        MorphgenError: If it cannot be composed, is not the split's, or a link has no primitive.
    """
    return as_primitives(compose_member(member, library), library.folders)


def member_spec(
    member: Member,
    library: Library,
    config: GoalConfig = BENCHMARK,
    *,
    cache: Path | None = None,
    shipped: GoalSet | None = None,
) -> EnvSpec:
    """Return the specification of a split's member; see ``env_spec``."""
    robot = member_with_primitives(member, library)
    return env_spec(
        robot, member.task, config, obstacles=member.obstacles, cache=cache, shipped=shipped
    )


def env_spec(
    robot: Robot,
    task: str,
    config: GoalConfig = BENCHMARK,
    *,
    obstacles: bool = False,
    cache: Path | None = None,
    shipped: GoalSet | None = None,
) -> EnvSpec:
    """Return the specification of a robot at a task.

    Args:
        robot: The robot, with a tool.
        task: Name of the task.
        config: Seed and constants.
        obstacles: Whether there are obstacles.
        cache: Folder of stored goal sets; by default the user's.
        shipped: The goal set that a split brings, if it does.

    Raises:
        TaskError: If the task is unknown, or that set is another robot's, task's or config's.
        MorphgenError: As ``goal_set``.
    """
    kind, constants, ground = TASKS[task], config.of(task), ground_under(robot)
    if shipped is not None and not isinstance(shipped, kind.goal_set_type):
        raise TaskError(f"robot {robot.name!r}: the set that is shipped is not for {task}")
    goals = goal_set(
        robot,
        kind,
        constants,
        obstacles=obstacles,
        seed=config.seed,
        ground=ground,
        cache=cache,
        shipped=shipped,
    )
    return EnvSpec(robot, task, kind.scene(robot, goals, ground), goals, constants)


def ground_under(robot: Robot) -> float:
    """Return the height of the ground in the root frame, metres: 0, or less for low links.

    The root stands on the ground; a link that a joint moves may not be in it. A robot that is
    scaled down joint by joint, as those of ``panda_variations`` are, may have its first link there.
    """
    above, anywhere = (
        FreeSpace(Scene(robot, ground=ground)).free([robot.home])[0] for ground in (0.0, None)
    )
    if above or not anywhere:
        return 0.0
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    heights = [0.0]
    for link, T in zip(robot.links[1:], T_root_link[1:], strict=True):
        if link.collisions:
            corners = np.array(list(product(*bounding_box(link.collisions).T)))
            heights.append(float((corners @ T[2, :3] + T[2, 3]).min()))
    return math.floor(min(heights) / _GROUND_STEP) * _GROUND_STEP
