"""Results of submissions, computed from the episodes: rankings, reference scores, tables of seeds.

Reference scores are those of submissions in a release. In tables, scores of several seeds of a
method stand in one row, whose intervals resample the seeds: interquartile means, success rates, and
paired differences to a reference controller.
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
    iqm_interval,
    mean_error,
    mean_interval,
    relative_scores,
    score_decimals,
    seeds_success_interval,
    smallest_mean_difference,
    smallest_rate_difference,
)
from morphgen.splits.split import SIDES, Side, Split, split_id
from morphgen.splits.split_file import read_split, split_names
from morphgen.tables import table
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array

Source = Literal["submission", "reference"]


@dataclass(frozen=True)
class SideScore:
    """Mean result over the robots of a side that do one task."""

    robots: int
    score: Interval  # mean score, relative to the random policy where the task wants it
    success: Interval  # mean success rate, 0 to 1; see `seeds_success_interval`
    episodes: int = 0  # number of episodes of all robots and seeds
    error: float = math.nan  # standard error of the score; see `mean_error`

    def as_data(self) -> dict[str, Any]:
        """Return JSON values, with null for ends of intervals that are not known."""
        score, success = self.score, self.success
        values = {"robots": self.robots, "score": score.value, "success": success.value}
        values |= {"episodes": self.episodes, "error": self.error}
        values |= {"low": score.low, "high": score.high}
        values |= {"success_low": success.low, "success_high": success.high}
        return dict(finite_or_none(values))


@dataclass(frozen=True)
class Row:
    """A method in a ranking."""

    method: str
    source: Source  # `submission`; or `reference`, a submission in a release
    mode: str
    seeds: tuple[int, ...]  # seeds of the training; empty for a baseline
    episodes: int  # episodes per robot
    sides: Mapping[tuple[Side, str], SideScore]  # by side and task
    finetuned: int = 0  # transitions of fine-tuning on the test robots

    @property
    def label(self) -> str:
        """Method, and how the policy acts and was fine-tuned if that is not the usual way."""
        remarks = ["stochastic"] if self.mode == "stochastic" else []
        if self.finetuned:
            remarks.append(f"fine-tuned {self.finetuned:,}")
        return f"{self.method} ({', '.join(remarks)})" if remarks else self.method


def method_rows(
    submissions: Sequence[Submission],
    random: RandomScores | None = None,
    source: Source = "submission",
) -> list[Row]:
    """Return a row for each method, or for each of several policies with one name and seed."""
    groups: dict[Any, list[Submission]] = {}
    for each in submissions:
        robots = frozenset((robot.side, robot.robot) for robot in each.robots)
        groups.setdefault((_key(each), each.training_seed is None, robots), []).append(each)
    rows = []
    for own in groups.values():
        are_seeds = len({each.training_seed for each in own}) == len(own)
        for runs in [own] if are_seeds else [[each] for each in own]:
            rows.append(score_runs(runs, random, source))
    return rows


def score_runs(runs: Sequence[Submission], random: RandomScores | None, source: Source) -> Row:
    """Compute the scores of the runs of a method, one for each training seed."""
    first, *_ = runs
    sides = {}
    for side, task in ((side, task) for side in SIDES for task in TASKS):
        tables = [_outcomes(run, side, task) for run in runs]
        robots = list(tables[0])
        if not robots:
            continue
        scores = [[relative_scores(table[name], random) for name in robots] for table in tables]
        successes = [[table[name].success for name in robots] for table in tables]
        sides[side, task] = SideScore(
            len(robots),
            episode_interval(scores, successes, relative=TASKS[task].relative_to_random),
            seeds_success_interval(successes),
            sum(map(len, itertools.chain(*successes))),
            mean_error(scores),
        )
    return Row(
        first.method,
        source,
        first.mode,
        tuple(sorted(run.training_seed for run in runs if run.training_seed is not None)),
        min(len(each.score) for run in runs for each in run.robots),
        sides,
        first.finetuned,
    )


def smallest_differences(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the smallest differences that the test episodes of any two rows show, by task.

    ``success`` is that of two rates around 50%, from the row with the fewest episodes; ``score``
    that of the rows with the largest standard errors, None if one is not known.
    """
    tasks = {task for row in rows for side, task in row.sides if side == "test"}
    found = []
    for task in sorted(tasks):
        own = [row.sides["test", task] for row in rows if ("test", task) in row.sides]
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


def ranked(rows: Sequence[Row]) -> list[Row]:
    """Return rows by their mean score on the test robots, the best first.

    Scores of different tasks cannot be added: with several it is the success rate. Rows without all
    of these tasks come last.
    """
    tasks = {task for row in rows for side, task in row.sides if side == "test"}

    def result(row: Row) -> float:
        test = [score for (side, _), score in row.sides.items() if side == "test"]
        if not test or len(test) < len(tasks):
            return -math.inf
        if len(tasks) == 1:
            return test[0].score.value
        robots = sum(side.robots for side in test)
        return sum(side.success.value * side.robots for side in test) / robots

    return sorted(rows, key=result, reverse=True)


def ranking_table(rows: Sequence[Row], style: str = "simple") -> str:
    """Return the ranking as a table; ``style`` is one of tabulate's."""
    pairs = {pair for row in rows for pair in row.sides}
    groups = sorted(pairs, key=lambda pair: (pair[0] != "test", pair[1]))
    headers = ["rank", "method", "from", "seeds"]
    for side, task in groups:
        headers += [f"{SIDE_NAMES[side]} {task}", "95%", "success"]
    decimals = {}
    for group in groups:
        scores = [row.sides[group].score.value for row in rows if group in row.sides]
        decimals[group] = score_decimals(scores)
    lines = []
    for rank, row in enumerate(ranked(rows), 1):
        cells = [str(rank), row.label, row.source, ", ".join(map(str, row.seeds)) or "-"]
        for group in groups:
            cells += _cells(row.sides.get(group), decimals[group])
        lines.append([*cells, str(row.episodes)])
    return table(lines, [*headers, "episodes"], style=style, last=("from", "seeds"))


def ranking_data(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the rows for JSON, in their order."""
    return [
        {
            **vars(row),
            "seeds": list(row.seeds),
            "sides": [
                {"side": side, "task": task, **score.as_data()}
                for (side, task), score in row.sides.items()
            ],
        }
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
        return method_rows(self.submissions, self.random, "reference")


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
    data = {"format": FORMAT, "rows": ranking_data(references.rows())}
    return files | {SCORES_FILE: (json.dumps(data, indent=2) + "\n").encode()}


def read_references(folder: Path) -> References:
    """Read the reference scores of a release; they were checked when it was made."""
    files = sorted((folder / SUBMISSIONS_DIR).glob("*.json"))
    return References(tuple(submission_from(read_json(file), file) for file in files))


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
    mean: float  # mean score over seeds and robots
    iqm: Interval  # interquartile mean of the scores of seeds and robots; no interval for one seed
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
        groups: dict[_Key, dict[int | None, tuple[str, Submission]]] = {}
        for where, each in own.items():
            group = groups.setdefault(_key(each), {})
            earlier, other = group.setdefault(each.training_seed, (where, each))
            if each.robots != other.robots:  # several studies may have the same run of a baseline
                raise BenchmarkError(
                    f"{where}: the same run, seed and mode as {earlier} with other episodes; name "
                    "one of the two files"
                )
        for task in dict.fromkeys(robot.task for each in own.values() for robot in each.robots):
            baseline = groups.get((REFERENCES.get(task, ""), "", 0, None, ""), {})
            _, reference = baseline.get(None, ("", None))
            for key, group in groups.items():
                sides = dict(_side_results([run for _, run in group.values()], task, reference))
                seeds = tuple(sorted(seed for seed in group if seed is not None))
                if sides:
                    rows.append(ResultRow(split, task, *key, seeds, sides))
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
    runs: Sequence[Submission], task: str, reference: Submission | None
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
        scores = np.array(
            [[relative_scores(table[name]).mean() for name in robots] for table in tables]
        )
        # Policies of single robots are independent samples on the robots that they learned.
        together = not any(_learned_alone(run, side) for run in runs)
        successes = [[table[name].success for name in robots] for table in tables]
        yield (
            side,
            SideResult(
                len(robots),
                sum(map(len, itertools.chain(*successes))),
                float(scores.mean()),
                iqm_interval(scores, together=together),
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


_LESS = ("ZS IQM", "MT IQM", "fine-tuned", "trained", "MT success", "MT mean")
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
            headers += [f"{name} mean", f"{name} IQM", f"{name} success", reference]
        decimals = score_decimals(side.mean for row in own for side in row.sides.values())
        lines = [_line(row, decimals) for row in own]
        title = split if split.endswith(f"/{task}") else f"{split}: {task}"
        text = table(lines, headers, style=style, last=[reference, *_LESS])
        parts.append(f"{'## ' * (style == 'github')}{title}\n\n{text}\n")
    return "\n".join(parts)


def _line(row: ResultRow, decimals: int) -> list[str]:
    trained = "-" if row.transitions is None else f"{row.transitions:,} {row.simulator}"
    name = f"{row.method} ({row.mode})" if row.mode == "stochastic" else row.method
    tuned = f"{row.finetuned:,}" if row.finetuned else "-"
    line = [name, str(len(row.seeds) or "-"), trained, tuned]
    for side in SIDES:
        result = row.sides.get(side)
        if result is None:
            line += ["-"] * 4
            continue
        line += [
            f"{result.mean:.{decimals}f}",
            result.iqm.as_text(f".{decimals}f"),
            result.success.as_percent(),
            "-" if result.difference is None else result.difference.as_text(f"+.{decimals}f"),
        ]
    return line
