"""Compare description, licences and difficulty of a release with what its split gives today."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from morphgen.benchmark.difficulty import RobotDifficulty, survey_difficulty, train_similarity
from morphgen.benchmark.difficulty_table import STRUCTURAL, nearest_column, structural_cells
from morphgen.benchmark.licences import licenced_parts
from morphgen.benchmark.release_file import (
    DIFFICULTY_FILE,
    LICENCES_FILE,
    RELEASE_FILE,
    read_release,
)
from morphgen.benchmark.similarity import MEASURES
from morphgen.benchmark.split import SIDES, Split, split_id
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.benchmark.survey import Fault, SplitSurvey, survey_split
from morphgen.errors import MorphgenError
from morphgen.formats.data_files import read_json, read_text
from morphgen.grammar.library import Library
from morphgen.processes import Progress, no_progress
from morphgen.typing import Array

TOLERANCE = 1e-3
"""Tolerance of the reach [m] and of similarities, which depend on primitives that may be fitted on
this machine, see ``verify.FITTED_TOLERANCE``."""
_MAX_SHOWN = 100
"""Largest number of characters of a cell in a message."""
_NUMBERS = ("reach", *MEASURES)
"""Columns that are compared with ``TOLERANCE``."""
_NEAREST = {nearest_column(name): name for name in MEASURES}
"""Measure by the column of its nearest train robot."""


def release_differences(
    folder: Path,
    split: Split,
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> Iterator[tuple[str, str]]:
    """Yield what a release states otherwise than its split: a file, and what is wrong with it.

    Args:
        folder: The unpacked release.
        split: Its split.
        library: The library of parts.
        jobs: Number of processes.
        progress: Receives the number of robots that are finished, and of all.
    """
    try:
        release = read_release(folder)
        if (release.name, release.id) != (split.name, split_id(split)):
            why = f"it is of split {release.name}, id {release.id}, not of {SPLIT_FILE}"
            yield RELEASE_FILE, why
        expected = [part.as_dict() for part in licenced_parts(split, library)]
        if _without_sources(read_json(folder / LICENCES_FILE)) != _without_sources(expected):
            yield LICENCES_FILE, "its licences are not those of the parts"
    except MorphgenError as error:
        yield RELEASE_FILE, str(error)
    except OSError as error:
        yield LICENCES_FILE, f"cannot be read: {error.strerror}"
    if (folder / DIFFICULTY_FILE).exists():  # releases of versions before 0.3 have none
        survey = survey_split(split, library, within_train=True, jobs=jobs, progress=progress)
        for why in _difficulty_differences(folder / DIFFICULTY_FILE, survey):
            yield DIFFICULTY_FILE, why


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
    pairs = zip((*split.train, *split.test), (*survey.train, *survey.test), strict=True)
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
    indices = [(side, i) for side in SIDES for i in range(len(split.side(side)))]
    for number, (line, row, (side, i)) in enumerate(zip(lines, rows, indices, strict=True), 2):
        if len(line) != len(header):
            yield f"line {number} has {len(line)} cells, not {len(header)}"
            continue
        similarity = dict(zip(names, train_similarity(survey, side, i), strict=True))
        for why in _row_differences(line, row, similarity):
            yield f"line {number}: {why}"


def _row_differences(
    line: Sequence[str], row: RobotDifficulty, similarity: Mapping[str, Array]
) -> Iterator[str]:
    """Yield how a line differs from a robot's row, given its similarity to every train robot."""
    for column, found, expected in zip(STRUCTURAL, line, structural_cells(row), strict=False):
        if found == expected or (column in _NUMBERS and _is_close(found, expected)):
            continue
        if column in _NEAREST and found in similarity:
            # Of nearly equal train robots another one may be the nearest on another machine.
            measure, value = _NEAREST[column], similarity[found]
            best = row.nearest.get(measure)
            if best and abs(value[tuple(MEASURES).index(measure)] - best.value) <= TOLERANCE:
                continue
        yield f"{column} of {row.robot} is {found[:_MAX_SHOWN]!r}, not {expected!r}"


def _is_close(found: str, expected: str) -> bool:
    """Return whether two texts are numbers that differ by ``TOLERANCE`` or less."""
    try:
        return abs(float(found) - float(expected)) <= TOLERANCE
    except ValueError:
        return False
