"""Results of submissions, computed from the episodes: tables of seeds, and reference scores.

Scores of several seeds of a method stand in one row, whose intervals resample the seeds: means,
success rates, and paired differences to a reference controller. Reference
scores are those of submissions in a release.
"""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from morphgen.benchmark.release import SCORES_FILE, SUBMISSIONS_DIR
from morphgen.benchmark.scores.submission import (
    EvalProtocol,
    Submission,
    check_submission,
    expected_robots,
    read_submissions,
    require_comparable,
    require_same_random,
    submission_from,
    submission_text,
)
from morphgen.errors import BenchmarkError
from morphgen.formats.data_files import read_json
from morphgen.grammar.library import Library
from morphgen.rl.agents import AGENTS
from morphgen.rl.baselines import ZERO
from morphgen.rl.scores import SIDES as SIDE_NAMES
from morphgen.rl.scores import (
    Interval,
    RandomScores,
    RobotOutcomes,
    episode_interval,
    finite_or_none,
    mean_error,
    mean_interval,
    relative_scores,
    score_decimals,
    seeds_success_interval,
    smallest_mean_difference,
    smallest_rate_difference,
)
from morphgen.splits.split import SIDES, Side, Split, read_split, split_id, split_names
from morphgen.tables import table
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array

Source = Literal["submission", "reference"]


def smallest_differences(rows: Sequence[ResultRow]) -> list[dict[str, Any]]:
    """Return the smallest differences that the test episodes of any two rows show, by task.

    ``success`` is that of two rates around 50%, from the row with the fewest episodes; ``score``
    that of the rows with the largest standard errors, None if one is not known.
    """
    found = []
    for task in sorted({row.task for row in rows if "test" in row.sides}):
        own = [row.sides["test"] for row in rows if row.task == task and "test" in row.sides]
        episodes = min(side.episodes for side in own)
        errors = np.sort([side.error for side in own])  # nan last
        largest = float(errors[-1]), float(errors[-min(2, len(errors))])
        values = {"task": task, "episodes": episodes, "success": smallest_rate_difference(episodes)}
        found.append(finite_or_none(values | {"score": smallest_mean_difference(largest)}))
    return found


def floor(submissions: Sequence[Submission]) -> dict[str, dict[str, float]]:
    """Return the success rate on the test robots of ``zero`` and ``random``, by task and name."""
    rates: dict[str, dict[str, float]] = {}
    for name in (ZERO.name, RANDOM):
        own = next((each for each in submissions if _is_baseline(each, name)), None)
        known = own or (submissions[0] if name == RANDOM else None)
        for task in TASKS if known else ():
            robots = _outcomes(known, "test", task).values() if known else ()
            lists = [each.success if own else each.random_success for each in robots]
            if lists and all(lists):
                rates.setdefault(task, {})[name] = float(np.mean(list(map(np.mean, lists))))
    return rates


def random_scores(submission: Submission) -> RandomScores:
    """Return the scores of the random policy's episodes in a submission."""
    return {(each.side, each.robot): each.random_score for each in submission.robots}


def ranked(rows: Sequence[ResultRow]) -> list[ResultRow]:
    """Return rows by their mean score on the test robots, the best first; others come last."""

    def result(row: ResultRow) -> float:
        return row.sides["test"].score.value if "test" in row.sides else -math.inf

    return sorted(rows, key=result, reverse=True)


FORMAT = 3
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

    def rows(self) -> list[ResultRow]:
        """Return the scores of the submissions."""
        named = {_path(each): each for each in self.submissions}
        return scored_rows(named, self.random, "reference")


def collect_references(
    paths: Sequence[Path], split: Split, protocol: EvalProtocol, library: Library, *, jobs: int = 1
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
    data = {"format": FORMAT, "rows": rows_data(references.rows())}
    return files | {SCORES_FILE: (json.dumps(data, indent=2) + "\n").encode()}


def read_references(folder: Path) -> References:
    """Read the reference scores of a release; they were checked when it was made."""
    files = sorted((folder / SUBMISSIONS_DIR).glob("*.json"))
    return References(tuple(submission_from(read_json(file), file) for file in files))


def _is_baseline(submission: Submission, name: str) -> bool:
    """Return whether a submission is of this baseline, not of a policy with its name."""
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


NOTE = (
    "MT: train robots, ZS: test robots; intervals: 95%, over seeds and the episodes of each; over "
    "the episodes of a single seed"
)


REFERENCES: Mapping[str, str] = {
    "reach": "jacobian",
    **dict.fromkeys(("push", "drawer", "door", "dial"), "scripted"),
}
"""Controller without learning that a policy has to beat, by task."""


@dataclass(frozen=True)
class SideResult:
    """Result of a method on the robots of one side that do one task, over all of its seeds."""

    robots: int
    episodes: int  # number of episodes of all robots and seeds
    score: Interval  # mean score over seeds and robots; see `episode_interval`
    error: float  # standard error of the mean score; see `mean_error`
    success: Interval  # mean success rate; see `seeds_success_interval`
    difference: Interval | None
    """Score minus that of the reference in the same episodes, see `mean_interval`; None without a
    reference."""


@dataclass(frozen=True)
class ResultRow:
    """Results of a method in one mode at one task of a split."""

    split: str
    task: str
    method: str
    mode: str  # `deterministic`, `stochastic`, or empty for a controller that does not learn
    finetuned: int  # transitions of fine-tuning on the test robots
    transitions: int | None
    """Transitions of the training; None if it is not known or there was none."""
    simulator: str  # simulator of the training; empty like `transitions`
    seeds: tuple[int, ...]  # seeds of the training
    sides: Mapping[Side, SideResult]
    source: Source = "submission"


def result_rows(submissions: Mapping[str, Submission]) -> list[ResultRow]:
    """Return a row for every split, task, method, mode, training and amount of fine-tuning."""
    by_split: dict[str, dict[str, Submission]] = {}
    for where, each in submissions.items():
        by_split.setdefault(each.split.name, {})[where] = each
    rows: list[ResultRow] = []
    for split, own in by_split.items():
        require_comparable(own)
        _require_shipped_robots(split, own)
        require_same_random(list(own.items()))
        rows += scored_rows(own, with_differences=True)
    return rows


def scored_rows(
    submissions: Mapping[str, Submission],
    random: RandomScores | None = None,
    source: Source = "submission",
    *,
    with_differences: bool = False,
) -> list[ResultRow]:
    """Return the rows of submissions to one split, which were checked.

    Args:
        submissions: Submissions by the name of their file.
        random: Scores of the random policy; by default those that a submission has.
        source: Where the submissions come from.
        with_differences: Whether to compare each with the reference of its task.
    """
    groups: dict[_Key, dict[int | None, tuple[str, Submission]]] = {}
    for where, each in submissions.items():
        group = groups.setdefault(_key(each), {})
        earlier, other = group.setdefault(each.training_seed, (where, each))
        if each.robots != other.robots:  # several studies may have the same run of a baseline
            raise BenchmarkError(
                f"{where}: the same run, seed and mode as {earlier} with other episodes; name "
                "one of the two files, or their methods differently"
            )
    rows = []
    for task in dict.fromkeys(robot.task for each in submissions.values() for robot in each.robots):
        baseline = groups.get((REFERENCES.get(task, ""), "", 0, None, ""), {})
        _, reference = baseline.get(None, ("", None)) if with_differences else ("", None)
        for key, group in groups.items():
            runs = [run for _, run in group.values()]
            sides = dict(_side_results(runs, task, reference, random))
            seeds = tuple(sorted(seed for seed in group if seed is not None))
            if sides:
                rows.append(ResultRow(runs[0].split.name, task, *key, seeds, sides, source))
    return rows


_Key = tuple[str, str, int, int | None, str]
"""Fields of a ``ResultRow`` from ``method`` to ``simulator``, which its seeds have in common."""


def _key(submission: Submission) -> _Key:
    training = submission.training
    return (
        submission.method,
        submission.mode,
        submission.finetuned,
        training.transitions if training else None,
        training.simulator if training else "",
    )


def _require_shipped_robots(split: str, submissions: Mapping[str, Submission]) -> None:
    """Require the robots of a split of morphgen as it is, if it has this name."""
    if split not in split_names():
        return
    shipped = read_split(split)
    bodies = {(s, m.name): m.robot_hash for s in SIDES for m in shipped.side(s)}
    for where, each in submissions.items():
        for robot in each.robots:
            expected = bodies.get((robot.side, robot.robot))
            if robot.body != expected:
                raise BenchmarkError(
                    f"{where}: {robot.side} robot {robot.robot}: body {robot.body}; expected "
                    f"{expected or 'a robot of ' + split}"
                )


def _side_results(
    runs: Sequence[Submission],
    task: str,
    reference: Submission | None,
    random: RandomScores | None,
) -> Iterator[tuple[Side, SideResult]]:
    for side in SIDES:
        tables = [_outcomes(run, side, task) for run in runs]
        names = set(tables[0]).intersection(*tables[1:])
        if not names:
            continue
        if any(len(table) > len(names) for table in tables):
            raise BenchmarkError(
                f"{runs[0].split.name}: {runs[0].method}: its seeds have other {side} robots; "
                "expected the same robots in all"
            )
        robots = [name for name in tables[0] if name in names]
        scores = [[relative_scores(table[name], random) for name in robots] for table in tables]
        # Policies of single robots are independent samples on the robots that they learned.
        together = not any(_learned_alone(run, side) for run in runs)
        successes = [[table[name].success for name in robots] for table in tables]
        yield (
            side,
            SideResult(
                len(robots),
                sum(map(len, itertools.chain(*successes))),
                episode_interval(
                    scores,
                    successes,
                    relative=TASKS[task].relative_to_random,
                    together=together,
                ),
                mean_error(scores),
                seeds_success_interval(successes, together=together),
                _difference(
                    tables,
                    robots,
                    _outcomes(reference, side, task) if reference else {},
                    together=together,
                ),
            ),
        )


def _learned_alone(run: Submission, side: Side) -> bool:
    """Return whether a run has a policy for each robot of a side, as its study says."""
    if run.config is None or run.config["source"]["side"] != side:
        return False
    agent = run.config["policy"]["agent"]
    return agent in AGENTS and AGENTS[agent].per_robot


def _outcomes(run: Submission, side: Side, task: str) -> dict[str, RobotOutcomes]:
    return {each.robot: each for each in run.robots if (each.side, each.task) == (side, task)}


def _difference(
    tables: Sequence[Mapping[str, RobotOutcomes]],
    robots: Sequence[str],
    reference: Mapping[str, RobotOutcomes],
    *,
    together: bool,
) -> Interval | None:
    """Return the mean difference to the reference; None if it lacks a robot or is the method."""
    if not reference.keys() >= set(robots) or tables[0] == reference:
        return None
    differences: list[list[Array]] = [[] for _ in tables]
    for name in robots:
        own = relative_scores(reference[name])
        for run, found in zip(tables, differences, strict=True):
            scores = relative_scores(run[name])
            if len(scores) % len(own):
                raise BenchmarkError(
                    f"robot {name}: {len(scores)} episodes; expected a multiple of the {len(own)} "
                    "of the reference"
                )
            # Policies of single robots have the episodes of each policy one after another.
            found.append(scores.reshape(-1, len(own)).mean(axis=0) - own)
    return mean_interval(differences, together=together)


def rows_data(rows: Sequence[ResultRow]) -> list[Any]:
    """Return rows as JSON values, with null for ends of intervals that are not known."""
    return [finite_or_none(asdict(row)) for row in rows]


_LESS = ("fine-tuned", "trained", "MT success", "MT mean")
"""Columns of result tables that a narrow terminal leaves out first."""


def result_tables(rows: Sequence[ResultRow], style: str = "simple") -> str:
    """Return a table for every split and task, under its name."""
    parts = []
    for split, task in dict.fromkeys((row.split, row.task) for row in rows):
        own = [row for row in rows if (row.split, row.task) == (split, task)]
        reference = f"minus {REFERENCES[task]}" if task in REFERENCES else ""
        headers = ["method", "seeds", "trained", "fine-tuned"]
        for side in SIDES:
            name = SIDE_NAMES[side]
            headers += [f"{name} mean", f"{name} success", reference]
        decimals = score_decimals(side.score.value for row in own for side in row.sides.values())
        lines = [_line(row, decimals) for row in own]
        title = split if split.endswith(f"/{task}") else f"{split}: {task}"
        text = table(lines, headers, style=style, last=[reference, *_LESS])
        parts.append(f"{'## ' * (style == 'github')}{title}\n\n{text}\n")
    return "\n".join(parts)


def _line(row: ResultRow, decimals: int) -> list[str]:
    trained = "-" if row.transitions is None else f"{row.transitions:,} {row.simulator}"
    remarks = ["stochastic"] * (row.mode == "stochastic")
    remarks += ["reference"] * (row.source == "reference")
    name = f"{row.method} ({', '.join(remarks)})" if remarks else row.method
    tuned = f"{row.finetuned:,}" if row.finetuned else "-"
    line = [name, str(len(row.seeds) or "-"), trained, tuned]
    for side in SIDES:
        result = row.sides.get(side)
        if result is None:
            line += ["-"] * 3
            continue
        line += [
            result.score.as_text(f".{decimals}f"),
            result.success.as_percent(),
            "-" if result.difference is None else result.difference.as_text(f"+.{decimals}f"),
        ]
    return line
