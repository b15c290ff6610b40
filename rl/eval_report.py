"""Tables of the scores of one policy, for the terminal and for files."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from tabulate import tabulate

from morphgen.errors import TaskError, nearest
from morphgen.formats.files import require_writable_file, write_file
from morphgen.rl.scores import SCORE_KEYS, Score, scores_to_json, success_of

SIDES = {"train": "MT", "test": "ZS"}
"""The paper's names of the mean score of a side: multi-task and zero-shot."""
HEADERS = ("robot", "side", "task", "mode", "score", "95%", "success", "raw", "random", "distance")
UNSTABLE = "episodes that ended because their simulation became unstable"
SUFFIXES = (".csv", ".json", ".md")

Scores = Mapping[str, Sequence[Score]]
"""Scores by mode, or by the name of a baseline."""


def score_table(scores_by_mode: Scores, style: str = "simple") -> str:
    """Return a table with a line per robot and mode; ``style`` is one of tabulate's."""
    rows = [_row(mode, each) for mode, scores in scores_by_mode.items() for each in scores]
    return tabulate(rows, HEADERS, tablefmt=style, disable_numparse=True)


def summary(scores_by_mode: Scores) -> str:
    """Return a line per mode: mean scores of each side and task, and diverged episodes."""
    lines = []
    for mode, scores in scores_by_mode.items():
        groups = dict.fromkeys((each.side, each.task) for each in scores)
        means = []
        for side, task in groups:
            own = [each for each in scores if (each.side, each.task) == (side, task)]
            score = np.mean([each.score for each in own])
            success = success_of(own).as_percent()
            means.append(f"{SIDES[side]} {task} {score:.2f}, success {success}")
        unstable = sum(each.unstable for each in scores)
        if unstable:
            means.append(f"{UNSTABLE}: {unstable}")
        lines.append(f"{mode}: " + "; ".join(means))
    return "\n".join(lines)


def require_table(path: Path) -> None:
    """Require that a table can be written to a path.

    Raises:
        TaskError: If its suffix is unknown.
        FormatError: If its folder is missing or cannot be written.
    """
    if path.suffix not in SUFFIXES:
        raise TaskError(
            f"{path}: no name of a table ends in {path.suffix!r}{nearest(path.suffix, SUFFIXES)}"
        )
    require_writable_file(path)


def write_scores(path: Path, scores_by_mode: Scores) -> None:
    """Write CSV, JSON or Markdown, by the suffix of the path.

    Raises:
        TaskError: If the suffix is another one.
        FormatError: If it cannot be written.
    """
    require_table(path)
    data = {mode: scores_to_json(scores) for mode, scores in scores_by_mode.items()}
    if path.suffix == ".json":
        write_file(path, json.dumps(data, indent=2) + "\n")
    elif path.suffix == ".md":
        write_file(path, score_table(scores_by_mode, "github") + "\n")
    else:
        text = io.StringIO()
        writer = csv.DictWriter(text, ["mode", *SCORE_KEYS], lineterminator="\n")
        writer.writeheader()
        for mode, rows in data.items():
            writer.writerows({"mode": mode, **row} for row in rows)
        write_file(path, text.getvalue())


def _row(mode: str, score: Score) -> tuple[str, ...]:
    angle = "" if math.isnan(score.angle) else f", {math.degrees(score.angle):.1f} deg"
    interval = "" if math.isnan(score.low) else f"{score.low:.2f} to {score.high:.2f}"
    return (
        score.robot,
        score.side,
        score.task,
        mode,
        f"{score.score:.2f}",
        interval,
        success_of([score]).as_percent(),
        f"{score.raw:.2f}",
        f"{score.random:.2f}",
        f"{score.distance:.3f} m{angle}",
    )
