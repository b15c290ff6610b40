"""Reference scores of a release: of submissions, which it holds, and of cells of studies."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from morphgen.benchmark.difficulty import BaselineResult, BaselineResults
from morphgen.benchmark.release_file import SCORES_FILE, SUBMISSIONS_DIR
from morphgen.benchmark.split import SIDES, Side, Split, split_id
from morphgen.errors import BenchmarkError, FormatError, nearest
from morphgen.formats.data_files import read_json
from morphgen.formats.records import Record, read_record
from morphgen.grammar.library import Library
from morphgen.rl.baselines import BASELINES
from morphgen.rl.scores.leaderboard import (
    Row,
    SideScore,
    random_scores,
    relative_scores,
    score_submission,
)
from morphgen.rl.scores.scores import Score, finite_or_none
from morphgen.rl.scores.study import (
    SCORES,
    StoredCell,
    acting,
    require_all_robots,
    stored_cell,
    stored_split,
)
from morphgen.rl.scores.submission import (
    Submission,
    check_submission,
    is_submission,
    json_files,
    read_submission,
    require_rules,
    require_same_random,
    require_series,
    submission_from,
    submission_text,
)
from morphgen.tasks.goals.eval_protocol import EvalProtocol, expected_robots, tasks_of_split

FORMAT = 1
RANDOM = "random"
"""Method whose episodes all scores of a release are relative to."""


class _ScoresFile(Record, frozen=True):
    """The content of ``scores.json``: rows of methods whose episodes the release does not hold."""

    format: int
    rows: tuple[Row, ...]


@dataclass(frozen=True, eq=False)
class References:
    """The reference scores of a release."""

    rows: tuple[Row, ...] = ()
    """Rows of studies."""
    submissions: tuple[Submission, ...] = ()

    @property
    def random(self) -> Submission | None:
        """The submission of the random policy, if the release holds one."""
        return self.baseline(RANDOM)

    def baseline(self, name: str) -> Submission | None:
        """Return the submission of a baseline, if the release holds one."""
        return next((each for each in self.submissions if _is_baseline(each, name)), None)

    def all_rows(self) -> list[Row]:
        """Return the scores of the submissions, and the rows of other runs in studies."""
        random = random_scores(self.random) if self.random else None
        scored = [score_submission(each, random, "reference") for each in self.submissions]
        known = {row.run for row in scored}
        others = (row for row in self.rows if row.run not in known)
        return [*scored, *others]


def collect_references(
    paths: Sequence[Path],
    split: Split,
    protocol: EvalProtocol,
    library: Library,
    *,
    jobs: int = 1,
) -> References:
    """Read the reference scores of a new release from files, and check them."""
    submissions: dict[str, Submission] = {}
    cells: list[_Cell] = []
    expected = None
    for path in paths:
        found = list(_files_below(path))
        before = len(submissions) + len(cells)
        for file, data in found:
            if not is_submission(data):
                cells += _cells(file, data, split, protocol)
                continue
            submission = submission_from(data, file)
            if submission.split.id != split_id(split) and file != path:
                continue
            expected = expected or expected_robots(split, protocol, library, jobs=jobs)
            check_submission(submission, str(file), split, protocol, expected, version("morphgen"))
            if _is_baseline(submission, RANDOM) and len(submission.robots) < len(expected):
                raise BenchmarkError(
                    f"{file}: {RANDOM}: the train robots are missing, to whose episodes the scores "
                    "of other submissions are relative; evaluate it on both sides"
                )
            name = _path(submission)
            if name in submissions and submissions[name] != submission:
                raise BenchmarkError(f"{file}: another submission of {submission.method} is there")
            submissions[name] = submission
        if len(submissions) + len(cells) == before:
            raise BenchmarkError(f"{path}: no scores of split {split.name}, id {split_id(split)}")
    # Sorted, so that the order of the paths does not change the files.
    submissions = dict(sorted(submissions.items()))
    rows = sorted(_rows(cells), key=lambda row: (row.method, row.mode, row.finetuned))
    references = References(tuple(rows), tuple(submissions.values()))
    if references.random is None:
        require_same_random([*submissions.items()])
    return references


def reference_files(references: References) -> dict[str, bytes]:
    """Return the files of a release with reference scores, by path."""
    submissions = references.submissions
    data = {
        "format": FORMAT,
        "rows": msgspec.to_builtins(references.rows),
        "of_submissions": msgspec.to_builtins(references.all_rows()[: len(submissions)]),
    }
    files = {_path(each): submission_text(each).encode() for each in submissions}
    return files | {SCORES_FILE: (json.dumps(data, indent=2) + "\n").encode()}


def read_references(folder: Path) -> References:
    """Read the reference scores of a release; they were checked when it was made."""
    path = folder / SCORES_FILE
    if not path.is_file():
        return References()
    try:
        data = read_json(path)
    except (OSError, FormatError) as error:
        raise BenchmarkError(f"{path}: cannot be read: {error}") from error
    if isinstance(data, dict):
        data.pop("of_submissions", None)  # for readers: they are computed again
    stored = read_record(data, _ScoresFile, str(path), BenchmarkError)
    files = sorted((folder / SUBMISSIONS_DIR).glob("*.json"))
    return References(stored.rows, tuple(read_submission(file) for file in files))


@dataclass(frozen=True, eq=False)
class _Cell:
    """The scores of a cell of a study in one mode."""

    file: Path
    method: str
    mode: str
    finetuned: int
    """Transitions of fine-tuning on the test robots."""
    seed: int | None
    scores: tuple[Score, ...]


def _files_below(path: Path) -> Iterator[tuple[Path, Any]]:
    """Yield a JSON file, or the submissions and scores of studies below a folder."""
    for file, data in json_files(path, f"**/{SCORES}", "*.json"):
        if file == path or is_submission(data) or file.name == SCORES:
            yield file, data


def _cells(
    file: Path,
    data: Any,  # noqa: ANN401
    split: Split,
    protocol: EvalProtocol,
) -> Iterator[_Cell]:
    """Yield the scores of a cell by mode; nothing if it is of another split."""
    if stored_split(file, data) != split_id(split):
        return
    cell = stored_cell(file, data)
    if cell.version is not None:
        require_series(cell.version, version("morphgen"), str(file))
    try:
        found = EvalProtocol(cell.simulator, cell.episodes, cell.seed, cell.goals)
    except BenchmarkError as error:
        raise BenchmarkError(f"{file}: evaluation: {error}") from error
    require_rules(found.as_data(split), protocol.as_data(split), str(file))
    for records in cell.scores.values():
        require_all_robots(records, split, file)
    parent = file.parent.name
    is_seed = parent.removeprefix("seed").isdecimal() and parent.startswith("seed")
    seed = int(parent.removeprefix("seed")) if is_seed else None
    method = file.parent.parent.name if is_seed else parent
    for name, records in cell.scores.items():
        mode, finetuned = ("", 0) if name in BASELINES else acting(name)
        yield _Cell(file, method, mode, finetuned, seed, records)


def _rows(cells: Sequence[_Cell]) -> list[Row]:
    """Return a row per method, mode and fine-tuning: means over seeds and robots."""
    groups: dict[tuple[str, str, int], dict[int | None, _Cell]] = {}
    for cell in cells:
        group = groups.setdefault((cell.method, cell.mode, cell.finetuned), {})
        other = group.setdefault(cell.seed, cell)
        if other.scores != cell.scores:
            raise BenchmarkError(f"{cell.file}: other scores of the same run are in {other.file}")
    rows = []
    for (method, mode, finetuned), group in groups.items():
        scores = [score for cell in group.values() for score in cell.scores]
        pairs = {(s.side, s.task): None for side in SIDES for s in scores if s.side == side}
        sides = []
        for side, task in pairs:
            own = [score for score in scores if (score.side, score.task) == (side, task)]
            # With one robot and one seed, its interval over episodes is that of the side.
            ends = finite_or_none((own[0].low, own[0].high)) if len(own) == 1 else (None, None)
            sides.append(
                SideScore(
                    side,
                    task,
                    len({score.robot for score in own}),
                    float(np.mean([score.score for score in own])),
                    float(np.mean([score.success for score in own])),
                    *ends,
                )
            )
        seeds = tuple(sorted(seed for seed in group if seed is not None))
        episodes = min(score.episodes for score in scores)
        rows.append(Row(method, "study", mode, seeds, episodes, tuple(sides), finetuned))
    return rows


def _is_baseline(submission: Submission, name: str) -> bool:
    """Return whether a submission is of a baseline, not of a policy with its name."""
    is_trained = submission.mode != "" or submission.training_seed is not None
    return submission.method == name and not is_trained


def _path(submission: Submission) -> str:
    """Return the path in a release: a file name of letters, digits and a few signs."""
    words = [submission.method]
    if submission.mode == "stochastic":
        words.append(submission.mode)
    if submission.finetuned:
        words.append(f"fine-tuned-{submission.finetuned}")
    if submission.training_seed is not None:
        words.append(f"seed{submission.training_seed}")
    return f"{SUBMISSIONS_DIR}/{re.sub(r'[^A-Za-z0-9+_-]', '_', '-'.join(words))}.json"


def submitted_results(references: References) -> BaselineResults:
    """Return the results of the baselines with a submission, in the order of ``BASELINES``."""
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
    """Return the results of the baselines of a study, in the order of ``BASELINES``."""
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
