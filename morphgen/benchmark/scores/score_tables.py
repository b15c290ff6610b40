"""Tables of results computed from episodes: the submissions that studies and evaluations write.

Scores of several seeds of a method stand in one row: interquartile means with a bootstrap over the
seeds, success rates with Wilson intervals, and paired differences to a reference controller.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.scores.episode_table import name_of
from morphgen.benchmark.scores.study import Cell, stored_results
from morphgen.benchmark.scores.submission import (
    Submission,
    require_comparable,
    require_same_random,
)
from morphgen.errors import BenchmarkError
from morphgen.formats.files import write_file
from morphgen.rl.agents import AGENTS
from morphgen.rl.runs.training import read_metrics, subruns_of
from morphgen.rl.scores import SIDES as SIDE_NAMES
from morphgen.rl.scores import (
    UNSTABLE,
    Interval,
    RobotOutcomes,
    finite_or_none,
    iqm_interval,
    relative_scores,
    score_decimals,
    stratified_mean_interval,
    success_interval,
)
from morphgen.splits.split import SIDES, Side
from morphgen.splits.split_file import read_split, split_names
from morphgen.typing import Array

TABLE, DATA, CURVES = "table.md", "results.json", "curves.png"
MISSING = "missing"
NOTE = "MT: train robots, ZS: test robots; intervals: 95%"


def write_tables(folder: Path, cells: Sequence[Cell]) -> list[Path]:
    """Write Markdown, JSON and curves of the cells of a study that are done; return their paths."""
    done: dict[str, Submission] = {}
    missing: list[str] = []
    for cell in cells:
        results = stored_results(cell)
        done |= {name_of(each): each for each in results.values()}
        seed = "" if cell.seed is None else f" seed {cell.seed}"
        modes = [mode for mode in cell.modes if mode not in results]
        if modes:
            which = f" ({', '.join(modes)})" if results else ""
            missing.append(f"{cell.split} {cell.agent}{seed}{which}")
    rows = result_rows(done)
    diverged = {name: sum(map(sum, (r.diverged for r in own.robots))) for name, own in done.items()}
    notes = [
        *(f"{MISSING}: {each}" for each in missing),
        *(f"{name}: {UNSTABLE}: {count}" for name, count in diverged.items() if count),
    ]
    lines = [result_tables(rows, "github"), NOTE, *(f"- {each}" for each in notes)]
    write_file(folder / TABLE, "\n".join(lines) + "\n")
    data = {"rows": rows_data(rows), MISSING: missing}
    write_file(folder / DATA, json.dumps(data, indent=2) + "\n")
    write_file(folder / CURVES, curves(cells))
    return [folder / name for name in (TABLE, DATA, CURVES)]


def curves(cells: Sequence[Cell]) -> bytes:
    """Return a PNG of training scores, a panel per split: mean over seeds, and their range."""
    from matplotlib.figure import Figure

    splits = list(dict.fromkeys(cell.split for cell in cells))
    figure = Figure(figsize=(7.0, 4.8 * len(splits)), layout="constrained")
    panels = figure.subplots(len(splits), 1, squeeze=False)[:, 0]
    for panel, split in zip(panels, splits, strict=True):
        panel.set(title=split, xlabel="transitions", ylabel="score of a step, in training")
        panel.grid(alpha=0.3)
        for agent in dict.fromkeys(c.agent for c in cells if c.split == split and c.config):
            own = [c for c in cells if (c.split, c.agent) == (split, agent)]
            runs = [curve for curve in map(_curve, own) if curve is not None]
            if not runs:
                panel.plot([], [], label=f"{agent}: {MISSING}", color="0.6", linestyle=":")
                continue
            steps = max((steps for steps, _, _ in runs), key=len)
            values = np.full((len(runs), len(steps)), np.nan)  # nan where a seed is not there yet
            for row, (_, scores, _) in zip(values, runs, strict=True):
                row[: len(scores)] = scores
            done = sum(complete for _, _, complete in runs)
            note = "" if done == len(own) else f" ({done} of {len(own)} seeds to the end)"
            (line,) = panel.plot(steps, np.nanmean(values, axis=0), label=agent + note)
            low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
            panel.fill_between(steps, low, high, alpha=0.2, color=line.get_color())
        if panel.lines:
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize="small")
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150)
    return content.getvalue()


def _curve(cell: Cell) -> tuple[list[int], list[float], bool] | None:
    """Return the mean training curve of a run's parts; None if there are no metrics yet.

    It has, per update, the transitions so far and the mean score of a control step; and whether all
    updates have been made.
    """
    assert cell.config is not None
    runs = subruns_of(cell.folder, cell.config)
    parts = [read_metrics(part.folder) for part in runs]
    length = min(map(len, parts))
    if not length:
        return None
    steps = [sum(part[i]["transitions"] for part in parts) for i in range(length)]
    scores = [float(np.mean([part[i]["score"] for part in parts])) for i in range(length)]
    return steps, scores, all(length == run.config.num_updates for run in runs)


REFERENCES: Mapping[str, str] = {"reach": "jacobian", "push": "scripted"}
"""Controller without learning that a policy has to beat, by task."""


@dataclass(frozen=True)
class SideResult:
    """Result of a method on the robots of one side that do one task, over all of its seeds."""

    robots: int
    episodes: int  # number of episodes of all robots and seeds
    mean: float  # mean score over seeds and robots
    iqm: Interval  # interquartile mean of the scores of seeds and robots; no interval for one seed
    success: Interval  # success rate of all episodes with its Wilson interval
    difference: Interval | None
    """Score minus that of the reference in the same episodes, with a bootstrap over the episodes
    of each robot; None without a reference."""


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
        successes = [table[name].success for table in tables for name in robots]
        episodes = [len(each) for each in successes]
        yield (
            side,
            SideResult(
                len(robots),
                sum(episodes),
                float(scores.mean()),
                iqm_interval(scores, together=together),
                success_interval([np.mean(each) for each in successes], episodes),
                _difference(tables, robots, _outcomes(reference, side, task) if reference else {}),
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


def rows_data(rows: Sequence[ResultRow]) -> list[Any]:
    """Return rows as JSON values, with null for ends of intervals that are not known."""
    return [finite_or_none(asdict(row)) for row in rows]


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
            result.iqm.as_text(f".{decimals}f"),
            result.success.as_percent(),
            "-" if result.difference is None else result.difference.as_text(f"+.{decimals}f"),
        ]
    return line
