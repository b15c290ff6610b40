"""What agents are trained and tested on: the robots of a split, or one robot."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

from morphgen.benchmark.split import Member, Side, Split, member_robot, robot_hash
from morphgen.benchmark.split_file import split_text
from morphgen.benchmark.split_reader import parse_split
from morphgen.benchmark.token_layout import require_max_links
from morphgen.errors import BenchmarkError, TaskError, nearest
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import is_robot_file
from morphgen.tasks.env_specs import GoalConfig, env_spec, member_spec
from morphgen.tasks.robots import robot_of
from morphgen.tasks.split_goals import read_goals, shipped_set
from morphgen.tasks.task import EnvSpec, GoalSet


@dataclass(frozen=True)
class Source:
    """Robots at tasks, told in text alone, so that a run's folder says all of them."""

    name: str
    """Of the split, or words of the robot, or the path of its file."""
    split: str = ""
    """Text of the split's file; empty for one robot."""
    task: str | None = None
    """Of the one robot; a split says it of each."""
    obstacles: bool = False
    """Of the one robot."""
    side: Side = "train"
    """Of the split."""
    body: str = ""
    """Hash of the one robot, empty in runs of before it was kept; a split has that of each."""
    only: str | None = None
    """The one member that is meant, if it is not all of the side."""
    goal_seed: int = 0
    """Of goals, starts and obstacles."""
    goals: str = ""
    """The folder where the split is built with the goal sets that are meant; or they are drawn."""
    library: tuple[str, ...] = ()
    """Folders of own parts."""


def split_source(
    split: Split,
    *,
    goal_seed: int = 0,
    goals: Path | None = None,
    library: tuple[Path, ...] = (),
    side: Side = "train",
) -> Source:
    """The robots of a side of a split; ``goals`` is the folder where it is built with its sets."""
    return Source(
        split.name,
        split_text(split),
        side=side,
        goal_seed=goal_seed,
        goals=str(goals.resolve()) if goals is not None else "",
        library=tuple(str(folder.resolve()) for folder in library),
    )


def robot_source(
    robot: str,
    task: str,
    *,
    obstacles: bool = False,
    goal_seed: int = 0,
    library: tuple[Path, ...] = (),
) -> Source:
    """One robot, which is whatever ``morphgen.tasks.robots.robot_of`` knows.

    Raises:
        MorphgenError: As ``robot_of``.
    """
    return Source(
        str(Path(robot).resolve()) if is_robot_file(robot) else robot,
        task=task,
        obstacles=obstacles,
        body=robot_hash(robot_of(robot, library=library)),
        goal_seed=goal_seed,
        library=tuple(str(folder.resolve()) for folder in library),
    )


def members(source: Source) -> tuple[Member, ...]:
    """The split's members that are meant; none for one robot.

    Raises:
        BenchmarkError: If the split has no such member, or its text is malformed.
    """
    if not source.split:
        return ()
    side = parse_split(source.split, Path(source.name)).split.side(source.side)
    if source.only is None:
        return side
    names = [member.name for member in side]
    if source.only not in names:
        raise BenchmarkError(
            f"split {source.name!r} has no {source.side} robot {source.only!r}"
            f"{nearest(source.only, names)}"
        )
    return tuple(member for member in side if member.name == source.only)


def tasks_of(source: Source) -> tuple[str, ...]:
    """The tasks of its robots, without repetition."""
    if source.task is not None:
        return (source.task,)
    return tuple(dict.fromkeys(member.task for member in members(source)))


def apart(source: Source) -> Iterator[Source]:
    """A source for each robot of a split's side."""
    for member in members(source):
        yield replace(source, only=member.name)


def other_side(source: Source, side: Side) -> Source:
    """The same split's whole side.

    Raises:
        TaskError: If it is one robot, which has no other side.
    """
    if source.split:
        return replace(source, side=side, only=None)
    if side == "test":
        raise TaskError(f"{source.name!r} is one robot, no split: there is nothing to test on")
    return source


@lru_cache(maxsize=64)
def most_obstacles(source: Source, config: GoalConfig) -> int:
    """Return how many obstacles the one robot has, or at most a robot of the split, either side.

    Args:
        source: The robot or split.
        config: Constants of the tasks.
    """
    if source.task is not None:
        return config.of(source.task).obstacles if source.obstacles else 0
    sides: tuple[Side, ...] = ("train", "test")
    both = (member for side in sides for member in members(other_side(source, side)))
    return max((config.of(member.task).obstacles for member in both if member.obstacles), default=0)


def require_links(source: Source, max_links: int) -> None:
    """Require that what is trained on one side of a split can be tested on the other.

    Raises:
        BenchmarkError: If a robot there has more links.
        MorphgenError: If it cannot be made.
    """
    if not source.split:
        return
    library = default_library(tuple(map(Path, source.library)))
    side: Side = "test" if source.side == "train" else "train"
    for member in members(other_side(source, side)):
        links = len(member_robot(member, library).links)
        require_max_links(links, f"{side} robot {member.name!r}", max_links)


def specs_of(source: Source, config: GoalConfig) -> list[EnvSpec]:
    """The robots at their tasks; they are made once in a process.

    Args:
        source: Which.
        config: Constants of the tasks; the seed is the source's.

    Raises:
        MorphgenError: If a robot cannot be made, is not the split's, or cannot do its task.
    """
    config = replace(config, seed=source.goal_seed)
    if source.split:
        own = replace(source, split="", only=None)
        return [_of_member(member, own, config) for member in members(source)]
    if source.task is None:
        raise TaskError(f"{source.name!r}: neither a split nor a robot with a task")
    robot = robot_of(source.name, library=map(Path, source.library))
    if source.body not in ("", robot_hash(robot)):
        raise TaskError(f"{source.name}: it is not the body that it was when the run began")
    return [env_spec(robot, source.task, config, obstacles=source.obstacles)]


@lru_cache(maxsize=64)
def _of_member(member: Member, source: Source, config: GoalConfig) -> EnvSpec:
    sets = _shipped(source.goals, source.side) if source.goals else None
    shipped = shipped_set(sets, member.name, source.goals)
    library = default_library(tuple(map(Path, source.library)))
    return member_spec(member, library, config, shipped=shipped)


@lru_cache(maxsize=2)
def _shipped(folder: str, side: Side) -> dict[str, GoalSet]:
    return read_goals(folder, side)
