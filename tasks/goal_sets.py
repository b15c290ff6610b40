"""Goal sets of robots: packaged, or sampled once and cached, and stored as files of a split.

A file has an array for each field; the same set gives the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import lzma
from collections.abc import Mapping
from dataclasses import fields, replace
from functools import cache
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from morphgen.encoding.robot_hash import robot_hash
from morphgen.errors import BenchmarkError, NoGoalsError, TaskError
from morphgen.files import keep_file
from morphgen.formats.zip_files import read_npz
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import BOUND, GoalSet, Task, TaskConfig

FOLDER = Path(__file__).parent / "goal_set_files"
"""Folder of the compressed sets and of their index."""
INDEX = "index.json"
MAX_REFUSAL = 2000  # characters that are read of why a robot has no goals


@cache
def packaged_index() -> Mapping[str, Mapping[str, Any]]:
    """Return a record of each packaged set, such as its file and hash, by the set's key."""
    records: dict[str, dict[str, Any]] = json.loads((FOLDER / INDEX).read_text(encoding="utf-8"))
    return records


def packaged_set(key: str) -> bytes | None:
    """Return the content of the packaged set with a key, as ``set_npz`` returns it, or None."""
    record = packaged_index().get(key)
    if record is None:
        return None
    path = FOLDER / record["file"]
    try:
        content = path.read_bytes()
    except OSError as error:
        raise TaskError(f"{path}: {error.strerror}; install morphgen again") from error
    if hashlib.sha256(content).hexdigest() != record["sha256"]:
        raise TaskError(f"{path}: not the file that {INDEX} lists; install morphgen again")
    return lzma.decompress(content)


G = TypeVar("G", bound=GoalSet)


def goal_set(
    robot: Robot,
    task: Task[Any, Any],
    config: TaskConfig,
    *,
    obstacles: bool,
    seed: int,
    ground: float = 0.0,
    cache: str | PathLike[str] | None = None,
    shipped: GoalSet | None = None,
    anew: bool = False,
) -> GoalSet:
    """Return a robot's goal set: the shipped one, the packaged one, the cached one, or a new one.

    A set depends on what ``goal_set_key`` says. A smaller set is the beginning of a larger one.
    The ground is a height in the root frame [m].
    """
    task.check(robot, config)
    key = goal_set_key(robot, task, config, obstacles=obstacles, seed=seed, ground=ground)
    if shipped is not None:
        if shipped.key != key:
            raise TaskError(
                f"robot {robot.name!r}: the shipped goal set is of another robot, seed, ground or "
                "constants of the task; build it again: morphgen split build --goals"
            )
        return shipped

    kind: type[GoalSet] = task.goal_set_type
    folder = user_cache_path("morphgen") / task.cache_folder if cache is None else Path(cache)
    path, refusal = folder / f"{key}.npz", folder / f"{key}.txt"
    if not anew:
        if (content := packaged_set(key)) is not None:
            return replace(set_from_npz(content, kind), robot=robot.name)
        if path.is_file():
            return replace(_read_cached(path, kind), robot=robot.name)
        if refusal.is_file():
            with refusal.open(encoding="utf-8") as file:
                raise NoGoalsError(f"robot {robot.name!r} {file.read(MAX_REFUSAL)}")
    seeds = np.random.SeedSequence(
        [seed, int(robot_hash(robot, visuals=False), 16), int(obstacles)]
    )
    identity = {"robot": robot.name, "key": key, "seed": seed}
    try:
        goals: GoalSet = task.sample(
            robot, config, obstacles=obstacles, ground=ground, seeds=seeds, identity=identity
        )
    except NoGoalsError as error:
        if not anew:  # to find none takes longer than to find some
            keep_file(refusal, str(error).removeprefix(f"robot {robot.name!r} "), "goals")
        raise
    if not anew:
        keep_file(path, set_npz(goals), "goals")
    return goals


def goal_set_key(
    robot: Robot,
    task: Task[Any, Any],
    config: TaskConfig,
    *,
    obstacles: bool,
    seed: int,
    ground: float,
) -> str:
    """Return the hash of everything that a goal set depends on: 64 hexadecimal digits.

    These are robot, ignored pairs of links, seed, ground, constants and obstacles, not its name.
    """
    index = robot.link_index
    ignored = sorted(sorted((index[a], index[b])) for a, b in robot.ignore_pairs)
    layouts = config.train_layouts, config.eval_layouts
    boxes = [config.obstacles, *map(float, config.obstacle_size), *layouts] if obstacles else None
    constants = [*task.key_parts(config), boxes]
    digest = robot_hash(robot, visuals=False)
    parts = [task.goal_format, digest, ignored, *constants, seed, float(ground)]
    return hashlib.sha256(json.dumps(parts).encode()).hexdigest()


def set_npz(goals: GoalSet) -> bytes:
    """Return a goal set as the content of a file.

    Blocks are rows of 12: edges, pose (x, y, z, qw, qx, qy, qz), mass and friction.
    """
    content = io.BytesIO()
    # NumPy dates all entries of its zip to 1980: the same arrays give the same bytes.
    np.savez(content, **arrays_of(goals))  # type: ignore[arg-type]  # they are not allow_pickle
    return content.getvalue()


def set_from_npz(content: bytes, kind: type[G]) -> G:
    """Read what ``set_npz`` wrote."""
    names = [field.name for field in fields(kind)]
    # Sets are stored without compression; thousands of them may be read from a stranger's folder.
    arrays = read_npz(io.BytesIO(content), names, max_bytes=2**22 + 16 * len(content))
    types = {each.name: str(getattr(each.type, "__name__", each.type)) for each in fields(kind)}
    return kind(**{name: _value(name, types[name], array) for name, array in arrays.items()})


def arrays_of(goals: GoalSet) -> dict[str, NDArray[Any]]:
    """Return the fields of a set as arrays, by name; see ``set_npz``."""
    return {field.name: _array(getattr(goals, field.name)) for field in fields(goals)}


def goals_from_npz(content: bytes, task: str, path: Path) -> GoalSet:
    """Read a set that came with a split."""
    kind: type[GoalSet] = TASKS[task].goal_set_type
    try:
        goals = set_from_npz(content, kind)
    except ValueError as error:
        raise BenchmarkError(f"{path}: not a goal set for {task}: {error}") from error
    shapes = goals.q.shape, goals.goal_poses.shape
    if len(shapes[0]) != 2 or shapes[1] != (shapes[0][0], 7):
        raise BenchmarkError(
            f"{path}: configurations and poses have shapes {shapes[0]} and {shapes[1]}"
        )
    return goals


def _read_cached(path: Path, kind: type[G]) -> G:
    """Return a goal set from the cache; the name of its file is the set's key."""
    try:
        cached = set_from_npz(path.read_bytes(), kind)
    except (OSError, ValueError) as error:
        raise TaskError(f"{path}: not a {kind.__name__}: {error}; delete it") from error
    if cached.key != path.stem:
        raise TaskError(f"{path}: its key is {cached.key}, not its name; delete it")
    return cached


def _array(value: object) -> NDArray[Any]:
    if isinstance(value, Block):
        return np.array(_row(value))
    if isinstance(value, tuple):
        return np.array([_row(block) for block in value], dtype=np.float64).reshape(-1, 12)
    return np.asarray(value)


_SCALARS = {"bool": "b", "int": "iu", "float": "fiu", "str": "U"}
"""Kinds of NumPy's types that a field of one value may have, by its annotation."""


def _value(name: str, annotation: str, array: NDArray[Any]) -> object:
    if array.dtype.kind == "f" and not (np.abs(array) <= BOUND).all():  # nor is NaN
        raise ValueError(f"{name} has a number beyond {BOUND:g}, or not finite")
    shape = {"block": (12,), "obstacles": (*array.shape[:1], 12)}.get(name, array.shape)
    is_scalar = annotation in _SCALARS
    if (
        is_scalar != (array.ndim == 0)
        or array.dtype.kind not in _SCALARS.get(annotation, "bfiu")
        or array.shape != shape
    ):
        raise ValueError(f"{name} has type {array.dtype} and shape {array.shape}")
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
