"""Tables of results computed from episodes: the submissions that studies and evaluations write.

Scores of several seeds of a method stand in one row: interquartile means with a bootstrap over the
seeds, success rates with Wilson intervals, and paired differences to a reference controller.
"""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.split import SIDES, Side
from morphgen.benchmark.split_file import read_split, split_names
from morphgen.errors import BenchmarkError
from morphgen.formats.files import write_file
from morphgen.rl.agents import AGENTS
from morphgen.rl.runs.recorders import read_metrics
from morphgen.rl.runs.robot_source import tasks_of
from morphgen.rl.runs.training import subruns_of
from morphgen.rl.scores.leaderboard import relative_scores
from morphgen.rl.scores.scores import (
    SCORE_KEYS,
    UNSTABLE,
    Interval,
    Score,
    finite_or_none,
    iqm_interval,
    score_decimals,
    scores_to_json,
    stratified_mean_interval,
    success_interval,
    success_of,
)
from morphgen.rl.scores.scores import SIDES as SIDE_NAMES
from morphgen.rl.scores.study import SCORES, Cell, as_record
from morphgen.rl.scores.submission import (
    RobotOutcomes,
    Submission,
    is_submission,
    json_files,
    require_each_once,
    require_full_lists,
    require_same_random,
    submission_from,
)
from morphgen.typing import Array

TABLE, DATA, ROBOTS, CURVES = "table.md", "results.json", "results.csv", "curves.png"
MISSING, NONE = "missing", "-"
HEADERS = (
    "agent",
    "mode",
    "seeds",
    "MT mean",
    "MT IQM",
    "MT success",
    "ZS mean",
    "ZS IQM",
    "ZS success",
)

Results = Mapping[Cell, Mapping[str, Sequence[Score]] | None]
"""Scores by cell and mode; None for a cell that is not done."""


@dataclass(frozen=True)
class Group:
    """Averages over seeds and over the robots of one side of a split."""

    mean: float
    """Mean score."""
    iqm: Interval
    """Interquartile mean of the scores, with its bootstrap interval."""
    success: Interval
    """Mean success rate, 0 to 1, with its Wilson interval over the episodes of robots and seeds."""


@dataclass(frozen=True)
class Curve:
    """Training curve of a run, a point per update."""

    timesteps: list[float]
    """Number of control steps of all environments up to each update."""
    scores: list[float]
    """Mean score of the control steps of each update."""
    complete: bool
    """Whether all updates of the run have been made."""


@dataclass(frozen=True)
class Row:
    """Results of an agent on the robots of a split that do one task."""

    split: str
    """Name of the split."""
    task: str
    """Name of the task."""
    agent: str
    """Label of the agent, or name of the baseline."""
    mode: str
    """Mode of the policies; empty if all scores are missing."""
    seeds: tuple[int | None, ...]
    """Seeds with scores; None for a baseline."""
    missing: tuple[int | None, ...]
    """Seeds without scores yet; None for a baseline."""
    groups: Mapping[Side, Group]
    """Averages by side, for sides with scores."""
    sides: tuple[Side, ...]
    """Sides that the agent is evaluated on, now or later."""
    unstable: int = 0
    """Number of episodes that ended because the simulation diverged."""


def rows(results: Results) -> list[Row]:
    """Return a row for every split, task, agent and mode, in the order of the cells."""
    table: list[Row] = []
    for split, agent in dict.fromkeys((cell.split, cell.agent) for cell in results):
        cells = [cell for cell in results if (cell.split, cell.agent) == (split, agent)]
        source, sides = cells[0].source, cells[0].sides
        scored = {cell: results[cell] or {} for cell in cells}
        modes = dict.fromkeys(mode for own in scored.values() for mode in own)
        if not modes:
            task, seeds = next(iter(tasks_of(source)), ""), tuple(cell.seed for cell in cells)
            table.append(Row(split, task, agent, "", (), seeds, {}, sides))
        tasks = dict.fromkeys(
            score.task for own in scored.values() for scores in own.values() for score in scores
        )
        for task, mode in itertools.product(tasks, modes):
            done = {cell: own[mode] for cell, own in scored.items() if mode in own}
            seeds = tuple(cell.seed for cell in done)
            missing = tuple(cell.seed for cell in cells if cell not in done)
            own_scores = [s for scores in done.values() for s in scores if s.task == task]
            unstable = sum(score.unstable for score in own_scores)
            groups = _groups(done, task)
            table.append(Row(split, task, agent, mode, seeds, missing, groups, sides, unstable))
    return table


def write_tables(folder: Path, results: Results) -> list[Path]:
    """Write Markdown, JSON, CSV and curves; return their paths."""
    table = rows(results)
    write_file(folder / TABLE, table_text(table))
    cells = [
        as_record(cell)
        | {"scores": None if scores is None else {m: scores_to_json(s) for m, s in scores.items()}}
        for cell, scores in results.items()
    ]
    data = {"rows": [finite_or_none(asdict(row)) for row in table], "cells": cells}
    write_file(folder / DATA, json.dumps(data, indent=2) + "\n")
    write_file(folder / ROBOTS, _csv(results))
    write_file(folder / CURVES, curves(results))
    return [folder / name for name in (TABLE, DATA, ROBOTS, CURVES)]


def table_text(table: Sequence[Row]) -> str:
    """Return Markdown with a table for each split and task."""
    parts = []
    for split in dict.fromkeys(row.split for row in table):
        own = [row for row in table if row.split == split]
        tasks = dict.fromkeys(row.task for row in own if row.mode) or {own[0].task: None}
        for task in tasks:
            lines = [_report_line(row) for row in own if not row.mode or row.task == task]
            title = split if len(tasks) == 1 else f"{split}: {task}"
            text = tabulate(lines, HEADERS, tablefmt="github", disable_numparse=True)
            parts.append(f"## {title}\n\n{text}\n")
            parts += [
                f"{row.agent} {row.mode}: {UNSTABLE}: {row.unstable}\n"
                for row in own
                if row.unstable and row.task == task
            ]
    return "\n".join(parts)


def curves(results: Results) -> bytes:
    """Return a PNG of training scores, a panel per split: mean over seeds, and their range."""
    from matplotlib.figure import Figure

    splits = list(dict.fromkeys(cell.split for cell in results))
    figure = Figure(figsize=(7.0, 4.8 * len(splits)), layout="constrained")
    panels = figure.subplots(len(splits), 1, squeeze=False)[:, 0]
    for panel, split in zip(panels, splits, strict=True):
        panel.set(title=split, xlabel="transitions", ylabel="score of a step, in training")
        panel.grid(alpha=0.3)
        for agent in dict.fromkeys(c.agent for c in results if c.split == split and c.config):
            own = [c for c in results if (c.split, c.agent) == (split, agent)]
            runs = [curve for curve in map(_curve, own) if curve is not None]
            if not runs:
                panel.plot([], [], label=f"{agent}: {MISSING}", color="0.6", linestyle=":")
                continue
            steps = max((curve.timesteps for curve in runs), key=len)
            values = np.full((len(runs), len(steps)), np.nan)
            for row, curve in zip(values, runs, strict=True):
                row[: len(curve.scores)] = curve.scores
            done = sum(curve.complete for curve in runs)
            note = "" if done == len(own) else f" ({done} of {len(own)} seeds to the end)"
            (line,) = panel.plot(steps, np.nanmean(values, axis=0), label=agent + note)
            panel.fill_between(
                steps,
                np.nanmin(values, axis=0),
                np.nanmax(values, axis=0),
                alpha=0.2,
                color=line.get_color(),
            )
        if panel.lines:
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize="small")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150)
    return content.getvalue()


def _curve(cell: Cell) -> Curve | None:
    """Return the mean training curve of a run's parts; None if there are no metrics yet."""
    assert cell.config is not None
    runs = subruns_of(cell.folder, cell.config)
    parts = [read_metrics(part.folder) for part in runs]
    length = min(map(len, parts))
    if not length:
        return None
    steps = [sum(part[i]["transitions"] for part in parts) for i in range(length)]
    scores = [float(np.mean([part[i]["score"] for part in parts])) for i in range(length)]
    return Curve(steps, scores, all(length == run.config.num_updates for run in runs))


def _groups(done: Mapping[Cell, Sequence[Score]], task: str) -> dict[Side, Group]:
    """Return averages by side over the cells (seeds) of one agent in one mode, for one task."""
    cell = next(iter(done))
    per_robot = cell.config is not None and AGENTS[cell.config.policy.agent].per_robot
    groups: dict[Side, Group] = {}
    for side in SIDES:
        table = [
            [score for score in scores if (score.side, score.task) == (side, task)]
            for scores in done.values()
        ]
        if not table[0]:
            continue
        values = np.array([[score.score for score in seed] for seed in table])
        success = success_of([score for seed in table for score in seed])
        # Policies of single robots are independent samples on the robots that they learned.
        iqm = iqm_interval(values, together=not (per_robot and side == cell.source.side))
        groups[side] = Group(float(values.mean()), iqm, success)
    return groups


def _report_line(row: Row) -> list[str]:
    cells: list[str] = []
    for side in SIDES:
        group = row.groups.get(side)
        if group is not None:
            cells += [f"{group.mean:.2f}", _interval(group.iqm), group.success.as_percent()]
        elif not row.mode and side in row.sides:
            cells += [MISSING] * 3
        else:
            cells += [NONE] * 3
    return [row.agent, row.mode if row.mode != row.agent else "", _seeds(row), *cells]


def _seeds(row: Row) -> str:
    if row.seeds == (None,) or row.missing == (None,):
        return NONE
    count = str(len(row.seeds))
    if not row.missing:
        return count
    gone = ", ".join(map(str, row.missing))
    return f"{count} of {len(row.seeds) + len(row.missing)} ({MISSING}: {gone})"


def _interval(interval: Interval) -> str:
    if math.isnan(interval.low):
        return f"{interval.value:.2f}"
    return f"{interval.value:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def _csv(results: Results) -> str:
    """Return CSV text with a line per cell, mode and robot, or one per missing cell."""
    text = io.StringIO()
    names = ["split", "agent", "seed", "status", "mode", *SCORE_KEYS]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for cell, scores in results.items():
        if scores is None:
            writer.writerow(as_record(cell) | {"status": MISSING})
            continue
        for mode, mode_scores in scores.items():
            for record in scores_to_json(mode_scores):
                writer.writerow(as_record(cell) | {"status": "done", "mode": mode} | record)
    return text.getvalue()


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
    """Return the submissions in files and below folders, by the path of their file."""
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
    """Return a row for every split, task, method, mode, training and amount of fine-tuning."""
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
    """Require one set of robots and rules, and robots of a split of morphgen as it is."""
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
