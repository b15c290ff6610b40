"""Verify that a split file or split folder matches the robots that its derivations give today."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.licences import licenced_parts
from morphgen.benchmark.release import (
    DIFFICULTY_FILE,
    LICENCES_FILE,
    RELEASE_FILE,
    is_release,
    opened_folder,
    read_release,
)
from morphgen.benchmark.split_folder import (
    BUILD_FILE,
    ROBOTS_DIR,
    ROBOTS_FILE,
    SPLIT_FILE,
    SUMS_FILE,
    TOKENS_FILE,
    RobotData,
    differences,
    is_archive,
    read_records,
    read_settings,
    read_sums,
    read_tokens,
    require_split_folder,
    robot_data,
    robot_paths,
    robot_records,
    same,
    token_tables,
)
from morphgen.benchmark.survey import (
    STRUCTURAL,
    Fault,
    RobotDifficulty,
    SplitSurvey,
    difficulty_cells,
    nearest_column,
    survey_difficulty,
    survey_split,
    train_similarity,
)
from morphgen.encoding.similarity import MEASURES
from morphgen.encoding.tokens import GEOMETRY, LAYOUT, SHAPE_POSE, TOLERANCE
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats.data_files import read_json, read_text
from morphgen.formats.files import file_sha256, folder_hashes
from morphgen.grammar.library import Library
from morphgen.processes import parallel_map
from morphgen.splits.split import Member, Split, compose_member, sided_members, split_id
from morphgen.splits.split_file import find_split, read_split_file
from morphgen.typing import Array

FITTED_TOLERANCE = 1e-3
"""Tolerance of what depends on primitives that may be fitted on this machine: the token numbers of
a link's primitive, the reach [m] and similarities."""
_MAX_SHOWN = 100  # largest number of characters of a cell in a message
_NUMBERS = ("reach", *MEASURES)  # columns that are compared with `FITTED_TOLERANCE`
_NEAREST = {nearest_column(name): name for name in MEASURES}
"""Measure by the column of its nearest train robot."""


@dataclass(frozen=True)
class Difference:
    """One difference between a split and its robots."""

    where: str  # name of the robot, or of a file
    why: str


def _release_differences(
    folder: Path, split: Split, library: Library, jobs: int
) -> Iterator[Difference]:
    """Yield what a release states otherwise than its split."""
    try:
        release = read_release(folder)
        if (release.name, release.id) != (split.name, split_id(split)):
            why = f"it is of split {release.name}, id {release.id}, not of {SPLIT_FILE}"
            yield Difference(RELEASE_FILE, why)
        expected = [part.as_dict() for part in licenced_parts(split, library)]
        if _without_sources(read_json(folder / LICENCES_FILE)) != _without_sources(expected):
            yield Difference(LICENCES_FILE, "its licences are not those of the parts")
    except MorphgenError as error:
        yield Difference(RELEASE_FILE, str(error))
    if (folder / DIFFICULTY_FILE).exists():  # releases of versions before 0.3 have none
        survey = survey_split(split, library, pairs="train", jobs=jobs)
        for why in _difficulty_differences(folder / DIFFICULTY_FILE, survey):
            yield Difference(DIFFICULTY_FILE, why)


def _without_sources(parts: Any) -> list[Any]:  # noqa: ANN401
    """Return the content of ``licences.json`` without texts that a new version may word anew."""
    entries = parts if isinstance(parts, list) else [parts]
    return [
        {key: entry[key] for key in entry if key != "source"} if isinstance(entry, dict) else entry
        for entry in entries
    ]


def _difficulty_differences(path: Path, survey: SplitSurvey) -> Iterator[str]:
    """Yield how the structural columns of ``difficulty.csv`` differ from those of a survey."""
    split = survey.split
    pairs = zip((*split.train, *split.test), survey.robots, strict=True)
    if any(isinstance(each, Fault) or each.robot_hash != m.robot_hash for m, each in pairs):
        return  # robots differ from the split: the caller of this module lists them
    try:
        header, *lines = csv.reader(read_text(path).splitlines() or [""])
    except (MorphgenError, OSError, csv.Error) as error:
        yield f"cannot be read: {error}"
        return
    if tuple(header[: len(STRUCTURAL)]) != STRUCTURAL:
        yield f"it has other columns; expected {', '.join(STRUCTURAL)}"
        return
    rows = survey_difficulty(survey)
    if len(lines) != len(rows):
        yield f"it has {len(lines)} robots, not {len(rows)}"
        return
    names = [member.name for member in split.train]
    for i, (cells, row) in enumerate(zip(lines, rows, strict=True)):
        if len(cells) != len(header):
            yield f"line {i + 2} has {len(cells)} cells, not {len(header)}"
            continue
        line = dict(zip(header, cells, strict=True))
        similarity = dict(zip(names, train_similarity(survey, i), strict=True))
        for why in _row_differences(line, row, similarity):
            yield f"line {i + 2}: {why}"


def _row_differences(
    line: Mapping[str, str], row: RobotDifficulty, similarity: Mapping[str, Array]
) -> Iterator[str]:
    """Yield how a line differs from a robot's row, given its similarity to every train robot."""
    cells = difficulty_cells(row)
    for column in STRUCTURAL:
        found, expected = line[column], cells.get(column, "")
        if found == expected:
            continue
        with suppress(ValueError):  # of a cell that is no number
            if column in _NUMBERS and abs(float(found) - float(expected)) <= FITTED_TOLERANCE:
                continue
        if column in _NEAREST and found in similarity:
            # Of nearly equal train robots another one may be the nearest on another machine.
            measure, value = _NEAREST[column], similarity[found]
            best = row.nearest.get(measure)
            if best and abs(value[tuple(MEASURES).index(measure)] - best.value) <= FITTED_TOLERANCE:
                continue
        yield f"{column} of {row.robot} is {found[:_MAX_SHOWN]!r}, not {expected!r}"


@dataclass(frozen=True)
class Verification:
    """Result of a verification."""

    split: Split
    id: str  # id of the split, computed from its robots
    differences: tuple[Difference, ...]
    content: str = ""  # for a release: SHA-256 of `SHA256SUMS`, which lists all files


def verify(name_or_path: str | Path, library: Library, *, jobs: int = 1) -> Verification:
    """Compare a split with the robots that its derivations give today.

    The id of the split and the hash of each robot are tested. In a split folder every file is
    compared with ``SHA256SUMS`` and with the robot that its derivation gives, too; in a release
    also its description, its licences and its difficulty.
    """
    folder = Path(name_or_path)
    if is_archive(folder):
        with opened_folder(folder) as unpacked:
            return verify(unpacked, library, jobs=jobs)
    is_built = folder.is_dir()
    if is_built:
        require_split_folder(folder)
    path = folder / SPLIT_FILE if is_built else find_split(name_or_path)
    split_file = read_split_file(path)
    computed_id = split_id(split_file.split)
    differences = []
    if split_file.id != computed_id:
        why = f"its id is {split_file.id}, but that of its robots is {computed_id}"
        differences.append(Difference(str(path), why))
    if is_built:
        differences += _folder_differences(folder, split_file.split, library, jobs)
        if is_release(folder):
            differences += _release_differences(folder, split_file.split, library, jobs)
    else:
        differences += compare_robots(split_file.split, library, jobs=jobs)
    content = file_sha256(folder / SUMS_FILE) if is_built and is_release(folder) else ""
    return Verification(split_file.split, computed_id, tuple(differences), content)


def require_unchanged(folder: Path, name: str) -> None:
    """Require that the files of a split folder are those that ``SHA256SUMS`` lists."""
    changed = list(_file_differences(folder))
    if changed:
        more = f" (and {len(changed) - 1} more)" if len(changed) > 1 else ""
        first = f"{changed[0].where}: {changed[0].why}"
        raise BenchmarkError(f"{name}: {first}{more}; get it again, or see morphgen split verify")


def compare_robots(split: Split, library: Library, *, jobs: int = 1) -> tuple[Difference, ...]:
    """Compose every robot of a split and compare its hash; see ``verify``."""
    return tuple(_robot_differences(split, _inspect(split, library, None, jobs)))


_Inspection = tuple[list[str], RobotData | None]
"""The differences of a robot and, in a split folder, its data."""


@dataclass(frozen=True, eq=False)
class _BuiltFolder:
    """A split folder whose robots are compared."""

    path: Path
    light: bool
    robot_paths: Mapping[str, str]  # folder of each robot by its hash


def _inspect_member(
    library: Library, max_links: int, built: _BuiltFolder | None, member: Member
) -> _Inspection:
    """Compose a member, and compare it with its folder; runs in worker processes."""
    try:
        robot = compose_member(member, library)
        if built is None:
            return [], None
        folder = built.path / built.robot_paths[member.robot_hash]
        # Members with the same robot share the folder of the first one, which is compared.
        is_first = folder.name == member.name
        lines = differences(folder, robot, light=built.light) if is_first else []
        return lines, robot_data(robot, library, max_links)
    except MorphgenError as error:
        return [str(error)], None


def _inspect(
    split: Split, library: Library, built: _BuiltFolder | None, jobs: int
) -> dict[tuple[str, str], _Inspection]:
    """Inspect each different robot once; return the results by derivation and hash."""
    members = [member for _, member in reversed(sided_members(split))]  # the first one stays last
    firsts = {(member.derivation, member.robot_hash): member for member in members}
    inspect = partial(_inspect_member, library, split.max_links, built)
    return dict(zip(firsts, parallel_map(inspect, list(firsts.values()), jobs), strict=True))


def _robot_differences(
    split: Split, inspected: Mapping[tuple[str, str], _Inspection]
) -> Iterator[Difference]:
    for _, member in sided_members(split):
        for why in inspected[member.derivation, member.robot_hash][0]:
            yield Difference(member.name, why)


def _folder_differences(
    folder: Path, split: Split, library: Library, jobs: int
) -> Iterator[Difference]:
    build = read_settings(folder / BUILD_FILE)
    if build.split != split_id(split):
        yield Difference(BUILD_FILE, f"it is of split {build.split}, not of {SPLIT_FILE}")
    try:
        paths = robot_paths(split)
    except BenchmarkError as error:
        yield Difference(SPLIT_FILE, str(error))
        return
    files = list(_file_differences(folder))
    yield from files
    inspected = _inspect(split, library, _BuiltFolder(folder, build.light, paths), jobs)
    # A changed file explains the differences of its robot.
    explained = {difference.where for difference in files}
    for difference in _robot_differences(split, inspected):
        if difference.where not in explained:
            yield difference
    known = {
        robot_hash: data for (_, robot_hash), (_, data) in inspected.items() if data is not None
    }
    if known.keys() >= paths.keys():
        yield from _record_differences(folder / ROBOTS_FILE, split, known)
        yield from _token_differences(folder / TOKENS_FILE, split, known)


def _file_differences(folder: Path) -> Iterator[Difference]:
    """Yield files that differ from ``SHA256SUMS``; a file of a robot is listed under its name."""
    expected = read_sums(folder / SUMS_FILE)
    actual = folder_hashes(folder)
    for name in sorted((expected.keys() | actual.keys()) - {SUMS_FILE}):
        if name not in actual:
            why = f"is missing, but {SUMS_FILE} names it"
        elif name not in expected:
            why = f"is not named by {SUMS_FILE}"
        elif actual[name] != expected[name]:
            why = f"is not what {SUMS_FILE} was written for"
        else:
            continue
        parent, _, rest = name.partition("/")
        robot, _, file = rest.partition("/")
        where, path = (robot, file) if parent == ROBOTS_DIR and file else (name, name)
        yield Difference(where, f"file {path} {why}")


def _record_differences(
    path: Path, split: Split, known: Mapping[str, RobotData]
) -> Iterator[Difference]:
    """Yield entries of ``robots.jsonl`` that differ from the robots."""
    try:
        stored = read_records(path)
    except MorphgenError as error:
        yield Difference(path.name, str(error))
        return
    expected = robot_records(split, known)
    if len(stored) != len(expected):
        yield Difference(path.name, f"it has {len(stored)} robots, not {len(expected)}")
        return
    for i, (line, computed) in enumerate(zip(stored, expected, strict=True), 1):
        keys = sorted(line.keys() | computed.keys())
        wrong = [key for key in keys if not same(line.get(key), computed.get(key))]
        for key in wrong:
            why = f"{path.name}:{i}: {key} is {line.get(key)!r}, not {computed.get(key)!r}"
            yield Difference(str(computed["name"]), why)


def _token_differences(
    path: Path, split: Split, known: Mapping[str, RobotData]
) -> Iterator[Difference]:
    """Yield robots whose rows of ``tokens.npz`` differ from their tokens."""
    try:
        names, tokens, mask = read_tokens(path)
    except MorphgenError as error:
        yield Difference(path.name, str(error))
        return
    computed, computed_mask = token_tables(split, known)
    expected = [member.name for _, member in sided_members(split)]
    if names != expected or tokens.shape != computed.shape:
        yield Difference(path.name, f"it is not of the {len(expected)} robots of {SPLIT_FILE}")
        return
    # Primitives of meshes are fitted here, in the last bits otherwise than where it was built.
    errors = np.abs(tokens - computed)
    for shape in (GEOMETRY, SHAPE_POSE):
        errors[..., shape.columns] *= TOLERANCE / FITTED_TOLERANCE
    for i, name in enumerate(expected):
        if (mask[i] != computed_mask[i]).any():
            yield Difference(name, f"{path.name}: its mask is not that of its links")
        wrong = ~(errors[i] <= TOLERANCE)  # NaN is wrong, too
        if wrong.any():
            link, column = np.argwhere(wrong)[0].tolist()
            token_field = next(entry for entry in LAYOUT if column < entry.columns.stop)
            yield Difference(
                name, f"{path.name}: {token_field.name} of link {link} is not the robot's"
            )
