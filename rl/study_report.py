"""Tables and curves of a study; missing scores are shown as missing."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.split import SIDES, Side
from morphgen.formats.files import write_file
from morphgen.rl.agents import AGENTS
from morphgen.rl.eval_report import UNSTABLE
from morphgen.rl.intervals import Interval, iqm_interval
from morphgen.rl.recorders import read_metrics
from morphgen.rl.robot_source import tasks_of
from morphgen.rl.scores import SCORE_KEYS, Score, finite_or_none, scores_to_json, success_of
from morphgen.rl.study import Cell, as_record
from morphgen.rl.training import subruns_of

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
    """Write Markdown, JSON, CSV and curves; return their paths.

    Raises:
        FormatError: If one cannot be written.
    """
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
            lines = [_line(row) for row in own if not row.mode or row.task == task]
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


def _line(row: Row) -> list[str]:
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
