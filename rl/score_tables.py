"""Tables of results computed from episodes: the submissions that studies and evaluations write.

Scores of several seeds of a method stand in one row: interquartile means with a bootstrap over the
seeds, success rates with Wilson intervals, and paired differences to a reference controller.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.split import SIDES, Side
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.errors import BenchmarkError
from morphgen.rl.eval_report import SIDES as SIDE_NAMES
from morphgen.rl.intervals import (
    Interval,
    iqm_interval,
    stratified_mean_interval,
    success_interval,
)
from morphgen.rl.leaderboard import relative_scores
from morphgen.rl.scores import score_decimals
from morphgen.rl.study import SCORES
from morphgen.rl.submission import (
    RobotOutcomes,
    Submission,
    is_submission,
    json_files,
    submission_from,
)
from morphgen.rl.submission_checks import (
    require_each_once,
    require_full_lists,
    require_same_random,
)
from morphgen.typing import Array

REFERENCES: Mapping[str, str] = {"reach": "jacobian", "push": "scripted"}
"""Controller without learning that a policy has to beat, by task."""


@dataclass(frozen=True)
class SideResult:
    """Result of a method on the robots of one side that do one task, over all of its seeds."""

    robots: int
    episodes: int
    """Number of episodes of all robots and seeds."""
    mean: float
    """Mean score over seeds and robots."""
    iqm: Interval
    """Interquartile mean of the scores of seeds and robots; no interval for one seed."""
    success: Interval
    """Success rate of all episodes with its Wilson interval."""
    difference: Interval | None
    """Score minus that of the reference in the same episodes, with a bootstrap over the episodes
    of each robot; None without a reference."""


@dataclass(frozen=True)
class ResultRow:
    """Results of a method in one mode at one task of a split."""

    split: str
    task: str
    method: str
    mode: str
    """``deterministic``, ``stochastic``, or empty for a controller that does not learn."""
    finetuned: int
    """Transitions of fine-tuning on the test robots."""
    transitions: int | None
    """Transitions of the training; None if it is not known or there was none."""
    simulator: str
    """Simulator of the training; empty like ``transitions``."""
    seeds: tuple[int, ...]
    """Seeds of the training."""
    sides: Mapping[Side, SideResult]


def read_submissions(paths: Sequence[Path]) -> dict[str, Submission]:
    """Return the submissions in files and below folders, by the path of their file.

    Raises:
        BenchmarkError: If a file is missing or malformed, or a folder has no submission.
    """
    found: dict[str, Submission] = {}
    for path in paths:
        before = len(found)
        for file, data in json_files(path, "**/*.json"):
            if is_submission(data) or file == path:
                found[str(file)] = submission = submission_from(data, file)
                if not submission.robots:
                    raise BenchmarkError(f"{file}: robots: none; expected one or more")
                require_each_once(submission, str(file))
                for robot in submission.robots:
                    require_full_lists(robot, f"{file}: {robot.side} robot {robot.robot}")
        if len(found) == before:
            raise BenchmarkError(
                f"{path}: no submissions below it; morphgen study writes them beside scores.json"
            )
    return found


def cells_without_episodes(paths: Sequence[Path], submissions: Mapping[str, Submission]) -> int:
    """Return the number of cells of studies below folders that have scores and no submission."""
    with_episodes = {Path(where).parent for where in submissions}
    cells = {file.parent for path in paths for file in path.rglob(SCORES)}
    return len(cells - with_episodes)


def result_rows(submissions: Mapping[str, Submission]) -> list[ResultRow]:
    """Return a row for every split, task, method, mode, training and amount of fine-tuning.

    Args:
        submissions: Submissions by the name of their file.

    Raises:
        BenchmarkError: If two of them are of the same run, or of one split with other robots, rules
            or scores of the random policy; or if robots differ from those of the split that comes
            with morphgen.
    """
    by_split: dict[str, dict[str, Submission]] = {}
    for where, each in submissions.items():
        by_split.setdefault(each.split.name, {})[where] = each
    rows: list[ResultRow] = []
    for split, own in by_split.items():
        _require_comparable(split, own)
        require_same_random(list(own.items()))
        groups: dict[_Key, dict[int | None, tuple[str, Submission]]] = {}
        for where, each in own.items():
            group = groups.setdefault(_key(each), {})
            if each.training_seed in group:
                other = group[each.training_seed][0]
                raise BenchmarkError(f"{where}: the same run, seed and mode as {other}")
            group[each.training_seed] = where, each
        tasks = dict.fromkeys(robot.task for each in own.values() for robot in each.robots)
        for task in tasks:
            baseline = groups.get((REFERENCES.get(task, ""), "", 0, None, ""), {})
            reference = baseline.get(None)
            for (method, mode, finetuned, transitions, simulator), group in groups.items():
                runs = [each for _, each in group.values()]
                sides = dict(_side_results(runs, task, reference[1] if reference else None))
                if not sides:
                    continue
                rows.append(
                    ResultRow(
                        split,
                        task,
                        method,
                        mode,
                        finetuned,
                        transitions,
                        simulator,
                        tuple(sorted(seed for seed in group if seed is not None)),
                        sides,
                    )
                )
    return rows


_Key = tuple[str, str, int, int | None, str]
"""Method, mode, transitions of fine-tuning and of training, and simulator of the training."""


def _key(submission: Submission) -> _Key:
    """Return what the seeds of one row have in common."""
    training = submission.training
    return (
        submission.method,
        submission.mode,
        submission.finetuned,
        training.transitions if training else None,
        training.simulator if training else "",
    )


def _require_comparable(split: str, submissions: Mapping[str, Submission]) -> None:
    """Require one set of robots and one set of rules, and robots of a split of morphgen as it is.

    Raises:
        BenchmarkError: If a submission differs.
    """
    (first, other), *rest = submissions.items()
    for where, each in rest:
        for name, own, theirs in (
            ("split.id", each.split.id, other.split.id),
            ("evaluation", each.evaluation, other.evaluation),
        ):
            if own != theirs:
                raise BenchmarkError(
                    f"{where}: {name} {json.dumps(own)}; expected {json.dumps(theirs)}, as in "
                    f"{first}"
                )
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
        successes = [table[name].success for table in tables for name in robots]
        episodes = [len(each) for each in successes]
        yield (
            side,
            SideResult(
                len(robots),
                sum(episodes),
                float(scores.mean()),
                iqm_interval(scores, together=True),
                success_interval([np.mean(each) for each in successes], episodes),
                _difference(tables, robots, _outcomes(reference, side, task) if reference else {}),
            ),
        )


def _outcomes(run: Submission, side: Side, task: str) -> dict[str, RobotOutcomes]:
    return {each.robot: each for each in run.robots if (each.side, each.task) == (side, task)}


def _difference(
    tables: Sequence[Mapping[str, RobotOutcomes]],
    robots: Sequence[str],
    reference: Mapping[str, RobotOutcomes],
) -> Interval | None:
    """Return the mean difference to the reference; None if it lacks a robot or is the method."""
    if not reference.keys() >= set(robots) or tables[0] == reference:
        return None
    strata: list[Array] = []
    for name in robots:
        own = relative_scores(reference[name])
        for table in tables:
            if len(table[name].score) % len(own):
                raise BenchmarkError(
                    f"robot {name}: {len(table[name].score)} episodes; expected a multiple of the "
                    f"{len(own)} of the reference"
                )
        # Policies of single robots have the episodes of each policy one after another.
        seeds = [
            relative_scores(table[name]).reshape(-1, len(own)).mean(axis=0) for table in tables
        ]
        strata.append(np.mean(seeds, axis=0) - own)
    return stratified_mean_interval(strata)


def result_tables(rows: Sequence[ResultRow], style: str = "simple") -> str:
    """Return a table for every split and task, under its name.

    Args:
        rows: The rows.
        style: One of tabulate's; ``github`` makes the names Markdown headings.
    """
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
        table = tabulate(lines, headers, tablefmt=style, disable_numparse=True)
        parts.append(f"{'## ' * (style == 'github')}{title}\n\n{table}\n")
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
            _text(result.iqm, f".{decimals}f"),
            result.success.as_percent(),
            "-" if result.difference is None else _text(result.difference, f"+.{decimals}f"),
        ]
    return line


def _text(interval: Interval, form: str) -> str:
    if math.isnan(interval.low):
        return f"{interval.value:{form}}"
    return f"{interval.value:{form}} ({interval.low:{form}} to {interval.high:{form}})"
