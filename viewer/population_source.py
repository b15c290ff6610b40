"""The robots of a population: listed in this process, read and measured in the workers.

A population is a folder of robots (``robots/arm3``), a split or one of its sides
(``extrapolation/arms/reach@test``), or robots sampled from a grammar (``arm3``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.similarity import classical_mds, compared_tokens
from morphgen.benchmark.split import SIDES, split_id
from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.benchmark.token_layout import default_max_links
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX, grammar_names, grammar_text
from morphgen.grammar.sampling import robot_name, sample_robot
from morphgen.model.kinematics import forward_kinematics, random_configurations, reach
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.population import Population, make_population
from morphgen.viewer.robot_rows import Row, folder_rows, split_rows
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import (
    DERIVATION,
    FileAccess,
    UriError,
    content_hash,
    read_robot_uri,
    resolve_grammar,
    resolve_split,
    with_library_meshes,
)
from morphgen.viewer.workers import Workers

T = TypeVar("T")
Progress = Callable[[int, int], None]

MAX_ROBOTS = 1000
"""Largest population."""
NUM_SAMPLED = 100
"""Robots that are sampled from a grammar by default."""
NUM_POSES = 8
"""Configurations without self-collision of each robot."""
_MAX_TRIES = 256
"""Random configurations that are tested to find them; a robot without any stays at home."""
_GROUND_TOLERANCE = 1e-3
"""Height below the ground at which the origin of a link still counts as above it [m]."""
_CHUNK = 20
"""Robots of one call of a worker."""


@dataclass(frozen=True)
class Source:
    """Robots that an address names."""

    rows: tuple[Row, ...]
    """At most ``MAX_ROBOTS``, with the facts that are known."""
    total: int
    """Number of robots that the address names."""
    grammar: str = ""
    """Name or file of the grammar from which the robots are sampled; else empty."""
    seed: int = 0
    """Seed of the sample."""
    stamp: str = ""
    """Changes with the files of the robots, the split or the grammar."""

    @property
    def key(self) -> str:
        """Name of the robots among the results that all browsers share."""
        return f"{hash(self)}"


@dataclass(frozen=True, eq=False)
class ReadRobot:
    """A robot that a worker has read, or why it has not."""

    row: Row
    robot: Robot | None
    error: str = ""


def find_source(subject: str, files: FileAccess, seed: int, number: int) -> Source:
    """List the robots that an address names.

    Args:
        subject: A folder, a split with or without ``@train`` or ``@test``, or a grammar.
        files: Files that may be read.
        seed: Seed of robots that are sampled.
        number: Robots that are sampled, at most ``MAX_ROBOTS``.

    Raises:
        MorphgenError: If it does not exist or holds no robot.
    """
    name, at, side = subject.rpartition("@")
    if not at:
        name, side = subject, ""
    elif side not in SIDES:
        raise UriError(f"{subject}: unknown side {side!r}; expected @train or @test")
    if name in grammar_names() or name.endswith(SUFFIX):
        number = min(max(number, 1), MAX_ROBOTS)
        grammar = resolve_grammar(name, files)
        names = [robot_name(grammar, i) for i in range(number)]
        rows = [Row(text, text, grammar.name, order=i) for i, text in enumerate(names)]
        return Source(tuple(rows), number, name, seed, grammar_text(grammar))
    if name in split_names() or name.endswith(".yaml") or (files.path(name) / SPLIT_FILE).is_file():
        split = resolve_split(name, files)
        rows = [row for row in split_rows(name, split) if side in ("", row.role)]
        stamp = split_id(split)
    elif side:
        raise UriError(f"{subject}: only a split has sides; {name} is a folder")
    else:
        rows = folder_rows(name, files)
        stamp = "\n".join(content_hash(row.uri, files) for row in rows[:MAX_ROBOTS])
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp=stamp)


def load_population(
    source: Source, files: FileAccess, workers: Workers, progress: Progress
) -> tuple[Population, list[tuple[str, str]]]:
    """Read the robots in the workers.

    Returns:
        The population of all robots that can be read; name and error of each other one.

    Raises:
        MorphgenError: If no robot can be read.
    """
    chunks = _chunks(source.rows)
    if source.grammar:
        calls = [
            workers.submit(sample_robots, source.grammar, source.seed, chunk, files)
            for chunk in chunks
        ]
    else:
        calls = [workers.submit(read_robots, chunk, files) for chunk in chunks]
    results = _gather(calls, workers, len(source.rows), progress)
    faults = [(result.row.name, result.error) for result in results if result.robot is None]
    read = [(result.row, result.robot) for result in results if result.robot is not None]
    if not read:
        raise UriError(f"no robot can be read; the first error: {faults[0][1]}")
    return make_population([row for row, _ in read], [robot for _, robot in read]), faults


def read_robots(rows: Sequence[Row], files: FileAccess) -> list[ReadRobot]:
    """Read robots, and measure the facts that their rows lack. Runs in a worker."""
    results = []
    for row in rows:
        try:
            robot = split_colours(read_robot_uri(row.uri, files))
            results.append(ReadRobot(_measured(row, robot), robot))
        except MorphgenError as error:
            results.append(ReadRobot(row, None, files.redact(error)))
    return results


def sample_robots(name: str, seed: int, rows: Sequence[Row], files: FileAccess) -> list[ReadRobot]:
    """Sample the robots of a grammar that rows list. Runs in a worker."""
    grammar, results = resolve_grammar(name, files), []
    for row in rows:
        try:
            sample = sample_robot(grammar, files.library, row.order, seed=seed)
            robot = split_colours(sample.robot)
            codes = sorted({finding.code for finding in sample.findings})
            row = replace(row, uri=f"{DERIVATION}{sample.derivation}", findings=tuple(codes))
            results.append(ReadRobot(_measured(row, robot), robot))
        except MorphgenError as error:
            results.append(ReadRobot(row, None, files.redact(error)))
    return results


def load_free_configurations(
    population: Population, workers: Workers, progress: Progress
) -> tuple[Array, NDArray[np.bool_]]:
    """Find random configurations without self-collision in the workers.

    Returns:
        Configurations, shape (NUM_POSES, n, J), the home configuration where none was found; and
        which robots have one, shape (n,).
    """
    numbered = _chunks(list(enumerate(population.robots)))
    calls = [workers.submit(free_configurations, chunk) for chunk in numbered]
    q = np.repeat(population.home[None], NUM_POSES, axis=0)
    found = np.zeros(len(population), dtype=np.bool_)
    for i, free in enumerate(_gather(calls, workers, len(population), progress)):
        if len(free):
            q[:, i, : free.shape[1]] = free[np.arange(NUM_POSES) % len(free)]
            found[i] = True
    return q, found


def free_configurations(robots: Sequence[tuple[int, Robot]]) -> list[Array]:
    """Return up to ``NUM_POSES`` free configurations of each robot, (k, dof). Runs in a worker.

    Those with every link above the ground come first, because the page shows a ground. A robot
    whose collision meshes cannot be read has none.
    """
    results = []
    for number, robot in robots:
        # The number of the robot is the seed, so that equal robots move differently.
        q = random_configurations(robot, _MAX_TRIES, np.random.default_rng(number))
        heights = forward_kinematics(robot, q)[..., 2, 3].min(axis=1)
        q = q[np.argsort(heights < -_GROUND_TOLERANCE, kind="stable")]
        free: list[Array] = []
        try:
            checker = SelfCollisionChecker(robot)
            for rows in np.split(q, range(2 * NUM_POSES, _MAX_TRIES, 2 * NUM_POSES)):
                free += list(rows[checker.free(rows)])
                if len(free) >= NUM_POSES:
                    break
        except MorphgenError:
            free = []
        results.append(np.array(free[:NUM_POSES]).reshape(min(len(free), NUM_POSES), robot.dof))
    return results


def load_map(
    population: Population, files: FileAccess, workers: Workers, progress: Progress
) -> Array:
    """Map the robots by the cosine of their tokens (see ``similarity``); shape (n, 2).

    Robots without tokens, such as those without a tool, are NaN.
    """
    max_links = default_max_links(len(robot.links) for robot in population.robots)
    calls = [
        workers.submit(token_rows, chunk, max_links, files) for chunk in _chunks(population.robots)
    ]
    tables = _gather(calls, workers, len(population), progress)
    points = np.full((len(population), 2), np.nan)
    known = [i for i, table in enumerate(tables) if table is not None]
    if not known:
        return points
    width = max(len(table) for table in tables if table is not None)
    features = np.zeros((len(known), width))
    for row, i in zip(features, known, strict=True):
        table = tables[i]
        assert table is not None
        row[: len(table)] = table
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    distances = np.maximum(1 - features @ features.T, 0.0)
    distances = (distances + distances.T) / 2
    np.fill_diagonal(distances, 0.0)
    points[known] = classical_mds(distances).points
    return points


def token_rows(robots: Sequence[Robot], max_links: int, files: FileAccess) -> list[Array | None]:
    """Return the tokens of robots as vectors, without joint positions. Runs in a worker.

    None for a robot that has no tokens.
    """
    results: list[Array | None] = []
    for robot in robots:
        try:
            source = with_library_meshes(robot, files.library)
            shapes = token_shapes(source, files.library_folders)
            results.append(compared_tokens(source, shapes, max_links=max_links).ravel())
        except MorphgenError:
            results.append(None)
    return results


def _measured(row: Row, robot: Robot) -> Row:
    """Return a row with the facts that it lacks."""
    facts: dict[str, object] = {}
    if row.dof is None:
        facts |= {"dof": robot.dof, "links": len(robot.links), "mass": robot.mass}
    if row.reach is None and has_tool(robot) and robot.dof:
        facts["reach"] = reach(robot)
    return replace(row, **facts)  # type: ignore[arg-type]


def _chunks(items: Sequence[T]) -> list[Sequence[T]]:
    return [items[i : i + _CHUNK] for i in range(0, len(items), _CHUNK)]


def _gather(
    calls: Sequence[Future[list[T]]], workers: Workers, total: int, progress: Progress
) -> list[T]:
    """Return the results of all calls in order."""
    results: list[T] = []
    for call in calls:
        chunk: list[T] = workers.result(call)
        results += chunk
        progress(len(results), total)
    return results
