"""``morphgen split difficulty``: size, nearest train robots and baselines, robot by robot."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, option, path_option
from morphgen.cli.progress import bar

if TYPE_CHECKING:
    from collections.abc import Sequence

    from morphgen.benchmark.difficulty import BaselineResults, RobotDifficulty
    from morphgen.benchmark.split import Split


@command(
    "difficulty",
    "print how hard each robot of splits is: size, nearest train robots, baselines",
    option(
        "splits",
        nargs="+",
        metavar="SPLIT",
        help="names of splits, their files, or their built folders",
    ),
    path_option(
        "--study",
        "FOLDER",
        "output folder of morphgen study, for score and success of the baselines",
    ),
    path_option("--csv", "FILE", "write a row per robot"),
    *opt.JOBS_LIBRARY_JSON,
    details="The columns are the movable joints between root and tool, links, reach, and by each "
    "similarity measure the nearest other train robot with its value. With --study, score and "
    "success rate of each baseline of the study follow; scores of reach are relative to the random "
    "policy.",
    examples=(
        "split difficulty interpolation/arm3/reach --csv arm3.csv",
        "split difficulty extrapolation/arms/reach --study results/reach-30m",
    ),
)
def difficulty(args: argparse.Namespace) -> None:
    """Measure the robots of splits, print a table per split and write the file."""
    from morphgen.benchmark.difficulty import split_difficulty
    from morphgen.benchmark.difficulty_table import difficulty_csv
    from morphgen.formats.files import require_writable_file, write_file

    if args.csv is not None:
        require_writable_file(args.csv, "--csv", ".csv")
    splits = _splits(args.splits)
    results = _results(args.study, splits)
    library = opt.library_of(args)
    rows: list[RobotDifficulty] = []
    for split, known in zip(splits, results, strict=True):
        with bar(args, split.name) as update:
            rows += split_difficulty(split, library, results=known, jobs=args.jobs, progress=update)
    baselines = _baselines(results)
    if args.csv is not None:
        write_file(args.csv, difficulty_csv(rows, baselines))
    files = [] if args.csv is None else [str(args.csv)]
    data = {"rows": [row.as_dict() for row in rows], "files": files}
    opt.print_result(args, data, lambda: _text(rows, splits, baselines, files))


def _splits(names: Sequence[str]) -> list[Split]:
    """Return the splits; two of one name could not be told apart in the rows."""
    from morphgen.benchmark.split_source import read_split_or_folder

    words: dict[str, str] = {}
    splits = []
    for name in names:
        split, _ = read_split_or_folder(name)
        opt.require_other_name(words, split.name, name)
        splits.append(split)
    return splits


def _results(study: Path | None, splits: Sequence[Split]) -> list[BaselineResults]:
    """Return the results of the baselines of a study on each split; none without a study."""
    if study is None:
        return [{} for _ in splits]
    from morphgen.rl.baseline_results import study_results

    return [study_results(study, split) for split in splits]


def _baselines(results: Sequence[BaselineResults]) -> tuple[str, ...]:
    """Return the names of all baselines with results, in the order of their registry."""
    from morphgen.rl.baselines import BASELINES

    return tuple(name for name in BASELINES if any(name in known for known in results))


def _text(
    rows: Sequence[RobotDifficulty],
    splits: Sequence[Split],
    baselines: Sequence[str],
    files: Sequence[str],
) -> str:
    """Return a table per split, each with the baselines of its tasks, and the written files."""
    from morphgen.benchmark.difficulty_table import difficulty_table

    parts = []
    for split in splits:
        own = [row for row in rows if row.split == split.name]
        columns = [name for name in baselines if any(name in row.baselines for row in own)]
        parts.append(f"{split.name}\n{difficulty_table(own, columns)}")
    notes = ["nearest: the most similar other train robot and its value by each measure"]
    if baselines:
        notes.append("baselines: score, success rate")
    return "\n".join(["\n\n".join(parts), "", *notes, *files])
