"""``morphgen split new``: robots chosen by the rules of a regime."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import Command, Option, flag, number, option, path_option, repeated
from morphgen.cli.progress import bar
from morphgen.errors import BenchmarkError, nearest
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.split import Split
    from morphgen.grammar.library import Library

Progress = Callable[[int], None]


def new_split(args: argparse.Namespace) -> None:
    """Choose the robots, write the splits and print what they are."""
    from morphgen.benchmark.split import split_id
    from morphgen.benchmark.split_file import require_split_name
    from morphgen.benchmark.statistics import statistics

    request = _request(args)
    require_split_name(request.name)
    library = opt.library_of(args)
    total = request.train[-1] + request.test if request.train else None
    with bar(args, "sampling", total=total) as update:
        splits: tuple[Split, ...] = args.generate(args, request, library, update)
    if args.statistics:
        splits = tuple(
            replace(split, statistics=statistics(split, library, jobs=args.jobs))
            for split in splits
        )
    paths = _paths(args.out, splits)
    _write(splits, paths)
    data = [
        {
            "file": str(path),
            "name": split.name,
            "id": split_id(split),
            "train": len(split.train),
            "test": len(split.test),
        }
        for split, path in zip(splits, paths, strict=True)
    ]
    lines = [line for pair in zip(splits, paths, strict=True) for line in _summary(*pair)]
    lines.append(f"next: morphgen split audit {paths[-1]}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _regime_options(train: str, train_default: str = "") -> tuple[Option, ...]:
    return (
        option(
            "--train",
            metavar="N,...",
            default=train,
            help="number of train robots; several numbers give a split each, with the same test "
            f"robots, the smaller within the larger (default: {train_default or train})",
        ),
        option("--test", type=int, default=1, metavar="N", help="number of test robots"),
        option(
            "--task", default="reach", metavar="TASK,...", help="one task, or several with commas"
        ),
        flag("--obstacles", "tasks have obstacles"),
        opt.SEED,
        number(
            "--max-links",
            "largest number of links of a robot, and the number that its tokens are padded to "
            "(default: 23)",
            least=2,
        ),
        option("--name", help="name of the split (default: from the other options)"),
        path_option(
            "--out",
            "FILE.yaml|DIR",
            "the file, or the folder where NAME.yaml goes (default: this folder)",
            default=Path(),
        ),
        flag("--statistics", "add the statistics of morphgen split stats to the file"),
        *opt.JOBS_LIBRARY_JSON,
    )


def _interpolation(
    args: argparse.Namespace, request: SplitRequest, library: Library, progress: Progress
) -> tuple[Split, ...]:
    from morphgen.benchmark.interpolation import interpolation

    grammar = opt.load_grammar_named(args.grammar, library, sound=True)
    return interpolation(
        request, grammar, library, hull=args.hull, jobs=args.jobs, progress=progress
    )


def _composition(
    args: argparse.Namespace, request: SplitRequest, library: Library, progress: Progress
) -> tuple[Split, ...]:
    from morphgen.benchmark.composition import composition

    return composition(request, args.patterns, library, jobs=args.jobs, progress=progress)


def _extrapolation(
    args: argparse.Namespace, request: SplitRequest, library: Library, progress: Progress
) -> tuple[Split, ...]:
    from morphgen.benchmark.extrapolation import extrapolation, parse_bound

    bound = parse_bound(args.similarity) if args.similarity else None
    train, test = (
        [opt.load_grammar_named(name.strip(), library, sound=True) for name in names.split(",")]
        for names in (args.train_category, args.test_category)
    )
    return extrapolation(
        request, train, test, library, similarity=bound, jobs=args.jobs, progress=progress
    )


def _robots_word(args: argparse.Namespace) -> str:
    """Return a word or two about the robots of a split, for its name."""
    if args.generate is _interpolation:
        return Path(args.grammar).stem + ("" if args.hull == "any" else f"-{args.hull}")
    if args.generate is _extrapolation:
        return "-".join(Path(name).stem for name in args.test_category.split(","))
    words = " ".join(args.patterns).split()
    keys = dict.fromkeys(word.partition("=")[0] for word in words if "={" in word)
    return "-".join(keys) or "robots"


def _request(args: argparse.Namespace) -> SplitRequest:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.token_layout import MAX_LINKS

    tasks = [text.strip() for text in args.task.split(",")]
    for i, task in enumerate(tasks):
        if task not in TASKS:
            raise BenchmarkError(f"--task {args.task}: unknown task {task!r}{nearest(task, TASKS)}")
        if task in tasks[:i]:
            raise BenchmarkError(f"--task {args.task}: {task!r} is named twice")
    try:
        train = tuple(int(text) for text in args.train.split(",")) if args.train else ()
    except ValueError as error:
        raise BenchmarkError(
            f"--train {args.train}: expected a whole number, or several such as 10,30,100"
        ) from error
    regime = args.generate.__name__.removeprefix("_")
    words = [regime, _robots_word(args), *tasks, *(["obstacles"] if args.obstacles else [])]
    name = args.name or "-".join([*words, f"seed{args.seed}"])
    links = MAX_LINKS if args.max_links is None else args.max_links
    return SplitRequest(name, train, args.test, tuple(tasks), args.obstacles, args.seed, links)


def _paths(out: Path, splits: Sequence[Split]) -> list[Path]:
    if out.suffix != ".yaml":
        return [out / f"{split.name}.yaml" for split in splits]
    if len(splits) == 1:
        return [out]
    return [out.with_stem(f"{out.stem}-train{split.provenance['train']}") for split in splits]


def _write(splits: Sequence[Split], paths: Sequence[Path]) -> None:
    """Write all files, or none if one of them exists with another content."""
    from morphgen.benchmark.split_file import split_text, write_split

    for split, path in zip(splits, paths, strict=True):
        if path.is_file() and path.read_bytes() != split_text(split).encode():
            raise BenchmarkError(
                f"{path} exists with another content; choose another --name or --out"
            )
    for split, path in zip(splits, paths, strict=True):
        write_split(split, path)


def _summary(split: Split, path: Path) -> list[str]:
    lines = [
        f"{path}: {split.summary}",
        f"  test: {', '.join(member.name for member in split.test)}",
    ]
    repeated = len(split.train) - len({(member.robot_hash, member.task) for member in split.train})
    if repeated:
        lines.append(f"  {repeated} train robots have the body and task of an earlier one")
    return lines


REGIMES = (
    Command(
        "interpolation",
        "test robots have the structure of train robots, in other sizes",
        (
            option(
                "--grammar",
                required=True,
                help="name of a grammar (see: morphgen grammar list), or its file",
            ),
            option(
                "--hull",
                choices=["inside", "outside", "any"],
                default="any",
                help="parameters of test robots are inside or outside of the convex hull of those "
                "of the train robots with the same structure",
            ),
            *_regime_options("10"),
        ),
        new_split,
        examples=("split new interpolation --grammar arm3 --train 10 --test 1 --hull inside",),
        defaults={"generate": _interpolation},
    ),
    Command(
        "composition",
        "test robots join parts that are trained, but not together",
        (
            repeated(
                "--from",
                "words of morphgen compose with choices in braces",
                dest="patterns",
                metavar="WORDS",
                required=True,
                default=None,
            ),
            *_regime_options("", "all robots that may be trained on"),
        ),
        new_split,
        details="Every part of a test robot is in a train robot; its combination is in none. With "
        "several tasks, robot and task are combined: the end-effector of a test robot is trained "
        "at other tasks only.",
        examples=(
            'split new composition --from "arm={ur5,panda} ee={plane,stick,cylinder,sake_ez}" '
            "--train 7 --test 1 --task push",
        ),
        defaults={"generate": _composition},
    ),
    Command(
        "extrapolation",
        "test robots are of a category that is not trained",
        (
            *(
                option(
                    f"--{side}-category",
                    metavar="GRAMMAR,...",
                    required=True,
                    help=f"names or files of grammars whose robots are {side} robots, in turn",
                )
                for side in ("train", "test")
            ),
            option(
                "--similarity",
                metavar="BOUND",
                default="",
                help="bound on the cosine similarity of each test robot to its nearest train "
                "robot, such as '<0.6'",
            ),
            *_regime_options("10"),
        ),
        new_split,
        details="Neither the category nor the structure of a test robot is trained.",
        examples=(
            "split new extrapolation --train-category stick,nlink,prims --test-category chain "
            '--similarity "<0.6"',
        ),
        defaults={"generate": _extrapolation},
    ),
)
new = Command(
    "new",
    "choose train and test robots by the rules of a regime, and write them as a split",
    commands=REGIMES,
    details="The same seed gives the same bytes, with any number of jobs.",
)
