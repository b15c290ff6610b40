"""Tables and curves of a study; missing scores are shown as missing."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.split import SIDES, Side
from morphgen.formats.files import write_file
from morphgen.rl.agents import AGENTS
from morphgen.rl.eval_report import UNSTABLE
from morphgen.rl.intervals import Interval, iqm_interval
from morphgen.rl.recorders import read_metrics
from morphgen.rl.robot_source import tasks_of
from morphgen.rl.scores import Score, scores_to_json
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
"""Scores of every cell by mode; None for missing ones."""


@dataclass(frozen=True)
class Group:
    """Scores of one side over seeds and robots."""

    mean: float
    """Mean score."""
    iqm: Interval
    """Interquartile mean, with its interval."""
    success: float
    """Mean success rate."""


@dataclass(frozen=True)
class Curve:
    """Training curve of a run, by update."""

    timesteps: list[float]
    """Control steps of all environments so far."""
    scores: list[float]
    """Mean score of a control step."""
    complete: bool
    """Whether the run came to its end."""


@dataclass(frozen=True)
class Row:
    """Results of an agent on the robots of a split that do one task."""

    split: str
    """Name of the split."""
    task: str
    """The task."""
    agent: str
    """Label of the agent."""
    mode: str
    """Mode of the policies; empty if all scores are missing."""
    seeds: tuple[int | None, ...]
    """Seeds that are done."""
    missing: tuple[int | None, ...]
    """Seeds that are missing."""
    groups: Mapping[Side, Group]
    """Scores of the sides that are evaluated."""
    sides: tuple[Side, ...]
    """Sides that the agent is, or will be, evaluated on."""
    unstable: int = 0
    """Number of episodes that ended because the simulation diverged."""


def rows(results: Results) -> list[Row]:
    """Return a row for every split, task, agent and mode, in the order of the cells."""
    table: list[Row] = []
    lines = dict.fromkeys((cell.split, cell.agent) for cell in results)
    for split, agent in lines:
        own = {c: s for c, s in results.items() if (c.split, c.agent) == (split, agent)}
        there = {cell: scores for cell, scores in own.items() if scores is not None}
        missing = tuple(cell.seed for cell in own if cell not in there)
        first = next(iter(own))
        every = [s for scores in there.values() for each in scores.values() for s in each]
        modes = dict.fromkeys(mode for scores in there.values() for mode in scores)
        tasks: list[str] = list(dict.fromkeys(score.task for score in every))
        if not there:
            task = next(iter(tasks_of(first.source)), "")
            table.append(Row(split, task, agent, "", (), missing, {}, first.sides))
        for task in tasks:
            for mode in modes:
                groups = _groups(there, task, mode)
                seeds = tuple(cell.seed for cell in there)
                lost = sum(
                    each.unstable
                    for scores in there.values()
                    for each in scores[mode]
                    if each.task == task
                )
                table.append(
                    Row(split, task, agent, mode, seeds, missing, groups, first.sides, lost)
                )
    return table


def write_tables(folder: Path, results: Results) -> list[Path]:
    """Write Markdown, JSON, CSV and curves; return their paths.

    Raises:
        FormatError: If one cannot be written.
    """
    table = rows(results)
    write_file(folder / TABLE, table_text(table))
    data = {"rows": [_finite(asdict(row)) for row in table], "cells": _cells(results)}
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


def _groups(
    there: Mapping[Cell, Mapping[str, Sequence[Score]]], task: str, mode: str
) -> dict[Side, Group]:
    groups: dict[Side, Group] = {}
    for side in SIDES:
        table = [
            [each for each in scores[mode] if (each.side, each.task) == (side, task)]
            for scores in there.values()
        ]
        if not table[0]:
            continue
        scores = np.array([[each.score for each in seed] for seed in table])
        success = float(np.mean([each.success for seed in table for each in seed]))
        first = next(iter(there))
        apart = first.config is not None and AGENTS[first.config.policy.agent].per_robot
        # Policies of single robots are independent samples on the robots that they learned.
        apart = apart and side == first.source.side
        iqm = iqm_interval(scores, together=not apart)
        groups[side] = Group(float(scores.mean()), iqm, success)
    return groups


def _line(row: Row) -> list[str]:
    cells: list[str] = []
    for side in SIDES:
        group = row.groups.get(side)
        if group is not None:
            cells += [f"{group.mean:.2f}", _interval(group.iqm), f"{group.success:.0%}"]
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


def _cells(results: Results) -> list[dict[str, Any]]:
    return [
        as_record(cell)
        | {"scores": None if scores is None else {m: scores_to_json(s) for m, s in scores.items()}}
        for cell, scores in results.items()
    ]


def _csv(results: Results) -> str:
    """Return a CSV line for every split, agent, seed, mode and robot, also for missing ones."""
    text = io.StringIO()
    names = ["split", "agent", "seed", "status", "mode", *(each.name for each in fields(Score))]
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    for cell, scores in results.items():
        if scores is None:
            writer.writerow(as_record(cell) | {"status": MISSING})
            continue
        for mode, own in scores.items():
            for each in scores_to_json(own):
                writer.writerow(as_record(cell) | {"status": "done", "mode": mode} | each)
    return text.getvalue()


def _finite(value: Any) -> Any:  # noqa: ANN401
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (tuple, list)):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and math.isnan(value) else value
