"""Scores of submissions, computed from the episodes: their ranking, and reference scores.

Reference scores are those of submissions in a release, and of the baselines of a study.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from tabulate import tabulate

from morphgen.benchmark.eval_protocol import EvalProtocol, expected_robots
from morphgen.benchmark.release import SCORES_FILE, SUBMISSIONS_DIR
from morphgen.benchmark.scores.episode_table import EPISODES, name_of, read_submissions, read_table
from morphgen.benchmark.scores.submission import (
    Submission,
    check_submission,
    read_submission,
    require_comparable,
    require_same_random,
    submission_text,
)
from morphgen.benchmark.survey import BaselineResult, BaselineResults
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.library import Library
from morphgen.rl.baselines import BASELINES
from morphgen.rl.scores import SIDES as SIDE_NAMES
from morphgen.rl.scores import (
    Interval,
    RandomScores,
    RobotOutcomes,
    episode_interval,
    finite_or_none,
    relative_scores,
    score_decimals,
    success_interval,
)
from morphgen.splits.split import SIDES, Side, Split, split_id
from morphgen.tasks.registry import TASKS

Source = Literal["submission", "reference"]


@dataclass(frozen=True)
class SideScore:
    """Mean result over the robots of a side that do one task."""

    side: Side
    task: str
    robots: int
    score: Interval  # mean score, relative to the random policy where the task wants it
    success: Interval  # mean success rate, 0 to 1, with its Wilson interval over all episodes

    def as_data(self) -> dict[str, Any]:
        """Return JSON values, with null for ends of intervals that are not known."""
        score, success = self.score, self.success
        values: dict[str, Any] = {"side": self.side, "task": self.task, "robots": self.robots}
        values |= {"score": score.value, "success": success.value, "low": score.low}
        values |= {"high": score.high, "success_low": success.low, "success_high": success.high}
        return dict(finite_or_none(values))


@dataclass(frozen=True)
class Row:
    """A method in a ranking."""

    method: str
    source: Source  # `submission`; or `reference`, a submission in a release
    mode: str
    seeds: tuple[int, ...]  # seeds of the training; empty for a baseline
    episodes: int  # episodes per robot
    sides: tuple[SideScore, ...]
    finetuned: int = 0  # transitions of fine-tuning on the test robots

    @property
    def label(self) -> str:
        """Method, and how the policy acts and was fine-tuned if that is not the usual way."""
        remarks = ["stochastic"] if self.mode == "stochastic" else []
        if self.finetuned:
            remarks.append(f"fine-tuned {self.finetuned:,}")
        return f"{self.method} ({', '.join(remarks)})" if remarks else self.method

    def group(self, side: Side, task: str) -> SideScore | None:
        """Return the result of a side at a task."""
        return next((s for s in self.sides if (s.side, s.task) == (side, task)), None)


def score_submission(
    submission: Submission, random: RandomScores | None = None, source: Source = "submission"
) -> Row:
    """Compute the scores of a submission that was checked."""
    groups: dict[tuple[Side, str], list[RobotOutcomes]] = {}
    for outcomes in sorted(submission.robots, key=lambda robot: SIDES.index(robot.side)):
        groups.setdefault((outcomes.side, outcomes.task), []).append(outcomes)
    sides = []
    for (side, task), robots in groups.items():
        successes = [each.success for each in robots]
        score = episode_interval(
            [relative_scores(each, random) for each in robots],
            successes,
            relative=TASKS[task].relative_to_random,
        )
        success = success_interval(list(map(np.mean, successes)), list(map(len, successes)))
        sides.append(SideScore(side, task, len(robots), score, success))
    seed = submission.training_seed
    return Row(
        submission.method,
        source,
        submission.mode,
        () if seed is None else (seed,),
        min(len(each.score) for each in submission.robots),
        tuple(sides),
        submission.finetuned,
    )


def random_scores(submission: Submission) -> RandomScores:
    """Return the scores of the random policy's episodes in a submission."""
    return {(each.side, each.robot): each.random_score for each in submission.robots}


def ranked(rows: Sequence[Row]) -> list[Row]:
    """Return rows by their result on the test robots, the best first.

    It is the mean score if the test robots have one task; scores of different tasks cannot be
    added, so with several tasks it is the mean success rate. Rows without all of these tasks come
    last.
    """
    tasks = {side.task for row in rows for side in row.sides if side.side == "test"}

    def result(row: Row) -> float:
        test = [side for side in row.sides if side.side == "test"]
        if not test or len(test) < len(tasks):
            return -math.inf
        if len(tasks) == 1:
            return test[0].score.value
        robots = sum(side.robots for side in test)
        return sum(side.success.value * side.robots for side in test) / robots

    return sorted(rows, key=result, reverse=True)


def ranking_table(rows: Sequence[Row], style: str = "simple") -> str:
    """Return the ranking as a table; ``style`` is one of tabulate's."""
    pairs = {(side.side, side.task): None for row in rows for side in row.sides}
    groups = sorted(pairs, key=lambda pair: (pair[0] != "test", pair[1]))
    headers = ["rank", "method", "from", "seeds"]
    for side, task in groups:
        headers += [f"{SIDE_NAMES[side]} {task}", "95%", "success"]
    decimals = {}
    for group in groups:
        scores = [row.group(*group) for row in rows]
        decimals[group] = score_decimals(side.score.value for side in scores if side is not None)
    lines = []
    for rank, row in enumerate(ranked(rows), 1):
        cells = [str(rank), row.label, row.source, ", ".join(map(str, row.seeds)) or "-"]
        for side, task in groups:
            cells += _cells(row.group(side, task), decimals[side, task])
        lines.append([*cells, str(row.episodes)])
    return tabulate(lines, [*headers, "episodes"], tablefmt=style, disable_numparse=True)


def ranking_data(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows for JSON, in their order."""
    return [
        {**vars(row), "seeds": list(row.seeds), "sides": [side.as_data() for side in row.sides]}
        for row in rows
    ]


def _cells(side: SideScore | None, decimals: int) -> list[str]:
    if side is None:
        return ["-", "", ""]
    form = f".{decimals}f"
    return [f"{side.score.value:{form}}", side.score.ends(form), side.success.as_percent()]


FORMAT = 2
RANDOM = "random"  # method whose episodes all scores of a release are relative to


@dataclass(frozen=True, eq=False)
class References:
    """The reference scores of a release."""

    submissions: tuple[Submission, ...] = ()

    @property
    def random(self) -> RandomScores | None:
        """Scores of the random policy, if the release holds a submission of it."""
        baselines = (each for each in self.submissions if _is_baseline(each, RANDOM))
        return next(map(random_scores, baselines), None)

    def rows(self) -> list[Row]:
        """Return the scores of the submissions."""
        return [score_submission(each, self.random, "reference") for each in self.submissions]

    def results(self) -> BaselineResults:
        """Return the results of the baselines, in the order of ``BASELINES``."""
        return _baseline_results(self.submissions, self.random)


def collect_references(
    paths: Sequence[Path],
    split: Split,
    protocol: EvalProtocol,
    library: Library,
    *,
    jobs: int = 1,
) -> References:
    """Read the reference scores of a new release from submissions and studies, and check them."""
    submissions: dict[str, Submission] = {}
    expected = None
    for path in paths:
        before = len(submissions)
        for where, each in read_submissions([path]).items():
            if each.split.id != split_id(split) and where != str(path):
                continue
            expected = expected or expected_robots(split, protocol, library, jobs=jobs)
            check_submission(each, where, split, protocol, expected, version("morphgen"))
            if _is_baseline(each, RANDOM) and len(each.robots) < len(expected):
                raise BenchmarkError(
                    f"{where}: {RANDOM}: the train robots are missing, to whose episodes the "
                    "scores of other submissions are relative; evaluate it on both sides"
                )
            submission = msgspec.structs.replace(each, config=None)
            if submissions.setdefault(_path(submission), submission) != submission:
                raise BenchmarkError(f"{where}: another submission of {each.method} is there")
        if len(submissions) == before:
            raise BenchmarkError(f"{path}: no scores of split {split.name}, id {split_id(split)}")
    # Sorted, so that the order of the paths does not change the files.
    references = References(tuple(submissions[name] for name in sorted(submissions)))
    if references.random is None:
        require_same_random([*submissions.items()])
    return references


def reference_files(references: References) -> dict[str, bytes]:
    """Return the files of a release with reference scores, by path."""
    files = {_path(each): submission_text(each).encode() for each in references.submissions}
    data = {"format": FORMAT, "rows": ranking_data(references.rows())}
    return files | {SCORES_FILE: (json.dumps(data, indent=2) + "\n").encode()}


def read_references(folder: Path) -> References:
    """Read the reference scores of a release; they were checked when it was made."""
    files = sorted((folder / SUBMISSIONS_DIR).glob("*.json"))
    return References(tuple(read_submission(file) for file in files))


def _is_baseline(submission: Submission, *names: str) -> bool:
    """Return whether a submission is of a baseline, not of a policy with its name."""
    is_trained = submission.mode != "" or submission.training_seed is not None
    return submission.method in names and not is_trained


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


def _baseline_results(
    submissions: Sequence[Submission], random: RandomScores | None
) -> BaselineResults:
    own = {name: each for name in BASELINES for each in submissions if _is_baseline(each, name)}
    return {
        name: {
            (robot.side, robot.robot): BaselineResult(
                float(np.mean(relative_scores(robot, random))), float(np.mean(robot.success))
            )
            for robot in submission.robots
        }
        for name, submission in own.items()
    }


def study_results(folder: Path, split: Split) -> BaselineResults:
    """Return the results of the baselines of a study, in the order of ``BASELINES``."""
    table = folder / EPISODES
    if not table.is_file():
        raise BenchmarkError(
            f"{folder}: no {EPISODES}; expected the output folder of morphgen study"
        )
    baselines = [each for each in read_table(table) if _is_baseline(each, *BASELINES)]
    own = {f"{table}: {name_of(each)}": each for each in baselines if each.split.name == split.name}
    if not own:
        others = {each.split.name for each in baselines}
        raise BenchmarkError(
            f"{folder}: no episodes of baselines on split {split.name!r}"
            f"{nearest(split.name, others)}"
        )
    require_comparable(own)
    for where, each in own.items():
        if each.split.id != split_id(split):
            raise BenchmarkError(
                f"{where}: of other robots: split id {each.split.id}; expected {split_id(split)}, "
                f"that of {split.name}; name a study of these robots"
            )
    return _baseline_results(list(own.values()), None)
