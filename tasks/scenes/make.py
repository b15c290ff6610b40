"""Batches of environments from robots, a split or specifications, in one call.

The simulated robots collide as their primitives.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict, TypeVar, get_args

import torch

from morphgen.encoding.tokens import default_max_links
from morphgen.errors import TaskError, nearest, whole_number
from morphgen.grammar.library import LibraryFolders, default_library, library_folders
from morphgen.grammar.robot_source import RobotLike, is_one_robot, robot_list
from morphgen.progress import own_progress, show_progress
from morphgen.splits.split import Side, Split
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.random_numbers import require_seed
from morphgen.tasks.registry import (
    DEFAULT_SIMULATOR,
    SIMULATORS,
    installed_simulators,
    require_simulator_device,
)
from morphgen.tasks.scenes.env_specs import GoalConfig, env_spec, load_robot, member_spec
from morphgen.tasks.scenes.obstacles import LayoutSide
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.sim.base import Contacts, Simulator
from morphgen.tasks.split_goals import read_goals, shipped_goal_set
from morphgen.tasks.task import EnvSpec, TaskConfig

if TYPE_CHECKING:
    from typing_extensions import Unpack


T = TypeVar("T")

MAX_ENVS = 2**20
"""Largest number of environments; the tokens of as many fill 4 GiB."""


class BatchOptions(TypedDict, total=False):
    """Keyword arguments that every function of this module passes to ``batch_from_specs``."""

    sim: str | None
    seed: int
    kind: ActionKind
    workers: int | None
    contacts: Contacts | None
    observe: ObservationConfig | None
    max_links: int | None
    first: int
    layouts: LayoutSide
    device: str


def make_batch(
    task: str | Sequence[str],
    robots: Sequence[RobotLike],
    num_envs: int,
    *,
    obstacles: bool | Sequence[bool] = False,
    goal_seed: int = 0,
    configs: Sequence[TaskConfig] = (),
    cache: str | PathLike[str] | None = None,
    library: LibraryFolders = (),
    **options: Unpack[BatchOptions],
) -> TaskBatch:
    """Make environments of robots at tasks; environment i has robot i modulo their number.

    Args:
        task: Name of a task, such as ``reach`` or ``drawer``; one for all robots, or one for each.
        robots: Robots, or names that ``load_robot`` accepts: words of ``morphgen compose``, a
            bundle's folder or a URDF. Their collision shapes are the fitted primitives.
        num_envs: Number of environments, n.
        obstacles: Whether there are obstacles; one for all robots, or one for each.
        goal_seed: Seed of goals, starts and obstacles, which are kept in a cache.
        configs: Constants of tasks, such as a ``ReachConfig``; other tasks have their defaults.
        cache: Folder of stored goal sets; by default one in the user's cache.
        library: Folders of your own parts.
        **options: Arguments of ``batch_from_specs``.

    Raises:
        TaskError: If an argument is invalid.
        BenchmarkError: If a robot cannot do its task.
        SimulationError: If the simulator cannot hold a scene.
        MissingDependencyError: If the simulator is not installed.
        MorphgenError: If a robot cannot be composed or read.
    """
    if is_one_robot(robots):
        raise TaskError(f"robots {robots!r}: expected a list, [{robots!r}]")
    robots = robot_list(robots)
    num_envs = _env_for_each(num_envs, len(robots))
    folders = library_folders(library)
    tasks: list[str] = _one_for_each("task", task, robots)
    with_obstacles: list[bool] = _one_for_each("obstacles", obstacles, robots)
    config = GoalConfig(goal_seed, configs)
    specs: list[EnvSpec] = []
    with own_progress() as show:
        loaded = {source: load_robot(source, library=folders) for source in dict.fromkeys(robots)}
        for source, name, has_obstacles in zip(robots, tasks, with_obstacles, strict=True):
            show(len(specs), len(robots))
            robot = loaded[source]
            specs.append(env_spec(robot, name, config, obstacles=has_obstacles, cache=cache))
        show(len(specs), len(robots))
    return batch_from_specs(specs, num_envs, library=folders, **options)


def make_split_batch(
    split: Split,
    side: Side,
    num_envs: int,
    *,
    goal_seed: int = 0,
    configs: Sequence[TaskConfig] = (),
    goals: Path | None = None,
    cache: str | PathLike[str] | None = None,
    library: LibraryFolders = (),
    **options: Unpack[BatchOptions],
) -> TaskBatch:
    """Make environments of a split's robots, at the tasks and with the obstacles of the split.

    Args:
        split: Robots to train and to test on.
        side: ``train`` or ``test``.
        num_envs: Number of environments, n; environment i has robot i modulo their number.
        goal_seed: Seed of goals, starts and obstacles.
        configs: Constants of tasks, such as a ``ReachConfig``; other tasks have their defaults.
        goals: Folder of a split built with goals, whose goal sets are used.
        cache: Folder of stored goal sets; by default one in the user's cache.
        library: Folders of your own parts.
        **options: Arguments of ``batch_from_specs``.

    Raises:
        MorphgenError: As ``make_batch``; or if a robot differs from the one that the split was
            made with, or a shipped goal set is not the one that would be sampled.
    """
    folders = library_folders(library)
    parts, config = default_library(folders), GoalConfig(goal_seed, configs)
    if not isinstance(split, Split):
        raise TaskError(
            f"split {split!r}: expected a Split, as read_split returns it, or the definition of a "
            "LoadedSplit"
        )
    members = split.side(side)
    num_envs = _env_for_each(num_envs, len(members))
    sets = read_goals(goals, side) if goals is not None else None
    specs: list[EnvSpec] = []
    with own_progress() as show:
        for member in members:
            show(len(specs), len(members))
            shipped = shipped_goal_set(sets, member.name, goals)
            specs.append(member_spec(member, parts, config, cache=cache, shipped=shipped))
        show(len(specs), len(members))
    return batch_from_specs(specs, num_envs, library=folders, **options)


@show_progress(None)  # the fits of a robot's links are not robots whose goals are ready
def batch_from_specs(
    specs: Sequence[EnvSpec],
    num_envs: int,
    *,
    sim: str | None = None,
    seed: int = 0,
    kind: ActionKind = "continuous",
    workers: int | None = None,
    contacts: Contacts | None = None,
    observe: ObservationConfig | None = None,
    max_links: int | None = None,
    first: int = 0,
    layouts: LayoutSide = "train",
    device: str = "cpu",
    library: LibraryFolders = (),
) -> TaskBatch:
    """Make a batch of environments from their specifications."""
    if observe is not None and not isinstance(observe, ObservationConfig):
        raise TaskError(f"observe {observe!r}: expected an ObservationConfig")
    if contacts is not None and not isinstance(contacts, Contacts):
        raise TaskError(f"contacts {contacts!r}: expected Contacts")
    simulator = SIMULATORS[sim or DEFAULT_SIMULATOR]
    if workers is None:
        workers = simulator.default_workers(num_envs)
    workers, seed = (
        whole_number(name, value, TaskError)
        for name, value in (("workers", workers), ("seed", seed))
    )
    if not 1 <= num_envs <= MAX_ENVS or workers < 1 or not specs:
        raise TaskError(
            f"{num_envs} environments of {len(specs)} robots with {workers} workers: expected at "
            f"least one of each, and at most {MAX_ENVS:,} environments"
        )
    require_seed(seed)
    if kind not in (kinds := get_args(ActionKind)):
        raise TaskError(f"unknown action kind {kind!r}{nearest(kind, kinds)}")
    require_simulator_device(simulator.name, device)
    if workers > 1 and not simulator.takes_workers:
        raise TaskError(
            f"simulator {simulator.name!r} shares its work with no others: {workers} workers; "
            "expected 1"
        )
    _require_contacts(simulator, specs)
    folders = default_library(library).folders
    robots = [spec.robot for spec in specs]
    if max_links is None:
        max_links = default_max_links(len(robot.links) for robot in robots)
    tables = build_robot_tables(robots, folders, max_links=max_links, device=device)
    env_robot_index = [(first + i) % len(specs) for i in range(num_envs)]
    scenes = [specs[i].scene for i in env_robot_index]
    simulation = simulator.load(scenes, contacts, workers, torch.device(device))
    return TaskBatch(
        tables,
        specs,
        env_robot_index,
        simulation,
        kind=kind,
        observe=observe,
        seed=seed,
        first=first,
        layouts=layouts,
    )


def _require_contacts(simulator: Simulator, specs: Sequence[EnvSpec]) -> None:
    """Require a simulator with contacts if a scene has something to touch."""
    if simulator.simulates_contacts:
        return
    for spec in specs:
        if spec.scene.object is not None or spec.scene.obstacles:
            thing = "an object" if spec.scene.object is not None else "obstacles"
            others = installed_simulators(lambda other: other.simulates_contacts)
            raise TaskError(
                f"simulator {simulator.name!r} has no contacts, and {spec.task} of "
                f"{spec.robot.name!r} has {thing}; expected simulator {' or '.join(others)}"
            )


def _env_for_each(num_envs: int, num_robots: int) -> int:
    """Return a number of environments: a robot without one would silently be missing."""
    num_envs = whole_number("number of environments", num_envs, TaskError)
    if num_envs < num_robots:
        raise TaskError(
            f"{num_envs} environments for {num_robots} robots: expected at least one each"
        )
    return num_envs


def _one_for_each(name: str, value: T | Sequence[T], robots: Sequence[object]) -> list[T]:
    """Return an argument for every robot, which is given for each of them or once for all."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return [value] * len(robots)
    if len(value) != len(robots):
        raise TaskError(f"{name}: {len(value)} values for {len(robots)} robots; expected one each")
    return list(value)
