"""Goal sets of robots and of all members of a split: sampling them, and files that ship them.

goals/index.json             seed and constants of all sets, and a record of each set
goals/<side>/<name>.npz      fields of a goal set; the task determines its class

A set depends on robot, task, constants, obstacles and seed, but not on the split, the side or the
other robots, so that single- and multi-embodiment training have the same goals.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats.data_files import read_bytes, read_json
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.splits.split import Member, Side, Split, require_side, sided_members
from morphgen.tasks.goal_sets import goals_from_npz, set_npz
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import (
    GoalConfig,
    env_spec,
    member_with_primitives,
    task_configs,
)
from morphgen.tasks.task import EnvSpec, GoalSet

GOALS = "goals"  # name of the folder of goal sets in a built split
INDEX = "index.json"
FORMAT = 2


@dataclass(frozen=True, eq=False)
class GoalResult:
    """A robot's goal set, or the reason why it cannot be sampled."""

    robot: str
    side: Side | None  # side of the split; None for a robot without a split
    task: str
    obstacles: bool
    goals: GoalSet | None = None
    robot_hash: str = ""  # hash of the robot with the collision shapes that the set was made for
    error: str = ""  # reason why there is no set
    certificate_errors: tuple[str, ...] | None = None
    """Faults of goals, a line each; None if the set was not certified."""

    @property
    def acceptance(self) -> float | None:
        """Fraction of the tested candidates that became goals."""
        return self.goals.accepted / self.goals.tried if self.goals else None


@dataclass(frozen=True, eq=False)
class SplitGoals:
    """Goal sets of a split."""

    config: GoalConfig  # seed and constants that the sets were made with
    sets: Mapping[tuple[Side, str], GoalResult]
    """Results with a goal set, by side and name of the member."""


def certify_goal_set(goals: GoalSet, spec: EnvSpec) -> tuple[str, ...]:
    """Test the goals of a set among its own obstacles; return their faults, a line each."""
    scene = replace(spec.scene, obstacles=goals.obstacles)
    return tuple(TASKS[spec.task].certify(goals, spec.robot, scene))


def sample_robot_goals(
    robot: Robot,
    task: str,
    config: GoalConfig | None = None,
    *,
    obstacles: bool,
    certified: bool = False,
    cache: Path | None = None,
) -> GoalResult:
    """Sample a robot's goal set, or take it from the cache; a failure becomes ``error``."""
    result = GoalResult(robot.name, None, task, obstacles)
    try:
        spec = env_spec(robot, task, config, obstacles=obstacles, cache=cache)
        return replace(
            result,
            goals=spec.goals,
            robot_hash=robot_hash(robot, visuals=False),
            certificate_errors=certify_goal_set(spec.goals, spec) if certified else None,
        )
    except MorphgenError as error:
        return replace(result, error=str(error))


def sample_split_goals(
    split: Split,
    library: Library,
    config: GoalConfig | None = None,
    *,
    jobs: int = 1,
    certified: bool = False,
    cache: Path | None = None,
) -> list[GoalResult]:
    """Sample the goal sets of all members, train first, or take them from the cache.

    A robot without a goal set does not stop the others. An interrupted run continues from the sets
    in the cache.
    """
    sample = partial(_sample_member, library, config, certified, cache)
    return list(parallel_map(sample, sided_members(split), jobs, chunk=1))


def _sample_member(
    library: Library,
    config: GoalConfig | None,
    certified: bool,
    cache: Path | None,
    sided_member: tuple[Side, Member],
) -> GoalResult:
    """Sample the goal set of a member, in a worker process."""
    side, member = sided_member
    task, obstacles = member.task, member.obstacles
    try:
        robot = member_with_primitives(member, library)
    except MorphgenError as error:
        return GoalResult(member.name, side, task, obstacles, error=str(error))
    result = sample_robot_goals(
        robot, task, config, obstacles=obstacles, certified=certified, cache=cache
    )
    return replace(result, side=side)


def require_goal_sets(results: Sequence[GoalResult]) -> None:
    """Require that every robot has a goal set."""
    failed = [result for result in results if result.goals is None]
    if failed:
        first, *rest = failed
        more = f"; nor has {', '.join(result.robot for result in rest)}" if rest else ""
        raise BenchmarkError(
            f"{first.side} robot {first.robot} has no goal set: {first.error}{more}"
        )


def has_goals(folder: Path) -> bool:
    """Return whether a built split ships goal sets."""
    return (folder / GOALS).is_dir()


def read_goals(folder: str | Path, side: Side) -> dict[str, GoalSet]:
    """Return the goal sets of one side of a built split, by the names of its members."""
    require_side(side)
    sets = read_split_goals(folder).sets
    return {
        name: result.goals
        for (result_side, name), result in sets.items()
        if result_side == side and result.goals
    }


def shipped_goal_set(
    sets: Mapping[str, GoalSet] | None, robot: str, folder: str | Path | None
) -> GoalSet | None:
    """Return a robot's goal set among those that a folder ships; None if ``sets`` is None."""
    if sets is None:
        return None
    if robot not in sets:
        raise BenchmarkError(
            f"{folder}: ships no goal set for robot {robot!r}; it is of another split"
        )
    return sets[robot]


def read_split_goals(folder: str | Path) -> SplitGoals:
    """Return all goal sets of a built split with the config that made them; see ``read_goals``."""
    folder = Path(folder) / GOALS
    path = folder / INDEX
    if not path.is_file():
        raise BenchmarkError(f"{path}: no such file; morphgen split build --goals makes goal sets")
    try:
        return _parse_index(read_json(path), folder)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BenchmarkError(f"{path}: not an index of goal sets: {error!r}") from error


def _parse_index(index: Mapping[str, Any], folder: Path) -> SplitGoals:
    """Return the goal sets that the index of a folder lists."""
    if index["format"] != FORMAT:
        raise BenchmarkError(
            f"{folder / INDEX}: format {index['format']!r}; this version reads {FORMAT}: build the "
            "goal sets again with morphgen split build --goals"
        )
    for record in index["sets"]:  # not all tasks: some may be newer than the index
        index[record["task"]]  # a KeyError if it is missing
    constants = {key: index[key] for key in index if key not in ("format", "seed", "sets")}
    config = GoalConfig(int(index["seed"]), task_configs(constants))
    results = [_read_set(folder, record) for record in index["sets"]]
    return SplitGoals(config, {(r.side, r.robot): r for r in results if r.side})


def _read_set(folder: Path, record: Mapping[str, Any]) -> GoalResult:
    """Read the goal set of a record in the index, and compare its checksum."""
    path = folder / record["file"]
    content = read_bytes(path)
    if _sha256(content) != record["sha256"]:
        raise BenchmarkError(f"{path} is not the file that {INDEX} was written for")
    goals = goals_from_npz(content, record["task"], path)
    facts = {key: record[key] for key in ("robot", "side", "task", "obstacles")}
    return GoalResult(**facts, robot_hash=record["body"], goals=goals)


def goal_files(results: Sequence[GoalResult], config: GoalConfig) -> Iterator[tuple[str, bytes]]:
    """Yield the files of goal sets: paths in their folder, and contents."""
    records = []
    for result in results:
        assert result.goals is not None
        name = f"{result.side}/{result.robot}.npz"
        content = set_npz(result.goals)
        records.append(goal_record(result) | {"file": name, "sha256": _sha256(content)})
        yield name, content
    task_names = [result.task for result in results]
    tasks = config.as_data(task_names)
    constants = {"format": FORMAT, "seed": config.seed, **tasks}
    head_text = json.dumps(constants, indent=2).removesuffix("\n}")
    lines = ",\n".join(f"    {json.dumps(record)}" for record in records)
    yield INDEX, f'{head_text},\n  "sets": [\n{lines}\n  ]\n}}\n'.encode()


def goal_record(result: GoalResult) -> dict[str, object]:
    """Return a result as JSON data, without the goals themselves."""
    keys = ("robot", "side", "task", "obstacles")
    record: dict[str, object] = {key: getattr(result, key) for key in keys}
    if result.goals is None:
        return record
    return record | {
        "body": result.robot_hash,
        "key": result.goals.key,
        "seed": result.goals.seed,
        "goals": len(result.goals.q),
        "tried": result.goals.tried,
        "accepted": result.goals.accepted,
        "acceptance": result.acceptance,
    }


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
