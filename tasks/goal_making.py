"""Goal sets of robots and of all members of a split, each made once and kept in the cache.

A set follows from the body, the task with its constants, whether there are obstacles, and the seed;
not from the split, the side, or the robots beside it. So single- and multi-embodiment training
have the same goals.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from morphgen.benchmark.contents import sided
from morphgen.benchmark.split import Member, Side, Split, Task, robot_hash
from morphgen.errors import MorphgenError
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, mapped, unseen
from morphgen.tasks.goal_npz import Goals
from morphgen.tasks.goals import GoalSet, certify
from morphgen.tasks.push_certificate import certify_pushes
from morphgen.tasks.settings import BENCHMARK, Recipe, Setting, member_body, setting_of


@dataclass(frozen=True, eq=False)
class Made:
    """A robot's goal set, or why there is none."""

    robot: str
    side: Side | None
    """None for a robot of no split."""
    task: Task
    obstacles: bool
    goals: Goals | None = None
    body: str = ""
    """Hash of the body with the shapes that the set was made for."""
    why: str = ""
    """Why there is no set."""
    unproven: tuple[str, ...] | None = None
    """What is wrong with goals, a line each; None if nobody looked."""

    @property
    def acceptance(self) -> float | None:
        """Share of the configurations tried that are free."""
        return self.goals.accepted / self.goals.tried if self.goals else None


@dataclass(frozen=True, eq=False)
class SplitGoals:
    """Goal sets of a split."""

    recipe: Recipe
    sets: Mapping[tuple[Side, str], Made]
    """By side and name of the member; those that there are."""

    def of(self, side: Side, name: str) -> Goals | None:
        """A member's set, if there is one."""
        made = self.sets.get((side, name))
        return made.goals if made else None


def gathered(made: Sequence[Made], recipe: Recipe) -> SplitGoals:
    """What was made of a split; robots without a set are left out."""
    return SplitGoals(
        recipe, {(one.side, one.robot): one for one in made if one.side and one.goals}
    )


def goals_of(setting: Setting) -> Goals:
    """The set of a setting, whichever its task."""
    goals = setting.goals if setting.task == "reach" else setting.pushes
    if goals is None:
        raise ValueError(f"the setting of {setting.robot.name} has no set for {setting.task}")
    return goals


def unproven(goals: Goals, setting: Setting) -> tuple[str, ...]:
    """What is wrong with goals among their own obstacles, a line each; see ``certify``."""
    scene = replace(setting.scene, obstacles=goals.obstacles)
    if isinstance(goals, GoalSet):
        return tuple(certify(goals, setting.robot, scene))
    return tuple(certify_pushes(goals, setting.robot, scene))


def robot_goals(
    robot: Robot,
    task: Task,
    recipe: Recipe = BENCHMARK,
    *,
    obstacles: bool,
    certified: bool = False,
    cache: Path | None = None,
) -> Made:
    """The goal set of a robot, as it is; one that cannot be had is no error, but says why.

    Args:
        robot: The body.
        task: What it does.
        recipe: Seed and constants.
        obstacles: Whether there are any.
        certified: Whether every goal is tested with its witness.
        cache: Folder of stored sets; by default the user's.
    """
    made = Made(robot.name, None, task, obstacles)
    try:
        setting = setting_of(robot, task, recipe, obstacles=obstacles, cache=cache)
        goals = goals_of(setting)
        lines = unproven(goals, setting) if certified else None
        return replace(made, goals=goals, body=robot_hash(robot, visuals=False), unproven=lines)
    except MorphgenError as error:
        return replace(made, why=str(error))


def split_goals(
    split: Split,
    library: Library,
    recipe: Recipe = BENCHMARK,
    *,
    jobs: int = 1,
    certified: bool = False,
    cache: Path | None = None,
    progress: Progress = unseen,
) -> list[Made]:
    """Make the goal sets of all members, or take them from the cache; train first.

    A robot that has none does not stop the others. What is interrupted goes on where it was, as
    far as the cache has the sets.

    Args:
        split: The split.
        library: Where its parts are.
        recipe: Seed and constants.
        jobs: Processes.
        certified: Whether every goal is tested with its witness.
        cache: Folder of stored sets; by default the user's.
        progress: Told how many robots are done, again and again.

    Raises:
        MorphgenError: If ``jobs`` is below 1, or a process died.
    """
    maker = _Maker(library.folders, recipe, certified, cache)
    return list(mapped(maker, sided(split), jobs, progress, chunk=1))


@dataclass(frozen=True, eq=False)
class _Maker:
    """How a worker makes a set."""

    folders: tuple[Path, ...]
    recipe: Recipe
    certified: bool
    cache: Path | None

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, sided_member: tuple[Side, Member]) -> Made:
        side, member = sided_member
        try:
            robot = member_body(member, self.library)
        except MorphgenError as error:
            return Made(member.name, side, member.task, member.obstacles, why=str(error))
        made = robot_goals(
            robot,
            member.task,
            self.recipe,
            obstacles=member.obstacles,
            certified=self.certified,
            cache=self.cache,
        )
        return replace(made, side=side)
