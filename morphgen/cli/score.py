"""``morphgen score``: compute the tables of results from episodes."""

from __future__ import annotations

import argparse
import sys
from dataclasses import asdict
from pathlib import Path

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option
from morphgen.errors import BenchmarkError

MODES = ("deterministic", "stochastic", "all")


@command(
    "score",
    "compute tables of results from the episodes of studies and evaluations",
    option(
        "files",
        nargs="+",
        type=Path,
        metavar="FILE",
        help="submission, or a folder with submissions at any depth, such as that of a study",
    ),
    option(
        "--mode",
        choices=MODES,
        default=MODES[0],
        help="policies that act by the mean of their actions, that sample them, or both",
    ),
    flag("--markdown", "print the tables as Markdown"),
    opt.JSON,
    details="A row has a method over all of its training seeds. IQM is the interquartile mean over "
    "seeds and robots, with a 95% bootstrap interval over the seeds if there are two or more. A "
    "success rate has a 95% Wilson interval over all episodes. The last column of a side is the "
    "difference to jacobian (reach) or scripted (push) in the same episodes, with a 95% bootstrap "
    "interval over the episodes of each robot. Splits that come with morphgen are compared by "
    "their id and the hashes of their robots.",
    examples=("score results", "score results/reach-30m --markdown"),
    extra="rl",
)
def score(args: argparse.Namespace) -> None:
    """Print a table for every split and task."""
    from morphgen.rl.score_tables import (
        cells_without_episodes,
        read_submissions,
        result_rows,
        result_tables,
    )
    from morphgen.rl.scores import finite_or_none

    submissions = read_submissions(args.files)
    if num_left := cells_without_episodes(args.files, submissions):
        print(
            f"morphgen: {num_left} cells of studies are left out: they have scores.json and no "
            "episodes; delete it, and morphgen study evaluates their checkpoints again",
            file=sys.stderr,
        )
    modes = {"", args.mode} if args.mode != "all" else {each.mode for each in submissions.values()}
    found = {where: each for where, each in submissions.items() if each.mode in modes}
    if not found:
        raise BenchmarkError(
            f"--mode {args.mode}: none of the {len(submissions)} submissions acts so; expected "
            f"--mode {' or '.join(mode for mode in MODES if mode != args.mode)}"
        )
    rows = result_rows(found)
    data = [finite_or_none(asdict(row)) for row in rows]
    notes = "MT: train robots, ZS: test robots; intervals: 95%"
    style = "github" if args.markdown else "simple"
    opt.print_result(args, data, lambda: f"{result_tables(rows, style)}\n{notes}")
