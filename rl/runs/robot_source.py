"""Sources of robots for training and evaluation: a split, one robot, or robots of grammars."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.split import Member, Side, Split, compose_member, split_id
from morphgen.benchmark.split_file import parse_split, read_split, split_text
from morphgen.benchmark.tokens import require_max_links
from morphgen.errors import BenchmarkError, TaskError, nearest
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import is_robot_file
from morphgen.progress import own_progress, show_progress
from morphgen.tasks.goals.split_goals import read_goals, shipped_goal_set
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, load_robot, member_spec
from morphgen.tasks.task import EnvSpec, GoalSet


@dataclass(frozen=True)
class RobotSource:
    """Robots with their tasks, described by text alone, so that a run's folder describes them."""

    name: str
    """Name of the split, or words that describe one robot, or the path of its file, or the grammars
    with the number of robots of each."""
    split: str = ""
    """Text of the split's file; empty without a split."""
    task: str | None = None
    """Task of all robots; None for a split, which has a task for each of them."""
    obstacles: bool = False
    """Whether the robots are among obstacles; a split says it for each of them."""
    side: Side = "train"
    """Side of the split."""
    robot_hash: str = ""
    """Hash of the one robot; empty with a split, which has one for each."""
    member: str | None = None
    """Name of the only member that is meant; None for all of the side."""
    goal_seed: int = 0
    """Seed of goals, starts and obstacles."""
    goal_dir: str = ""
    """Folder where the split is built with the goal sets to use; without it goals are sampled."""
    library: tuple[str, ...] = ()
    """Folders with further parts."""
    grammars: tuple[tuple[str, int], ...] = ()
    """Grammars, by name or path, and the number of robots to draw from each; see
    ``morphgen.rl.runs.drawn_robots``."""
    draw_seed: int = 0
    """Seed of the drawn robots: they are those of ``morphgen sample --seed``."""
    held_out: tuple[str, ...] = ()
    """Splits whose test robots are not drawn, besides the splits that morphgen ships."""
    drawn_hash: str = ""
    """Hash of the drawn robots; empty until they are drawn."""


def split_source(
    split: Split,
    *,
    goal_seed: int = 0,
    goals: Path | None = None,
    library: tuple[Path, ...] = (),
    side: Side = "train",
) -> RobotSource:
    """Return the robots of a side of a split; ``goals`` is the folder with its goal sets."""
    return RobotSource(
        split.name,
        split_text(split),
        side=side,
        goal_seed=goal_seed,
        goal_dir=str(goals.resolve()) if goals is not None else "",
        library=tuple(str(folder.resolve()) for folder in library),
    )


def robot_source(
    robot: str,
    task: str,
    *,
    obstacles: bool = False,
    goal_seed: int = 0,
    library: tuple[Path, ...] = (),
) -> RobotSource:
    """Return one robot, named in any way that ``load_robot`` of ``env_specs`` reads."""
    return RobotSource(
        str(Path(robot).resolve()) if is_robot_file(robot) else robot,
        task=task,
        obstacles=obstacles,
        robot_hash=robot_hash(load_robot(robot, library=library)),
        goal_seed=goal_seed,
        library=tuple(str(folder.resolve()) for folder in library),
    )


def split_of(source: RobotSource) -> Split:
    """Return the split of a source that has one."""
    return parse_split(source.split, Path(source.name)).split


def members(source: RobotSource) -> tuple[Member, ...]:
    """Return the members of the split that are meant; none for one robot."""
    if not source.split:
        return ()
    side = split_of(source).side(source.side)
    if source.member is None:
        return side
    names = [member.name for member in side]
    if source.member not in names:
        raise BenchmarkError(
            f"split {source.name!r} has no {source.side} robot {source.member!r}"
            f"{nearest(source.member, names)}"
        )
    return tuple(member for member in side if member.name == source.member)


def identity(source: RobotSource) -> dict[str, Any]:
    """Return the entries of a source that results depend on: of a split its id, not its text.

    The text also has the version of morphgen that wrote it.
    """
    text = source.split and split_id(split_of(source))
    return asdict(source) | {"split": text}


def tasks_of(source: RobotSource) -> tuple[str, ...]:
    """Return the tasks of the robots, without repetition."""
    if source.task is not None:
        return (source.task,)
    return tuple(dict.fromkeys(member.task for member in members(source)))


def single_members(source: RobotSource) -> Iterator[RobotSource]:
    """Yield a source for each robot of a split's side."""
    for member in members(source):
        yield replace(source, member=member.name)


def other_side(source: RobotSource, side: Side) -> RobotSource:
    """Return a whole side of the same split."""
    if source.split:
        return replace(source, side=side, member=None)
    if side == "test" and source.grammars:
        raise _without_sides(source)
    if side == "test":
        raise TaskError(f"{source.name!r} is one robot and not a split: it has no test robots")
    return source


@lru_cache(maxsize=64)
def most_obstacles(source: RobotSource, config: GoalConfig) -> int:
    """Return the largest number of obstacles of any robot, on both sides of the split."""
    if source.task is not None:
        return config.task_config(source.task).obstacles if source.obstacles else 0
    sides: tuple[Side, ...] = ("train", "test")
    both = (member for side in sides for member in members(other_side(source, side)))
    return max(
        (config.task_config(member.task).obstacles for member in both if member.obstacles),
        default=0,
    )


def require_links(source: RobotSource, max_links: int) -> None:
    """Require that a policy can be tested on the other side of a split, or on held-out robots."""
    side: Side = "test" if source.side == "train" else "train"
    others = members(other_side(source, side)) if source.split else ()
    held_out = (member for name in source.held_out for member in read_split(name).test)
    library = default_library(tuple(map(Path, source.library)))
    for member in (*others, *held_out):
        links = len(compose_member(member, library).links)
        require_max_links(links, f"{side} robot {member.name!r}", max_links)


def specs_of(source: RobotSource, config: GoalConfig) -> list[EnvSpec]:
    """Return the robots with their tasks and scenes; each is built once per process."""
    if source.grammars:
        raise _without_sides(source)
    config = replace(config, seed=source.goal_seed)
    if source.split:
        own, meant = replace(source, split="", member=None), members(source)
        specs: list[EnvSpec] = []
        with own_progress() as show:
            for member in meant:
                show(len(specs), len(meant))
                specs.append(_of_member(member, own, config))
            show(len(specs), len(meant))
        return specs
    if source.task is None:
        raise TaskError(f"{source.name!r}: neither a split nor a robot with a task")
    with show_progress(None):
        robot = load_robot(source.name, library=map(Path, source.library))
    if source.robot_hash not in ("", robot_hash(robot)):
        raise TaskError(f"{source.name}: the robot has changed since the run began")
    return [env_spec(robot, source.task, config, obstacles=source.obstacles)]


def _without_sides(source: RobotSource) -> TaskError:
    return TaskError(
        f"the training robots {source.name} are drawn from grammars and have no test side: name "
        "other robots with --split"
    )


@lru_cache(maxsize=64)
def _of_member(member: Member, source: RobotSource, config: GoalConfig) -> EnvSpec:
    sets = _shipped(source.goal_dir, source.side) if source.goal_dir else None
    shipped = shipped_goal_set(sets, member.name, source.goal_dir)
    library = default_library(tuple(map(Path, source.library)))
    return member_spec(member, library, config, shipped=shipped)


@lru_cache(maxsize=2)
def _shipped(folder: str, side: Side) -> dict[str, GoalSet]:
    return read_goals(folder, side)
