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

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.split import Member, Side, Split, sided_members
from morphgen.errors import MorphgenError
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, mapped, unseen
from morphgen.tasks.env_specs import BENCHMARK, GoalConfig, env_spec, member_with_primitives
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import EnvSpec, GoalSet


@dataclass(frozen=True, eq=False)
class Made:
    """A robot's goal set, or why there is none."""

    robot: str
    side: Side | None
    """None for a robot of no split."""
    task: str
    obstacles: bool
    goals: GoalSet | None = None
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

    config: GoalConfig
    sets: Mapping[tuple[Side, str], Made]
    """By side and name of the member; those that there are."""

    def of(self, side: Side, name: str) -> GoalSet | None:
        """A member's set, if there is one."""
        made = self.sets.get((side, name))
        return made.goals if made else None


def gathered(made: Sequence[Made], config: GoalConfig) -> SplitGoals:
    """What was made of a split; robots without a set are left out."""
    return SplitGoals(
        config, {(one.side, one.robot): one for one in made if one.side and one.goals}
    )


def unproven(goals: GoalSet, spec: EnvSpec) -> tuple[str, ...]:
    """Return what is wrong with goals among their own obstacles, a line each."""
    scene = replace(spec.scene, obstacles=goals.obstacles)
    return tuple(TASKS[spec.task].certify(goals, spec.robot, scene))


def robot_goals(
    robot: Robot,
    task: str,
    config: GoalConfig = BENCHMARK,
    *,
    obstacles: bool,
    certified: bool = False,
    cache: Path | None = None,
) -> Made:
    """The goal set of a robot, as it is; one that cannot be had is no error, but says why.

    Args:
        robot: The body.
        task: What it does.
        config: Seed and constants.
        obstacles: Whether there are any.
        certified: Whether every goal is tested with its configuration.
        cache: Folder of stored sets; by default the user's.
    """
    made = Made(robot.name, None, task, obstacles)
    try:
        spec = env_spec(robot, task, config, obstacles=obstacles, cache=cache)
        lines = unproven(spec.goals, spec) if certified else None
        return replace(
            made, goals=spec.goals, body=robot_hash(robot, visuals=False), unproven=lines
        )
    except MorphgenError as error:
        return replace(made, why=str(error))


def split_goals(
    split: Split,
    library: Library,
    config: GoalConfig = BENCHMARK,
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
        config: Seed and constants.
        jobs: Processes.
        certified: Whether every goal is tested with its configuration.
        cache: Folder of stored sets; by default the user's.
        progress: Told how many robots are done, again and again.

    Raises:
        MorphgenError: If ``jobs`` is below 1, or a process died.
    """
    maker = _Maker(library.folders, config, certified, cache)
    return list(mapped(maker, sided_members(split), jobs, progress, chunk=1))


@dataclass(frozen=True, eq=False)
class _Maker:
    """How a worker makes a set."""

    folders: tuple[Path, ...]
    config: GoalConfig
    certified: bool
    cache: Path | None

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, sided_member: tuple[Side, Member]) -> Made:
        side, member = sided_member
        try:
            robot = member_with_primitives(member, self.library)
        except MorphgenError as error:
            return Made(member.name, side, member.task, member.obstacles, why=str(error))
        made = robot_goals(
            robot,
            member.task,
            self.config,
            obstacles=member.obstacles,
            certified=self.certified,
            cache=self.cache,
        )
        return replace(made, side=side)
