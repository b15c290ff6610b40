"""How policies are evaluated for the scores of a release, so that scores can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from morphgen.errors import BenchmarkError, MorphgenError, TaskError, nearest
from morphgen.grammar.library import Library
from morphgen.model.kinematics import reach
from morphgen.processes import parallel_map
from morphgen.splits.split import Member, Side, Split, sided_members
from morphgen.tasks.goals.goal_sets import goal_set_key
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import (
    GoalConfig,
    ground_under,
    member_with_primitives,
    task_configs,
)

SIMULATOR = "mujoco"  # default simulator: the one that every installation has
EPISODES = 34  # default number of episodes per robot: 10,000 control steps


@dataclass(frozen=True)
class EvalProtocol:
    """Rules of an evaluation."""

    simulator: str = SIMULATOR
    episodes: int = EPISODES  # minimum number of episodes per robot
    seed: int = 0  # seed of the episodes
    goals: GoalConfig = field(default_factory=GoalConfig)
    """Seed of the goals, and constants of the tasks."""

    def __post_init__(self) -> None:
        """Check the simulator and the numbers."""
        valid = [name for name in SIMULATORS.builtin if name not in ("kinematic", "warp")]
        if self.simulator not in valid:
            raise BenchmarkError(
                f"simulator {self.simulator!r}: no simulator with contacts that comes with morphgen"
                f"{nearest(self.simulator, valid)}"
            )
        numbers = (self.episodes, self.seed)
        is_whole = all(type(number) is int for number in numbers)
        if not (is_whole and 1 <= self.episodes <= 10_000 and 0 <= self.seed < 2**63):
            raise BenchmarkError(
                f"{self.episodes} episodes of seed {self.seed}: expected 1 to 10000 episodes, and "
                "a seed of 0 or more, both whole numbers"
            )

    def as_data(self, split: Split) -> dict[str, Any]:
        """Return the rules as JSON data, with the constants of the split's tasks."""
        return rules_data(self.simulator, self.episodes, self.seed, self.goals, split)


@dataclass(frozen=True)
class ExpectedRobot:
    """A robot of a split whose episodes a submission must hold."""

    side: Side
    member: Member
    goal_set: str  # key of the goal set
    reach: float  # reach [m]


def rules_data(
    simulator: str, episodes: int, seed: int, goals: GoalConfig, split: Split
) -> dict[str, Any]:
    """Return rules as JSON data, also of an evaluation in a simulator of another package."""
    tasks = tasks_of_split(split)
    constants = goals.as_data(tasks)
    return {
        "simulator": simulator,
        "episodes": episodes,
        "seed": seed,
        "goal_seed": goals.seed,
        "constants": {task: _plain(constants[task]) for task in tasks},
    }


def protocol_from(data: Mapping[str, Any], where: str) -> EvalProtocol:
    """Read what ``EvalProtocol.as_data`` returned."""
    try:
        rules = dict(data)
        constants = rules.pop("constants")
        goals = GoalConfig(int(rules.pop("goal_seed")), task_configs(constants))
        return EvalProtocol(goals=goals, **rules)
    except KeyError as error:
        raise BenchmarkError(f"{where}: evaluation: missing key {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError, MorphgenError) as error:
        raise BenchmarkError(f"{where}: evaluation: {error}") from error


def tasks_of_split(split: Split) -> tuple[str, ...]:
    """Return the tasks of a split's robots, without repetition."""
    return tuple(dict.fromkeys(each.task for _, each in sided_members(split)))


def expected_robots(
    split: Split, protocol: EvalProtocol, library: Library, *, jobs: int = 1
) -> list[ExpectedRobot]:
    """Return what a submission must hold for every member, train robots first."""
    expect = partial(_expect, library, protocol.goals)
    return list(parallel_map(expect, sided_members(split), jobs))


def _expect(library: Library, goals: GoalConfig, sided: tuple[Side, Member]) -> ExpectedRobot:
    """Compute the key of a member's goal set without sampling it, in a worker process."""
    side, member = sided
    if not TASKS.is_installed(member.task):
        raise TaskError(f"robot {member.name!r}: unknown task {member.task!r}")
    robot = member_with_primitives(member, library)
    key = goal_set_key(
        robot,
        TASKS[member.task],
        goals.task_config(member.task),
        obstacles=member.obstacles,
        seed=goals.seed,
        ground=ground_under(robot),
    )
    return ExpectedRobot(side, member, key, reach(robot))


def _plain(constants: Mapping[str, Any]) -> dict[str, Any]:
    """Return constants as JSON reads them: lists instead of tuples."""
    return {key: list(v) if isinstance(v, tuple) else v for key, v in constants.items()}
