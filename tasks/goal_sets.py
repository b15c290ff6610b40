"""Goal sets of robots: drawn once, kept in a cache, and stored as files of a split.

A file has an array for each field; the same set gives the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import warnings
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.errors import BenchmarkError, TaskError
from morphgen.formats.files import write_cache_file
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import GoalSet, Task, TaskConfig

G = TypeVar("G", bound=GoalSet)


def goal_set(
    robot: Robot,
    task: Task[Any, Any],
    config: TaskConfig,
    *,
    obstacles: bool,
    seed: int,
    ground: float = 0.0,
    cache: Path | None = None,
    shipped: GoalSet | None = None,
) -> GoalSet:
    """Return a robot's goal set: one that came with a split, one from the cache, or a new one.

    The same robot, pairs of links to ignore, seed, ground, constants and obstacles give the same
    set, whatever the robot is called; fewer goals are the first of more.

    Args:
        robot: The robot, with a tool.
        task: The task.
        config: Its constants, among them the number of goals.
        obstacles: Whether there are obstacles.
        seed: Seed of all that is drawn, at least 0.
        ground: Height of the ground in the root frame, metres.
        cache: Folder of stored sets; by default one in the user's cache.
        shipped: The set to take, which must be the one that would be drawn.

    Raises:
        BenchmarkError: If the numbers are invalid, or the robot cannot have such a set.
        TaskError: Likewise; or if the set's file is broken, or ``shipped`` is another set.
        MeshError: If a mesh cannot be read.
    """
    if seed < 0 or config.num_goals < 1:
        raise BenchmarkError(
            f"{config.num_goals} goals with seed {seed}: at least one goal, and no negative seed"
        )
    task.check(robot, config)
    robot_digest = robot_hash(robot, visuals=False)
    index = robot.link_index
    ignored = sorted(sorted((index[a], index[b])) for a, b in robot.ignore_pairs)
    boxes = [config.obstacles, *map(float, config.obstacle_size)] if obstacles else None
    constants = [*task.key_parts(config), boxes]
    parts = [task.goal_format, robot_digest, ignored, *constants, seed, float(ground)]
    key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()
    if shipped is not None:
        if shipped.key != key:
            raise TaskError(
                f"robot {robot.name!r}: the set that is shipped is of another body, seed, ground "
                "or other constants of the task; morphgen split build --goals makes it anew"
            )
        return shipped

    def sample() -> GoalSet:
        seeds = np.random.SeedSequence([seed, int(robot_digest, 16), int(obstacles)])
        identity = {"robot": robot.name, "key": key, "seed": seed}
        goals: GoalSet = task.sample(
            robot, config, obstacles=obstacles, ground=ground, seeds=seeds, identity=identity
        )
        return goals

    folder = user_cache_path("morphgen") / task.cache_folder if cache is None else cache
    kind: type[GoalSet] = task.goal_set_type
    return _cached(kind, folder / f"{key}.npz", robot.name, sample)


def set_npz(made: GoalSet) -> bytes:
    """Return a set as the content of a file.

    Blocks are rows of 12: edges, pose (x, y, z, qw, qx, qy, qz), mass and friction.
    """
    content = io.BytesIO()
    np.savez(content, **arrays_of(made))  # type: ignore[arg-type]  # they are not allow_pickle
    return content.getvalue()


def set_from_npz(content: bytes, kind: type[G]) -> G:
    """Read what ``set_npz`` wrote.

    Raises:
        ValueError: If it is no such set; says why.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as data:
            return kind(**{each.name: _value(each.name, data[each.name]) for each in fields(kind)})
    except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
        raise ValueError(str(error)) from error


def arrays_of(made: GoalSet) -> dict[str, NDArray[Any]]:
    """Return the fields of a set as arrays, by name; see ``set_npz``."""
    return {each.name: _array(getattr(made, each.name)) for each in fields(made)}


def goals_from_npz(content: bytes, task: str, path: Path) -> GoalSet:
    """Read a set that came with a split.

    Args:
        content: Content of the file.
        task: Name of the task that the set is for.
        path: Path of the file, for messages.

    Raises:
        BenchmarkError: If it is no such set.
        TaskError: If the task is unknown.
    """
    kind: type[GoalSet] = TASKS[task].goal_set_type
    try:
        goals = set_from_npz(content, kind)
    except ValueError as error:
        raise BenchmarkError(f"{path}: no goal set for {task}: {error}") from error
    shapes = goals.q.shape, goals.goal_poses.shape
    if len(shapes[0]) != 2 or shapes[1] != (shapes[0][0], 7):
        raise BenchmarkError(
            f"{path}: configurations and poses are of shapes {shapes[0]} and {shapes[1]}"
        )
    return goals


def _cached(kind: type[G], path: Path, robot: str, sample: Callable[[], G]) -> G:
    """Return a set from a cache, or sample it and keep it there.

    Warns if the folder cannot be written. The file is named by the set's key.

    Raises:
        TaskError: If the file is broken, or of another set.
    """
    if path.is_file():
        try:
            found = set_from_npz(path.read_bytes(), kind)
        except (OSError, ValueError) as error:
            raise TaskError(f"{path}: no {kind.__name__}: {error}; delete it") from error
        if found.key != path.stem:
            raise TaskError(f"{path}: a set of key {found.key}, not what its name says; delete it")
        return replace(found, robot=robot)
    made = sample()
    try:
        write_cache_file(path, set_npz(made))
    except OSError as error:
        warnings.warn(f"cannot keep a {kind.__name__} in {path}: {error.strerror}", stacklevel=3)
    return made


def _array(value: object) -> NDArray[Any]:
    if isinstance(value, Block):
        return np.array(_row(value))
    if isinstance(value, tuple):
        return np.array([_row(block) for block in value], dtype=np.float64).reshape(-1, 12)
    return np.asarray(value)


def _value(name: str, array: NDArray[Any]) -> object:
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name} has a number that is not finite")
    if name == "block":
        return _block(array.tolist())
    if name == "obstacles":
        return tuple(_block(row) for row in array.tolist())
    return array if array.ndim else array.item()


def _row(block: Block) -> list[float]:
    return [*block.size, *block.pose.position, *block.pose.quaternion, block.mass, block.friction]


def _block(row: list[float]) -> Block:
    a, b, c, x, y, z, qw, qx, qy, qz, mass, friction = row
    return Block((a, b, c), Pose((x, y, z), (qw, qx, qy, qz)), mass, friction)
