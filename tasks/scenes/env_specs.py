"""Environment specifications: robots at tasks, with their scenes and goal sets."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Any

import numpy as np

from morphgen.errors import TaskError, nearest, truth, whole_number
from morphgen.fitting.replace_collision import as_primitives
from morphgen.grammar.library import Library, LibraryFolders, default_library
from morphgen.grammar.robot_source import RobotLike, resolve_robot
from morphgen.model.inertia import bounding_box, box_corners
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot
from morphgen.splits.split import Member, compose_member
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goal_sets import goal_set
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import EnvSpec, GoalSet, TaskConfig

GROUND_STEP = 1e-4  # resolution of the height of a lowered ground, so that all machines agree [m]
IN_EVERY_FILE = ("reach", "push")
"""Tasks whose constants files of splits and runs have, whatever tasks they are about."""


@dataclass(frozen=True)
class GoalConfig:
    """Seed and constants of tasks, from which goal sets are sampled."""

    seed: int = 0  # seed of all goals, the same in training and evaluation
    tasks: Sequence[TaskConfig] = ()
    """Constants of tasks, at most one config of a type; other tasks have their defaults."""

    def __post_init__(self) -> None:
        if not isinstance(self.tasks, Sequence):
            raise TaskError(f"configs {self.tasks!r}: expected a list")
        object.__setattr__(self, "tasks", tuple(self.tasks))
        object.__setattr__(self, "seed", whole_number("goal seed", self.seed, TaskError, 0))
        for config in self.tasks:
            if (task := getattr(config, "task", None)) not in TASKS:
                what = f"{type(config).__name__}: its task {task!r}"
                raise TaskError(f"config {what} is unknown{nearest(str(task), TASKS)}")

    def task_config(self, task: str) -> TaskConfig:
        """Return the constants of a task."""
        default: TaskConfig = TASKS[task].config_type()
        return next((config for config in self.tasks if config.task == task), default)

    def as_data(self, used: Sequence[str] = ()) -> dict[str, dict[str, Any]]:
        """Return the constants by task as JSON data, which ``task_configs`` reads."""
        data = {}
        for name in dict.fromkeys((*IN_EVERY_FILE, *(c.task for c in self.tasks), *used)):
            config = self.task_config(name)
            keys, constants = config.file_keys, asdict(config)
            data[name] = {keys.get(field, field): value for field, value in constants.items()}
        return data


def config_fields(task: str, constants: Mapping[str, Any]) -> dict[str, Any]:
    """Return a task's constants from a file by the names of the fields of its config."""
    fields = {key: field for field, key in TASKS[task].config_type.file_keys.items()}
    return {fields.get(key, key): value for key, value in constants.items()}


def task_configs(data: Mapping[str, Mapping[str, Any]]) -> tuple[TaskConfig, ...]:
    """Read the JSON data of ``GoalConfig.as_data``."""
    configs = []
    for name, constants in data.items():
        values = config_fields(name, constants)
        values = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        configs.append(TASKS[name].config_type(**values))
    return tuple(configs)


def default_configs() -> tuple[TaskConfig, ...]:
    """Return the default constants of the tasks that every file has."""
    return tuple(TASKS[name].config_type() for name in IN_EVERY_FILE)


def load_robot(source: RobotLike, library: LibraryFolders = ()) -> Robot:
    """Return the robot that a user names, with fitted primitives as its collision shapes.

    A robot has the same goals and scores whether it is named by words, by its bundle, by the
    bundle's URDF, or passed as ``morphgen.compose`` or ``morphgen.read`` returns it.
    """
    parts = default_library(library)
    return as_primitives(resolve_robot(source, parts), parts.folders)


def member_with_primitives(member: Member, library: Library) -> Robot:
    """Return the robot of a split's member with fitted primitives as its collision shapes."""
    return as_primitives(compose_member(member, library), library.folders)


def member_spec(
    member: Member,
    library: Library,
    config: GoalConfig | None = None,
    *,
    cache: str | PathLike[str] | None = None,
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
    config: GoalConfig | None = None,
    *,
    obstacles: bool = False,
    cache: str | PathLike[str] | None = None,
    shipped: GoalSet | None = None,
    anew: bool = False,
) -> EnvSpec:
    """Return the specification of a robot at a task, whose goal set is sampled if not stored."""
    config = config or GoalConfig()
    obstacles = truth("obstacles", obstacles, TaskError)
    kind, constants, ground = TASKS[task], config.task_config(task), ground_under(robot)
    if shipped is not None and not isinstance(shipped, kind.goal_set_type):
        raise TaskError(f"robot {robot.name!r}: the shipped goal set is not for task {task}")
    goals = goal_set(
        robot,
        kind,
        constants,
        obstacles=obstacles,
        seed=config.seed,
        ground=ground,
        cache=cache,
        shipped=shipped,
        anew=anew,
    )
    return EnvSpec(robot, task, kind.scene(robot, goals, ground), goals, constants)


def ground_under(robot: Robot) -> float:
    """Return the height of the ground in the root frame: 0, or below links that reach lower [m].

    The root stands on the ground, but movable links must not penetrate it at home. Robots that are
    scaled down joint by joint, such as those of ``panda_variations``, may have their first link
    below their root.
    """
    free_above_ground, free_without = (
        FreeSpace(Scene(robot, ground=ground)).free([robot.home])[0] for ground in (0.0, None)
    )
    if free_above_ground or not free_without:  # lowering helps no robot that collides with itself
        return 0.0
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    heights = [0.0]
    for link, T in zip(robot.links[1:], T_root_link[1:], strict=True):
        if link.collisions:
            corners = box_corners(*bounding_box(link.collisions))
            heights.append(float((corners @ T[2, :3] + T[2, 3]).min()))
    return math.floor(min(heights) / GROUND_STEP) * GROUND_STEP  # part of the key of a goal set
