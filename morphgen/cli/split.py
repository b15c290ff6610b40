"""``morphgen split``: which robots to train on and which to test on."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from typing import TYPE_CHECKING

from morphgen.cli import split_checks, split_new
from morphgen.cli.options import Subparsers, add_json

if TYPE_CHECKING:
    from morphgen.benchmark.split import Member, Split

SHOWN = 60
"""Letters of a derivation that ``show`` prints without --full."""


def add_parser(commands: Subparsers) -> None:
    """Declare the command and its own."""
    parser = commands.add_parser(
        "split",
        help="list, make, audit, build and verify splits of train and test robots",
        description="Splits of robots to train on and robots to test on, as files of YAML.",
    )
    verbs = parser.add_subparsers(metavar="VERB", required=True)
    listing = verbs.add_parser("list", help="name the splits that come with morphgen")
    add_json(listing)
    listing.set_defaults(run=run_list)
    show = verbs.add_parser("show", help="print the robots of a split")
    show.add_argument("split", metavar="SPLIT", help="a split's file or name")
    show.add_argument(
        "--full",
        action="store_true",
        help="print derivations whole, and how the robots were chosen",
    )
    add_json(show)
    show.set_defaults(run=run_show)
    split_new.add(verbs)
    split_checks.add(verbs)


def run_list(args: argparse.Namespace) -> int:
    """Print a row a split."""
    from tabulate import tabulate

    from morphgen.benchmark.split_file import read_split, split_names

    splits = [read_split(name) for name in split_names()]
    if args.json:
        print(json.dumps([_facts(split) for split in splits], indent=2))
        return 0
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
    print(tabulate(rows, headers))
    return 0


def run_show(args: argparse.Namespace) -> int:
    """Print a split."""
    from tabulate import tabulate

    from morphgen.benchmark.split import SIDES, split_id
    from morphgen.benchmark.split_file import read_split

    split = read_split(args.split)
    if args.json:
        print(json.dumps({"id": split_id(split), **split.as_dict()}, indent=2))
        return 0
    print(f"{split.name} ({split.regime}): {split.summary}")
    print(f"  id: {split_id(split)}")
    if split.reference:
        print(f"  reference: {split.reference}")
    for key, value in split.provenance.items():
        if args.full or isinstance(value, int | str):
            print(f"  {key}: {_plain(value)}")
    for code, reason in split.accepted.items():
        print(f"  accepted {code}: {reason}")
    for side in SIDES:
        members = split.side(side)
        counts = ", ".join(f"{n} {name}" for name, n in _categories(members).items())
        print(f"\n{side}, {len(members)}: {counts}")
        headers = ("name", "task", "category", "body", "derivation")
        rows = [_row(member, args.full) for member in members]
        print(tabulate(rows, headers, disable_numparse=True))
    return 0


def _categories(members: Sequence[Member]) -> Counter[str]:
    return Counter(member.category for member in members)


def _tasks(split: Split) -> list[str]:
    """Its tasks, with obstacles where they are."""
    members = (*split.train, *split.test)
    found = {member.task + (" (obstacles)" if member.obstacles else "") for member in members}
    return sorted(found)


def _facts(split: Split) -> dict[str, object]:
    return {
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


def _row(member: Member, full: bool) -> tuple[str, ...]:
    text = member.derivation
    if not full and len(text) > SHOWN:
        text = f"{text[: SHOWN - 3]}..."
    task = member.task + (" (obstacles)" if member.obstacles else "")
    return (member.name, task, member.category, member.robot_hash[:8], text)


def _plain(value: object) -> str:
    """A value of a file as text."""
    return value if isinstance(value, str) else json.dumps(value).replace('"', "")
