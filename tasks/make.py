"""Batches of environments from robots or a split, in one call."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, TypeVar, get_args

from morphgen.benchmark.split import Side, Split
from morphgen.benchmark.tokens import MAX_LINKS
from morphgen.errors import TaskError, nearest
from morphgen.grammar.library import default_library
from morphgen.model.robot import Robot
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.bodies import bodies_of
from morphgen.tasks.env_specs import GoalConfig, env_spec, member_spec
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.robots import robot_of
from morphgen.tasks.sim.base import Contacts
from morphgen.tasks.split_goals import read_goals, shipped_set
from morphgen.tasks.task import EnvSpec, TaskConfig

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T")


class BatchOptions(TypedDict, total=False):
    """Keyword arguments of ``batch_of``, which every function here takes."""

    sim: str
    seed: int
    kind: ActionKind
    workers: int
    contacts: Contacts | None
    observe: ObservationConfig | None
    max_links: int | None
    first: int


def make_batch(
    task: str | Sequence[str],
    robots: Sequence[Robot | str | Path],
    num_envs: int,
    *,
    obstacles: bool | Sequence[bool] = False,
    goal_seed: int = 0,
    configs: Sequence[TaskConfig] = (),
    cache: Path | None = None,
    library: Iterable[Path] = (),
    **options: Unpack[BatchOptions],
) -> TaskBatch:
    """Environments of robots at tasks; environment i has robot i modulo their number.

    Args:
        task: Name of a task, such as ``reach`` or ``push``; one for all robots, or one for each.
        robots: Robots, or what ``robot_of`` knows: words of ``morphgen compose``, a bundle's folder
            or a URDF. Their collision shapes are the fitted primitives, see ``as_primitives``.
        num_envs: How many environments, n.
        obstacles: Whether there are any; one for all robots, or one for each.
        goal_seed: Seed of goals, starts and obstacles, which are kept in a cache.
        configs: Constants of tasks, such as a ``ReachConfig``; other tasks have their defaults.
        cache: Folder of this; by default the user's.
        library: Folders of your own parts.
        **options: See ``batch_of``.

    Raises:
        TaskError: If an argument is none of the choices.
        BenchmarkError: If a robot cannot do its task.
        SimulationError: If the simulator cannot hold a scene.
        MissingDependencyError: If the simulator is not installed.
        MorphgenError: If a robot cannot be made or read.
    """
    if isinstance(robots, (str, Path, Robot)):
        raise TaskError(f"robots {robots!r}: expected a list, [{robots!r}]")
    _require_enough(num_envs, len(robots))
    folders = tuple(library)
    tasks: list[str] = _one_each("task", task, robots)
    boxes: list[bool] = _one_each("obstacles", obstacles, robots)
    config = GoalConfig(goal_seed, tuple(configs))
    made: dict[Robot | str | Path, Robot] = {}
    specs = []
    for robot, does, has in zip(robots, tasks, boxes, strict=True):
        if robot not in made:
            made[robot] = robot_of(robot, library=folders)
        specs.append(env_spec(made[robot], does, config, obstacles=has, cache=cache))
    return batch_of(specs, num_envs, library=folders, **options)


def make_split_batch(
    split: Split,
    side: Side,
    num_envs: int,
    *,
    goal_seed: int = 0,
    configs: Sequence[TaskConfig] = (),
    goals: Path | None = None,
    cache: Path | None = None,
    library: Iterable[Path] = (),
    **options: Unpack[BatchOptions],
) -> TaskBatch:
    """Environments of a split's robots, each at its task, with obstacles where it has them.

    Args:
        split: Robots to train and to test on.
        side: Which of them.
        num_envs: How many environments, n; environment i has robot i modulo their number.
        goal_seed: Seed of goals, starts and obstacles.
        configs: Constants of tasks, such as a ``ReachConfig``; other tasks have their defaults.
        goals: The folder where the split is built with goals: the sets there are taken.
        cache: Folder of these; by default the user's.
        library: Folders of your own parts.
        **options: See ``batch_of``.

    Raises:
        MorphgenError: As ``make_batch``; or if a robot is not the one that the split was made with,
            or a set that is shipped not the one that it says.
    """
    folders = tuple(library)
    parts, config = default_library(folders), GoalConfig(goal_seed, tuple(configs))
    members = split.side(side)
    _require_enough(num_envs, len(members))
    shipped = read_goals(goals, side) if goals is not None else None
    specs = [
        member_spec(
            member,
            parts,
            config,
            cache=cache,
            shipped=shipped_set(shipped, member.name, goals),
        )
        for member in members
    ]
    return batch_of(specs, num_envs, library=folders, **options)


def batch_of(
    specs: Sequence[EnvSpec],
    num_envs: int,
    *,
    sim: str = "pybullet",
    seed: int = 0,
    kind: ActionKind = "continuous",
    workers: int = 1,
    contacts: Contacts | None = None,
    observe: ObservationConfig | None = None,
    max_links: int | None = MAX_LINKS,
    first: int = 0,
    library: Iterable[Path] = (),
) -> TaskBatch:
    """Make a batch of environments.

    Args:
        specs: Specifications; environment i has specification i modulo their number.
        num_envs: How many environments, n.
        sim: Name of a simulator, such as ``pybullet`` or ``mujoco``.
        seed: Of episodes: the same gives the same.
        kind: Actions are ``continuous``, in [-1, 1], or ``discrete``, indices of ``BINS``.
        workers: Processes of PyBullet, threads of MuJoCo.
        contacts: What may touch what; by default everything.
        observe: Entries of observations that are not there by default.
        max_links: L, links that observations and actions are padded to; None for what the largest
            robot needs, and the paper's at least.
        first: Number of the first environment, where a batch is made in parts.
        library: Folders of your own parts.

    Raises:
        TaskError: If an argument is none of the choices.
        BenchmarkError: If a robot has more links than ``max_links``.
        SimulationError: If the simulator cannot hold a scene.
        MissingDependencyError: If the simulator is not installed.
    """
    if num_envs < 1 or workers < 1 or not specs:
        raise TaskError(
            f"{num_envs} environments of {len(specs)} robots with {workers} workers: at least "
            "one of each"
        )
    if seed < 0:
        raise TaskError(f"seed {seed}: expected 0 or more")
    if kind not in (kinds := get_args(ActionKind)):
        raise TaskError(f"unknown action kind {kind!r}{nearest(kind, kinds)}")
    robots = [spec.robot for spec in specs]
    if max_links is None:
        max_links = max(MAX_LINKS, *(len(robot.links) for robot in robots))
    bodies = bodies_of(
        robots,
        default_library(tuple(library)).folders,
        max_links=max_links,
    )
    body = [(first + i) % len(specs) for i in range(num_envs)]
    simulation = SIMULATORS[sim].load([specs[i].scene for i in body], contacts, workers)
    return TaskBatch(
        bodies,
        specs,
        body,
        simulation,
        kind=kind,
        observe=observe,
        seed=seed,
        first=first,
    )


def _require_enough(num_envs: int, robots: int) -> None:
    """Require an environment for every robot: what has none would silently not be there."""
    if num_envs < robots:
        raise TaskError(f"{num_envs} environments for {robots} robots: expected one each at least")


def _one_each(what: str, given: T | Sequence[T], robots: Sequence[object]) -> list[T]:
    """What is given for every robot, or for all."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        return [given] * len(robots)
    if len(given) != len(robots):
        raise TaskError(f"{what}: {len(given)} are given for {len(robots)} robots")
    return list(given)
