"""Lists of parts, grammars and splits, and a split's robots, without the packages for meshes."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from morphgen.cli import options as opt
from morphgen.cli.progress import status
from morphgen.errors import PartError
from morphgen.grammar.catalogue import catalogue
from morphgen.tables import table

if TYPE_CHECKING:  # the list of parts needs no splits
    from morphgen.splits.split import Member, Split

PART_KINDS = {
    "bases": "base",
    "arms": "arm",
    "ees": "ee",
    "segments": "segment",
    "bodies": "body",
    "objects": "object",
}


def list_parts(args: argparse.Namespace) -> None:
    """Print a table with a row per part."""
    with status(args, "reading the parts"):
        rows = catalogue(opt.library_of(args), PART_KINDS.get(args.kind))
    cells = [list(row.values()) for row in rows]
    last = ("source", "manufacturer")
    opt.print_result(args, rows, lambda: table(cells, list(rows[0]), formats=".3g", last=last))


def list_grammars(args: argparse.Namespace) -> None:
    """Print the names and summaries."""
    from morphgen.grammar.grammar_file import grammar_names, grammar_summary

    rows = [{"name": name, "robots": grammar_summary(name)} for name in grammar_names()]
    cells = [(row["name"], row["robots"]) for row in rows]
    opt.print_result(args, rows, lambda: table(cells, ("name", "robots")))


SHORT_DERIVATION = 60  # number of characters of a derivation that `show` prints; `--json` has all


def list_splits(args: argparse.Namespace) -> None:
    """Print a row per split."""
    from morphgen.splits.split import read_split, split_names

    splits = [read_split(name) for name in split_names()]
    data: list[dict[str, Any]] = [
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
            *(row["name"], row["regime"], ", ".join(row["tasks"]), row["train"], row["test"]),
            f"{', '.join(row['train_categories'])} -> {', '.join(row['test_categories'])}",
            row["summary"],
        )
        for row in data
    ]
    opt.print_result(args, data, lambda: table(rows, headers, formats="g"))


def show_split(args: argparse.Namespace) -> None:
    """Print a split."""
    from morphgen.benchmark.licences import licence_lines, licenced_parts
    from morphgen.splits.split import read_split, split_id

    split = read_split(args.split)
    try:
        parts = licenced_parts(split, opt.library_of(args))
        licences, lines = [part.as_dict() for part in parts], licence_lines(parts)
    except PartError as error:
        licences, lines = None, [f"licences: {error}; see --library"]
    data = {"id": split_id(split), **split.as_dict(), "licences": licences}
    opt.print_result(args, data, lambda: _split_text(split, lines))


def _split_text(split: Split, licences: Sequence[str]) -> str:
    from morphgen.splits.split import SIDES, split_id

    lines = [f"{split.name} ({split.regime}): {split.summary}", f"  id: {split_id(split)}"]
    if split.reference:
        lines.append(f"  reference: {split.reference}")
    made = split.provenance.items()
    lines += [f"  {key}: {value}" for key, value in made if isinstance(value, int | str)]
    lines += [f"  {line}" for line in licences]
    lines += [f"  accepted {code}: {reason}" for code, reason in split.accepted.items()]
    headers = ("name", "task", "category", "body", "derivation")
    for side in SIDES:
        members = split.side(side)
        counts = ", ".join(f"{n} {name}" for name, n in _categories(members).items())
        rows = [_row(member) for member in members]
        lines.append(f"\n{side}, {len(members)}: {counts}")
        lines.append(table(rows, headers))
    return "\n".join(lines)


def _row(member: Member) -> tuple[str, ...]:
    text = member.derivation
    if len(text) > SHORT_DERIVATION:
        text = f"{text[: SHORT_DERIVATION - 3]}..."
    return (member.name, _task(member), member.category, member.robot_hash[:8], text)


def _task(member: Member) -> str:
    return member.task + (" (obstacles)" if member.obstacles else "")


def _tasks(split: Split) -> list[str]:
    return sorted({_task(member) for member in (*split.train, *split.test)})


def _categories(members: Sequence[Member]) -> Counter[str]:
    return Counter(member.category for member in members)
