"""Choose the robots of splits and write them: what ``morphgen split new`` does for any regime."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, cast

from morphgen.cli import options as opt
from morphgen.cli.command import Command, Option, flag, number, option, repeated
from morphgen.cli.progress import bar
from morphgen.errors import BenchmarkError

if TYPE_CHECKING:
    from morphgen.grammar.library import Library
    from morphgen.splits.split import Split


def new_split(args: argparse.Namespace) -> None:
    """Choose the robots, write the splits and print what they are."""
    from morphgen.api.splits import NewSplit
    from morphgen.api.splits import split as choose
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_line
    from morphgen.splits.split import split_id
    from morphgen.splits.split_file import split_paths, write_new_splits

    try:
        sizes = tuple(int(text) for text in args.train.split(",")) if args.train else ()
    except ValueError as error:
        raise BenchmarkError(
            f"--train {args.train}: expected a whole number, or several such as 10,30,100"
        ) from error
    total = sizes[-1] + args.test if sizes else None  # smaller splits are parts of the largest
    choice = opt.given(args, NewSplit.__annotations__)
    with bar(args, "sampling", total=total):
        loaded = choose(args.name or "", train=sizes, library=args.library, **choice)
    splits = [each.definition for each in loaded]
    paths = split_paths(args.out, splits)
    write_new_splits(splits, paths)
    library = opt.library_of(args)
    parts = [licenced_parts(split, library) for split in splits]
    data = [
        {
            "file": str(path),
            "name": split.name,
            "id": split_id(split),
            "train": len(split.train),
            "test": len(split.test),
            "restricted": [part.as_dict() for part in restricted(licenced)],
        }
        for split, path, licenced in zip(splits, paths, parts, strict=True)
    ]
    lines = [line for pair in zip(splits, paths, strict=True) for line in _summary(*pair)]
    lines += _hold_out_notes(splits[-1], library)  # the largest has all train robots
    if limits := restriction_line(parts[-1]):  # of the largest split
        lines.append(f"  {limits}")
    lines.append(f"next: morphgen split audit {paths[-1]}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _names(text: str) -> tuple[str, ...]:
    """Read names that are separated by commas; a type for argparse."""
    return tuple(name.strip() for name in text.split(",")) if text else ()


def _summary(split: Split, path: Path) -> list[str]:
    lines = [
        f"{path}: {split.summary}",
        f"  test: {', '.join(member.name for member in split.test)}",
    ]
    repeated = len(split.train) - len({(member.robot_hash, member.task) for member in split.train})
    if repeated:
        lines.append(f"  {repeated} train robots have the body and task of an earlier one")
    return lines


def _hold_out_notes(split: Split, library: Library) -> list[str]:
    """Return what a user of ``--hold-out`` may not expect."""
    from morphgen.benchmark.hold_out import related_parts
    from morphgen.splits.split import HOLD_OUT

    if split.regime != HOLD_OUT:
        return []
    left_out = cast("Mapping[str, int]", split.provenance.get("left_out", {}))
    return [
        *(f"  left out: {n} drawn robots with {reason}" for reason, n in left_out.items()),
        *(
            f"  note: train robots have {', '.join(names)}; --hold-out {rule} excludes parts of "
            "that manufacturer"
            for rule, names in related_parts(split, library).items()
        ),
    ]


def new_hold_out(args: argparse.Namespace) -> None:
    """Make a split from what it holds out."""
    if not args.hold_out:
        args.parser.error("the following arguments are required: --hold-out, or COMMAND")
    new_split(args)


def split_options(train: str, train_default: str = "") -> tuple[Option, ...]:
    """Return the options of all regimes; ``train`` is the default of ``--train``."""
    return (
        option(
            "--train N,...",
            "number of train robots; several numbers give a split each, with the same test "
            f"robots, the smaller within the larger (default: {train_default or train})",
            default=train,
        ),
        option("--test N", "number of test robots", int, default=1),
        option("--task TASK,...", "one task, or several with commas", _names, default="reach"),
        flag("--obstacles", "tasks have obstacles"),
        opt.SEED,
        number(
            "--max-links",
            "largest number of links of a robot, and the number that its tokens are padded to "
            "(default: 23)",
            least=2,
        ),
        option("--name", "name of the split (default: from the other options)"),
        option(
            "--out FILE.yaml|DIR",
            "the file, or the folder where NAME.yaml goes (default: this folder)",
            Path,
            default=Path(),
        ),
        flag("--statistics", "add the statistics of morphgen split stats to the file"),
        *opt.JOBS_LIBRARY_JSON,
    )


REGIMES = (
    Command(
        "interpolation",
        "test robots have the structure of train robots, in other sizes",
        (
            option(
                "--grammar",
                "name of a grammar (see: morphgen grammar list), or its file",
                _names,
                required=True,
            ),
            option(
                "--hull",
                "parameters of test robots are inside or outside of the convex hull of those "
                "of the train robots with the same structure",
                choices=["inside", "outside", "any"],
                default="any",
            ),
            *split_options("10"),
        ),
        new_split,
        examples=("split new interpolation --grammar arm3 --train 10 --test 1 --hull inside",),
        defaults={"regime": "interpolation"},
    ),
    Command(
        "composition",
        "test robots join parts that are trained, but not together",
        (
            repeated(
                "--from WORDS",
                "words of morphgen compose with choices in braces and wildcards",
                dest="robots",
                required=True,
                default=None,
            ),
            *split_options("", "all robots that may be trained on"),
        ),
        new_split,
        details="Every part of a test robot is in a train robot; its combination is in none. With "
        "several tasks, robot and task are combined: the end-effector of a test robot is trained "
        "at other tasks only.",
        examples=(
            'split new composition --from "arm={ur5,panda} ee={plane,stick,cylinder,sake_ez}" '
            "--train 7 --test 1 --task push",
        ),
        defaults={"regime": "composition"},
    ),
    Command(
        "extrapolation",
        "test robots are of a category that is not trained",
        (
            *(
                option(
                    f"--{side}-category GRAMMAR,...",
                    f"names or files of grammars whose robots are {side} robots, in turn",
                    _names,
                    required=True,
                )
                for side in ("train", "test")
            ),
            option(
                "--similarity BOUND",
                "bound on the cosine similarity of each test robot to its nearest train "
                "robot, such as '<0.6'",
                default="",
            ),
            *split_options("10"),
        ),
        new_split,
        details="Neither the category nor the structure of a test robot is trained.",
        examples=(
            "split new extrapolation --train-category stick,nlink,prims --test-category chain "
            '--similarity "<0.6"',
        ),
        defaults={"regime": "extrapolation"},
    ),
)
new = Command(
    "new",
    "choose train and test robots, and write them as a split",
    (
        repeated(
            "--hold-out RULE,...",
            "what test robots have and train robots do not: names of parts (arm=kinova*), a "
            "manufacturer (manufacturer=Kinova), a range of a parameter (arm3.length=0.3..0.4), or "
            "a combination (arm=ur5+ee=plane); several are separated by commas",
        ),
        repeated(
            "--from WORDS",
            "robots to draw from: words of morphgen compose with choices in braces and wildcards "
            "(default: 'arm=* ee=*')",
            dest="robots",
        ),
        option(
            "--grammar GRAMMAR,...",
            "draw robots from these grammars instead, or besides those of --from",
            _names,
            default="",
        ),
        *split_options("10"),
    ),
    new_hold_out,
    commands=REGIMES,
    details="With --hold-out, say what is held out. Or choose by the rules of a regime: see "
    "morphgen split new COMMAND --help. The same seed gives the same bytes, with any number of "
    "jobs.",
    examples=(
        "split new --hold-out 'arm=kinova*' --train 12 --test 4 --name my/no-kinova",
        "split new --hold-out arm=ur5+ee=plane,arm=panda+ee=stick --train 12 --test 2",
        "split new --hold-out manufacturer=Kinova --from 'arm=* ee={plane,stick}' --test 6",
        "split new --hold-out arm3.length=0.3..0.4 --grammar arm3 --test 4",
        'split new composition --from "arm={ur5,panda} ee={plane,stick}" --train 3',
    ),
    defaults={"regime": "hold-out"},
)
