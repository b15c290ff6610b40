"""Results of baselines on every robot of a split, for the table of its difficulty."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.difficulty import BaselineResult, BaselineResults
from morphgen.benchmark.split import Side, Split, split_id
from morphgen.errors import BenchmarkError, FormatError, nearest
from morphgen.formats.data_files import read_json
from morphgen.rl.baselines import BASELINES
from morphgen.rl.leaderboard import random_scores, relative_scores
from morphgen.rl.reference_scores import References
from morphgen.rl.study import SCORES
from morphgen.rl.study_cells import StoredCell, require_all_robots, stored_cell, stored_split
from morphgen.tasks.eval_protocol import tasks_of_split


def submitted_results(references: References) -> BaselineResults:
    """Return the results of the baselines with a submission, in the order of ``BASELINES``.

    Args:
        references: Reference scores of a release.
    """
    random = random_scores(references.random) if references.random else None
    submissions = {name: references.baseline(name) for name in BASELINES}
    return {
        name: {
            (robot.side, robot.robot): BaselineResult(
                float(np.mean(relative_scores(robot, random))), float(np.mean(robot.success))
            )
            for robot in submission.robots
        }
        for name, submission in submissions.items()
        if submission is not None
    }


def study_results(folder: Path, split: Split) -> BaselineResults:
    """Return the results of the baselines of a study, in the order of ``BASELINES``.

    Args:
        folder: Output folder of the study; the cells of the split are in ``folder/SPLIT/BASELINE``.
        split: The split.

    Raises:
        BenchmarkError: If there is no cell of a baseline on this split, a cell is malformed, of
            other robots, or of another evaluation than the others.
    """
    cells: dict[str, StoredCell] = {}
    results: dict[str, dict[tuple[Side, str], BaselineResult]] = {}
    for name, file in _cell_files(folder, split):
        data = _read(file)
        stored, expected = stored_split(file, data), split_id(split)
        if stored != expected:
            raise BenchmarkError(
                f"{file}: of other robots: split id {stored or '(none)'}; expected {expected}, "
                f"that of {split.name}; name a study of these robots"
            )
        cells[name] = stored_cell(file, data)
        scores = cells[name].scores.get(name, ())
        if not scores:
            raise BenchmarkError(
                f"{file}: no scores of {name}{nearest(name, cells[name].scores)}; run the study "
                "again"
            )
        _require_same_evaluation(cells, name, file, split)
        require_all_robots(scores, split, file)
        results[name] = {
            (each.side, each.robot): BaselineResult(each.score, each.success) for each in scores
        }
    return results


def _cell_files(folder: Path, split: Split) -> Iterator[tuple[str, Path]]:
    """Yield the files of a split's cells by the name of the baseline, in order; at least one."""
    if not folder.is_dir():
        raise BenchmarkError(
            f"{folder}: no such folder; expected the output folder of morphgen study"
        )
    files = {name: folder / split.name / name / SCORES for name in BASELINES}
    existing = {name: file for name, file in files.items() if file.is_file()}
    if not existing:
        others = {
            file.parent.parent.relative_to(folder).as_posix()
            for name in BASELINES
            for file in folder.rglob(f"{name}/{SCORES}")
        }
        raise BenchmarkError(
            f"{folder}: no scores of baselines on split {split.name!r}, such as "
            f"{next(iter(files.values()))}{nearest(split.name, others)}"
        )
    yield from existing.items()


def _read(file: Path) -> Any:  # noqa: ANN401
    try:
        return read_json(file)
    except OSError as error:
        raise BenchmarkError(f"{file}: cannot be read: {error.strerror}") from error
    except FormatError as error:
        raise BenchmarkError(str(error)) from error


def _require_same_evaluation(
    cells: dict[str, StoredCell], name: str, file: Path, split: Split
) -> None:
    """Require that a cell has the evaluation of the first one: other scores do not compare."""
    first = next(iter(cells))
    expected, found = (_evaluation(cells[each], split) for each in (first, name))
    for key, value in expected.items():
        if found[key] != value:
            raise BenchmarkError(
                f"{file}: evaluation: {key} {found[key]!r}; expected {value!r}, as of {first}; "
                "scores of different evaluations do not compare"
            )


def _evaluation(cell: StoredCell, split: Split) -> dict[str, Any]:
    """Return all that the scores of a split depend on, with the constants of its tasks."""
    tasks = tasks_of_split(split)
    constants = cell.goals.as_data(tasks)
    return {
        "sim": cell.simulator,
        "episodes": cell.episodes,
        "seed": cell.seed,
        "goal_seed": cell.goals.seed,
        **{f"{task}.{key}": value for task in tasks for key, value in constants[task].items()},
    }
