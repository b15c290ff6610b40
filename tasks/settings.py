"""Settings: a robot at a task, and all that its episodes have in common."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TypedDict

import numpy as np

from morphgen.benchmark.split import Member, Task, member_robot
from morphgen.errors import TaskError
from morphgen.fitting.replace_collision import as_primitives
from morphgen.grammar.library import Library
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot
from morphgen.tasks.config import PushConfig, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goals import GoalSet, goal_set
from morphgen.tasks.push_sets import PushSet, push_set
from morphgen.tasks.sim.base import Scene

_GROUND_STEP = 1e-4
"""A lower ground is on this grid, metres, so that all machines agree."""
SEED = 0
"""Of the goals of a benchmark, unless it says otherwise: the same in training and evaluation."""


@dataclass(frozen=True)
class Recipe:
    """What goal sets follow from, besides the bodies, tasks and obstacles."""

    seed: int = SEED
    reach: ReachConfig = field(default_factory=ReachConfig)
    push: PushConfig = field(default_factory=PushConfig)


BENCHMARK = Recipe()


class _Own(TypedDict):
    obstacles: bool
    seed: int
    cache: Path | None


@dataclass(frozen=True, eq=False)
class Setting:
    """A robot at a task; one of ``goals`` and ``pushes`` is there."""

    robot: Robot
    task: Task
    scene: Scene
    """With its ground, obstacles, and block; the robot stands at the origin."""
    goals: GoalSet | None = None
    pushes: PushSet | None = None


def member_body(member: Member, library: Library) -> Robot:
    """The robot of a member with fitted primitives as its collision shapes, as tasks have it.

    Raises:
        MorphgenError: If it cannot be composed, is not the split's, or a link has no primitive.
    """
    return as_primitives(member_robot(member, library), library.folders)


def member_setting(
    member: Member,
    library: Library,
    recipe: Recipe = BENCHMARK,
    *,
    cache: Path | None = None,
    shipped: GoalSet | PushSet | None = None,
) -> Setting:
    """The robot of a member at its task; see ``member_body`` and ``setting_of``."""
    robot = member_body(member, library)
    return setting_of(
        robot, member.task, recipe, obstacles=member.obstacles, cache=cache, shipped=shipped
    )


def setting_of(
    robot: Robot,
    task: Task,
    recipe: Recipe,
    *,
    obstacles: bool,
    cache: Path | None = None,
    shipped: GoalSet | PushSet | None = None,
) -> Setting:
    """A robot at a task.

    Args:
        robot: The body.
        task: What it does.
        recipe: Seed and constants.
        obstacles: Whether there are any.
        cache: Folder of stored sets; by default the user's.
        shipped: The set that a split brings, if it does.

    Raises:
        TaskError: If that set is another robot's, task's or recipe's.
        MorphgenError: As ``goal_set`` and ``push_set``.
    """
    own: _Own = {"obstacles": obstacles, "seed": recipe.seed, "cache": cache}
    if task == "reach" and (shipped is None or isinstance(shipped, GoalSet)):
        return reach_setting(robot, recipe.reach, **own, shipped=shipped)
    if task == "push" and (shipped is None or isinstance(shipped, PushSet)):
        return push_setting(robot, recipe.push, **own, shipped=shipped)
    raise TaskError(f"robot {robot.name!r}: the set that is shipped is not for {task}")


def reach_setting(
    robot: Robot,
    config: ReachConfig,
    *,
    obstacles: bool,
    seed: int,
    cache: Path | None = None,
    shipped: GoalSet | None = None,
) -> Setting:
    """A robot that reaches for the goals of its set; see ``goal_set``."""
    ground = ground_under(robot)
    goals = goal_set(
        robot, config, obstacles=obstacles, seed=seed, ground=ground, cache=cache, shipped=shipped
    )
    return Setting(robot, "reach", Scene(robot, obstacles=goals.obstacles, ground=ground), goals)


def push_setting(
    robot: Robot,
    config: PushConfig,
    *,
    obstacles: bool,
    seed: int,
    cache: Path | None = None,
    shipped: PushSet | None = None,
) -> Setting:
    """A robot that pushes the block of its set; see ``push_set``."""
    ground = ground_under(robot)
    pushes = push_set(
        robot, config, obstacles=obstacles, seed=seed, ground=ground, cache=cache, shipped=shipped
    )
    scene = Scene(robot, block=pushes.block, obstacles=pushes.obstacles, ground=ground)
    return Setting(robot, "push", scene, pushes=pushes)


def ground_under(robot: Robot) -> float:
    """Height of the ground in the root frame, metres: 0, or less if links are lower at home.

    The root stands on the ground; a link that a joint moves may not be in it. A body that is scaled
    down joint by joint, as those of ``panda_variations`` are, may have its first link there.
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
