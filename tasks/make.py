"""Batches of environments from robots or a split, in one call."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal, TypedDict, TypeVar

from morphgen.benchmark.split import TASKS, Side, Split, Task
from morphgen.benchmark.tokens import MAX_LINKS
from morphgen.errors import TaskError, nearest
from morphgen.grammar.library import default_library
from morphgen.model.robot import Robot
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.batch import Channels, TaskBatch
from morphgen.tasks.bodies import bodies_of
from morphgen.tasks.config import PushConfig, ReachConfig
from morphgen.tasks.robots import robot_of
from morphgen.tasks.settings import Recipe, Setting, member_setting, setting_of
from morphgen.tasks.sim.base import Contacts, Scene, Simulation
from morphgen.tasks.split_goals import read_goals, shipped_set

if TYPE_CHECKING:
    from typing_extensions import Unpack

T = TypeVar("T")

SimulatorName = Literal["pybullet", "mujoco"]
SIMULATORS: tuple[SimulatorName, ...] = ("pybullet", "mujoco")


class BatchOptions(TypedDict, total=False):
    """Keyword arguments of ``batch_of``, which every function here takes."""

    sim: SimulatorName
    seed: int
    kind: ActionKind
    workers: int
    contacts: Contacts | None
    reach: ReachConfig | None
    push: PushConfig | None
    channels: Channels | None
    max_links: int | None
    first: int


def make_batch(
    task: Task | Sequence[Task],
    robots: Sequence[Robot | str | Path],
    num_envs: int,
    *,
    obstacles: bool | Sequence[bool] = False,
    goal_seed: int = 0,
    cache: Path | None = None,
    library: Iterable[Path] = (),
    **options: Unpack[BatchOptions],
) -> TaskBatch:
    """Environments of robots at tasks; environment i has robot i modulo their number.

    Args:
        task: ``reach`` or ``push``; one for all robots, or one for each.
        robots: Robots, or what ``robot_of`` knows: words of ``morphgen compose``, a bundle's folder
            or a URDF. Their collision shapes are the fitted primitives, see ``as_primitives``.
        num_envs: How many environments, n.
        obstacles: Whether there are any; one for all robots, or one for each.
        goal_seed: Of goals, starts and obstacles, which are kept in a cache.
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
    tasks: list[Task] = _one_each("task", task, robots)
    boxes: list[bool] = _one_each("obstacles", obstacles, robots)
    recipe = _recipe(goal_seed, options)
    made: dict[Robot | str | Path, Robot] = {}
    settings = []
    for robot, does, has in zip(robots, tasks, boxes, strict=True):
        _require("task", does, TASKS)
        if robot not in made:
            made[robot] = robot_of(robot, library=folders)
        settings.append(setting_of(made[robot], does, recipe, obstacles=has, cache=cache))
    return batch_of(settings, num_envs, library=folders, **options)


def make_split_batch(
    split: Split,
    side: Side,
    num_envs: int,
    *,
    goal_seed: int = 0,
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
        goal_seed: Of goals, starts and obstacles.
        goals: The folder where the split is built with goals: the sets there are taken.
        cache: Folder of these; by default the user's.
        library: Folders of your own parts.
        **options: See ``batch_of``.

    Raises:
        MorphgenError: As ``make_batch``; or if a robot is not the one that the split was made with,
            or a set that is shipped not the one that it says.
    """
    folders = tuple(library)
    parts, recipe = default_library(folders), _recipe(goal_seed, options)
    members = split.side(side)
    _require_enough(num_envs, len(members))
    shipped = read_goals(goals, side) if goals is not None else None
    settings = [
        member_setting(
            member,
            parts,
            recipe,
            cache=cache,
            shipped=shipped_set(shipped, member.name, goals),
        )
        for member in members
    ]
    return batch_of(settings, num_envs, library=folders, **options)


def batch_of(
    settings: Sequence[Setting],
    num_envs: int,
    *,
    sim: SimulatorName = "pybullet",
    seed: int = 0,
    kind: ActionKind = "continuous",
    workers: int = 1,
    contacts: Contacts | None = None,
    reach: ReachConfig | None = None,
    push: PushConfig | None = None,
    channels: Channels | None = None,
    max_links: int | None = MAX_LINKS,
    first: int = 0,
    library: Iterable[Path] = (),
) -> TaskBatch:
    """Environments of settings.

    Args:
        settings: What there is; environment i has setting i modulo their number.
        num_envs: How many environments, n.
        sim: ``pybullet`` or ``mujoco``.
        seed: Of episodes: the same gives the same.
        kind: Actions are ``continuous``, in [-1, 1], or ``discrete``, indices of ``BINS``.
        workers: Processes of PyBullet, threads of MuJoCo.
        contacts: What may touch what; by default everything.
        reach: Constants of reach.
        push: Constants of push.
        channels: What is observed besides.
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
    if num_envs < 1 or workers < 1 or not settings:
        raise TaskError(
            f"{num_envs} environments of {len(settings)} robots with {workers} workers: at least "
            "one of each"
        )
    if seed < 0:
        raise TaskError(f"seed {seed}: expected 0 or more")
    _require("action kind", kind, ("continuous", "discrete"))
    robots = [setting.robot for setting in settings]
    if max_links is None:
        max_links = max(MAX_LINKS, *(len(robot.links) for robot in robots))
    bodies = bodies_of(
        robots,
        default_library(tuple(library)).folders,
        max_links=max_links,
    )
    body = [(first + i) % len(settings) for i in range(num_envs)]
    simulation = simulator(sim, [settings[i].scene for i in body], contacts, workers)
    return TaskBatch(
        bodies,
        settings,
        body,
        simulation,
        reach=reach,
        push=push,
        kind=kind,
        channels=channels,
        seed=seed,
        first=first,
    )


def _require_enough(num_envs: int, robots: int) -> None:
    """Require an environment for every robot: what has none would silently not be there."""
    if num_envs < robots:
        raise TaskError(f"{num_envs} environments for {robots} robots: expected one each at least")


def simulator(
    name: SimulatorName, scenes: Sequence[Scene], contacts: Contacts | None, workers: int
) -> Simulation:
    """Load scenes into a simulator; errors as of ``batch_of``."""
    _require("simulator", name, SIMULATORS)
    if name == "mujoco":
        from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

        return MujocoSimulation(scenes, contacts, threads=workers)
    from morphgen.tasks.sim.bullet import BulletSimulation

    return BulletSimulation(scenes, contacts, processes=workers)


def own_step(name: SimulatorName) -> tuple[ModuleType, str]:
    """A simulator's own step, as its module and the name of the function."""
    if name == "mujoco":
        return import_module("mujoco"), "mj_step"
    return import_module("pybullet"), "stepSimulation"


def _recipe(goal_seed: int, options: BatchOptions) -> Recipe:
    return Recipe(
        goal_seed, options.get("reach") or ReachConfig(), options.get("push") or PushConfig()
    )


def _one_each(what: str, given: T | Sequence[T], robots: Sequence[object]) -> list[T]:
    """What is given for every robot, or for all."""
    if isinstance(given, str) or not isinstance(given, Sequence):
        return [given] * len(robots)
    if len(given) != len(robots):
        raise TaskError(f"{what}: {len(given)} are given for {len(robots)} robots")
    return list(given)


def _require(what: str, given: str, valid: Sequence[str]) -> None:
    if given not in valid:
        raise TaskError(f"unknown {what} {given!r}{nearest(given, valid)}")
