"""``morphgen split``: list, print and release splits of train and test robots."""

from __future__ import annotations

import argparse
import itertools
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from morphgen.cli import options as opt
from morphgen.cli.command import Command, command, flag, option
from morphgen.cli.progress import bar
from morphgen.cli.split_checks import audit, build, verify
from morphgen.cli.split_difficulty import difficulty
from morphgen.cli.split_regimes import new
from morphgen.cli.split_release import release, reveal
from morphgen.cli.split_score import score
from morphgen.errors import PartError

if TYPE_CHECKING:
    from morphgen.benchmark.split import Member, Split
    from morphgen.benchmark.statistics import PaperRow

SHORT_DERIVATION = 60
"""Number of characters of a derivation that ``show`` prints without ``--full``."""


@command("list", "list the splits that come with morphgen", opt.JSON)
def list_splits(args: argparse.Namespace) -> None:
    """Print a row per split."""
    from tabulate import tabulate

    from morphgen.benchmark.split_file import read_split, split_names

    splits = [read_split(name) for name in split_names()]
    data = [
        {
            "name": split.name,
            "regime": split.regime,
            "tasks": _tasks(split),
            "train": len(split.train),
            "test": len(split.test),
            "train_categories": _categories(split.train),
            "test_categories": _categories(split.test),
            "summary": split.summary,
            "reference": split.reference,
        }
        for split in splits
    ]
    headers = ("name", "regime", "task", "train", "test", "categories", "summary")
    rows = [
        (
            split.name,
            split.regime,
            ", ".join(_tasks(split)),
            len(split.train),
            len(split.test),
            f"{', '.join(_categories(split.train))} -> {', '.join(_categories(split.test))}",
            split.summary,
        )
        for split in splits
    ]
    opt.print_result(args, data, lambda: tabulate(rows, headers))


@command(
    "show",
    "print the robots of a split",
    option("split", metavar="SPLIT", help="name of a split, or its file"),
    flag("--full", "print whole derivations, and how the robots were chosen"),
    *opt.LIBRARY_JSON,
    details="Names the licences of the parts, and the robots with a part under a non-commercial, "
    "no-derivatives or unknown licence.",
    examples=("split show interpolation/panda/reach",),
)
def show(args: argparse.Namespace) -> None:
    """Print a split."""
    from morphgen.benchmark.licences import licence_lines, licenced_parts
    from morphgen.benchmark.split import split_id
    from morphgen.benchmark.split_file import read_split

    split = read_split(args.split)
    try:
        parts = licenced_parts(split, opt.library_of(args))
        licences, lines = [part.as_dict() for part in parts], licence_lines(parts)
    except PartError as error:
        licences, lines = None, [f"licences: {error}; see --library"]
    data = {"id": split_id(split), **split.as_dict(), "licences": licences}
    opt.print_result(args, data, lambda: _split_text(split, lines, full=args.full))


def _split_text(split: Split, licences: Sequence[str], *, full: bool) -> str:
    from tabulate import tabulate

    from morphgen.benchmark.split import SIDES, split_id

    lines = [f"{split.name} ({split.regime}): {split.summary}", f"  id: {split_id(split)}"]
    if split.reference:
        lines.append(f"  reference: {split.reference}")
    for key, value in split.provenance.items():
        if full or isinstance(value, int | str):
            text = value if isinstance(value, str) else json.dumps(value).replace('"', "")
            lines.append(f"  {key}: {text}")
    lines += [f"  {line}" for line in licences]
    lines += [f"  accepted {code}: {reason}" for code, reason in split.accepted.items()]
    headers = ("name", "task", "category", "body", "derivation")
    for side in SIDES:
        members = split.side(side)
        counts = ", ".join(f"{n} {name}" for name, n in _categories(members).items())
        rows = [_row(member, full=full) for member in members]
        lines.append(f"\n{side}, {len(members)}: {counts}")
        lines.append(tabulate(rows, headers, disable_numparse=True))
    return "\n".join(lines)


def _row(member: Member, *, full: bool) -> tuple[str, ...]:
    text = member.derivation
    if not full and len(text) > SHORT_DERIVATION:
        text = f"{text[: SHORT_DERIVATION - 3]}..."
    return (member.name, _task(member), member.category, member.robot_hash[:8], text)


def _task(member: Member) -> str:
    return member.task + (" (obstacles)" if member.obstacles else "")


def _tasks(split: Split) -> list[str]:
    return sorted({_task(member) for member in (*split.train, *split.test)})


def _categories(members: Sequence[Member]) -> Counter[str]:
    return Counter(member.category for member in members)


@command(
    "stats",
    "print statistics of splits next to those of the paper",
    option(
        "splits", nargs="*", metavar="SPLIT", help="names or files (default: all shipped splits)"
    ),
    flag("--markdown", "print the table as Markdown"),
    *opt.JOBS_LIBRARY_JSON,
    details="The columns are the mean numbers of links, of movable joints and of movable joints "
    "between base and tool of the train robots, and the cosine similarity of test and train "
    "robots; the paper's numbers are in parentheses. Splits with the same robots share a row.",
)
def stats(args: argparse.Namespace) -> None:
    """Print a table with a row per set of robots."""
    from tabulate import tabulate

    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_text
    from morphgen.benchmark.split_file import read_split, split_names
    from morphgen.benchmark.statistics import PAPER_TABLE, paper_row, statistics

    library = opt.library_of(args)
    groups = _by_robots([read_split(name) for name in args.splits or split_names()])
    statistics_by_title: dict[str, dict[str, Any]] = {}
    for title, splits in groups.items():
        with bar(args, title) as update:
            statistics_by_title[title] = statistics(
                splits[0], library, jobs=args.jobs, progress=update
            )
    limits = {
        title: restricted(licenced_parts(splits[0], library)) for title, splits in groups.items()
    }
    data = [
        {
            "robots": title,
            "splits": [split.name for split in splits],
            "ours": statistics_by_title[title],
            "paper": asdict(theirs) if (theirs := paper_row(title)) else None,
            "restricted": [part.as_dict() for part in limits[title]],
        }
        for title, splits in groups.items()
    ]

    def text() -> str:
        rows = [
            _stats_row(title, ours, paper_row(title)) for title, ours in statistics_by_title.items()
        ]
        style = "github" if args.markdown else "simple"
        lines = [
            tabulate(rows, "keys", tablefmt=style, disable_numparse=True),
            "",
            "links, joints, mass: mean over the train robots; cosine: of test and train robots",
            f"in parentheses: {PAPER_TABLE}",
        ]
        for title, parts in limits.items():
            lines += [f"restricted licence in {title}: {restriction_text(part)}" for part in parts]
        return "\n".join(lines)

    opt.print_result(args, {"rows": data, "paper": PAPER_TABLE}, text)


def _by_robots(splits: Sequence[Split]) -> dict[str, list[Split]]:
    """Return splits with the same robots together, by what their names have in common."""
    from morphgen.benchmark.split import SIDES

    groups: dict[tuple[tuple[str, ...], ...], list[Split]] = {}
    for split in splits:
        hashes = tuple(tuple(m.robot_hash for m in split.side(side)) for side in SIDES)
        groups.setdefault(hashes, []).append(split)
    return {_common_prefix([split.name for split in group]): group for group in groups.values()}


def _common_prefix(names: Sequence[str]) -> str:
    """Return the path segments that all names begin with, or the first name if there are none."""
    columns = zip(*(name.split("/") for name in names), strict=False)
    same = list(itertools.takewhile(lambda column: len(set(column)) == 1, columns))
    return "/".join(column[0] for column in same) or names[0]


def _stats_row(
    title: str, statistics: Mapping[str, Any], paper_row: PaperRow | None
) -> dict[str, str]:
    train, cosine = statistics["train"], statistics["cosine"]

    def with_paper(value: str, key: str) -> str:
        if paper_row is None:
            return value
        paper = getattr(paper_row, key)
        return f"{value} ({'-' if paper is None else f'{paper:g}'})"

    row = {"robots": title, "train": train["robots"], "test": statistics["test"]["robots"]}
    for key in ("links", "movable", "movable_to_tool"):
        row[key.replace("_", " ")] = with_paper(f"{train[key]:.4g}", key)
    row["cosine"] = with_paper(f"{cosine['mean']:.2f}", "cosine")
    row["least to largest"] = f"{cosine['min']:.2f} to {cosine['max']:.2f}"
    row["mass (kg)"] = f"{train['mass']['mean']:.3g}"
    row["reach (m)"] = f"{train['reach']['min']:.2f} to {train['reach']['max']:.2f}"
    return row


split = Command(
    "split",
    "list, make, audit, build, release and score splits of train and test robots",
    commands=(
        *(list_splits, show, new, audit, build, verify, stats, difficulty, release, score, reveal),
    ),
    details="A split is a YAML file with the robots to train on and those to test on.",
)
