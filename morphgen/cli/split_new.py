"""``morphgen split new``: robots chosen by the rules of a regime."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    Subparsers,
    add_jobs,
    add_json,
    add_library,
    add_max_links,
    library_of,
)

if TYPE_CHECKING:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.split import Split
    from morphgen.grammar.grammar_file import Grammar
    from morphgen.grammar.library import Library

Splits = tuple["Split", ...]
Progress = Callable[[int], None]

DRAWN = "10"
"""Train robots that are drawn if no number is given."""


def add(verbs: Subparsers) -> None:
    """Declare the verb."""
    parser = verbs.add_parser(
        "new",
        help="make a split",
        description="Choose robots by the rules of a regime, and write them as a split. The same "
        "seed gives the same bytes, with any --jobs.",
    )
    regimes = parser.add_subparsers(metavar="REGIME", required=True)
    _add_interpolation(regimes)
    _add_composition(regimes)
    _add_extrapolation(regimes)


def _add_interpolation(regimes: Subparsers) -> None:
    parser = regimes.add_parser(
        "interpolation",
        help="test robots are train robots of other sizes",
        description="Test robots have the structure of a train robot, in other sizes.",
        epilog="example: morphgen split new interpolation --grammar arm3 --train 10 --test 1 "
        "--hull inside",
    )
    parser.add_argument(
        "--grammar", required=True, help="a grammar's name or file (see: morphgen grammar list)"
    )
    parser.add_argument(
        "--hull",
        choices=["inside", "outside", "any"],
        default="any",
        help="where parameters of test robots lie: in or out of the convex hull of those of the "
        "train robots of their structure (default: any)",
    )
    _add_order(parser, DRAWN)
    parser.set_defaults(run=run, generate=_interpolation)


def _add_composition(regimes: Subparsers) -> None:
    parser = regimes.add_parser(
        "composition",
        help="test robots join parts that are trained, but not together",
        description="Every part of a test robot is in a train robot, its combination in none. "
        "With several tasks, body and task are composed: the last part of a test robot, its "
        "end-effector, is trained at other tasks only.",
        epilog='example: morphgen split new composition --from "arm={ur5,panda,xarm7} '
        'ee={plane,stick,cylinder,sake_ez}" --train 10 --test 2 --task push',
    )
    parser.add_argument(
        "--from",
        dest="patterns",
        metavar="WORDS",
        action="append",
        required=True,
        help="words of morphgen compose with choices in braces; may be repeated",
    )
    _add_order(parser, "", "default: all that may be trained on")
    parser.set_defaults(run=run, generate=_composition)


def _add_extrapolation(regimes: Subparsers) -> None:
    parser = regimes.add_parser(
        "extrapolation",
        help="test robots are of a category that is not trained",
        description="Neither the category nor the structure of a test robot is trained.",
        epilog="example: morphgen split new extrapolation --train-category stick,nlink,prims "
        '--test-category chain --similarity "<0.6"',
    )
    for side in ("train", "test"):
        parser.add_argument(
            f"--{side}-category",
            metavar="GRAMMAR,...",
            required=True,
            help=f"grammars, by name or file, whose robots are {side} robots, in turn",
        )
    parser.add_argument(
        "--similarity",
        metavar="BOUND",
        default="",
        help="such as '<0.6': of every test robot's cosine to the train robot nearest to it",
    )
    _add_order(parser, DRAWN)
    parser.set_defaults(run=run, generate=_extrapolation)


def _add_order(parser: argparse.ArgumentParser, train: str, default: str = "") -> None:
    """Options that all regimes share."""
    parser.add_argument(
        "--train",
        metavar="N,...",
        default=train,
        help="robots to train on; several numbers give a split each, with the same test robots, "
        f"the smaller in the larger ({default or f'default: {train}'})",
    )
    parser.add_argument("--test", type=int, default=1, help="robots to test on (default: 1)")
    parser.add_argument(
        "--task", default="reach", metavar="TASK,...", help="one task or several (default: reach)"
    )
    parser.add_argument("--obstacles", action="store_true", help="tasks have obstacles")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    add_max_links(parser)
    parser.add_argument("--name", help="of the split (default: from the other options)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path(),
        metavar="FILE.yaml|DIR",
        help="the file, or the folder where <name>.yaml goes (default: here)",
    )
    parser.add_argument(
        "--statistics", action="store_true", help="add what morphgen split stats says to the file"
    )
    add_jobs(parser)
    add_library(parser)
    add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Choose, write and say what and where."""
    from dataclasses import replace

    from morphgen.benchmark.split_file import require_split_name
    from morphgen.benchmark.statistics import statistics

    order = _order(args)
    require_split_name(order.name)
    library = library_of(args)
    total = order.train[-1] + order.test if order.train else None
    with _bar(args, total) as progress:
        splits: Splits = args.generate(args, order, library, progress)
    if args.statistics:
        figures = (statistics(split, library, jobs=args.jobs) for split in splits)
        splits = tuple(
            replace(split, statistics=each) for split, each in zip(splits, figures, strict=True)
        )
    paths = _files(args.out, splits)
    _write(splits, paths)
    if args.json:
        print(json.dumps([_data(*pair) for pair in zip(splits, paths, strict=True)]))
        return 0
    for split, path in zip(splits, paths, strict=True):
        _print(split, path)
    print(f"next: morphgen split audit {paths[-1]}")
    return 0


def _interpolation(
    args: argparse.Namespace, order: SplitRequest, library: Library, progress: Progress
) -> Splits:
    from morphgen.benchmark.interpolation import interpolation

    (grammar,) = _grammars([args.grammar], library)
    return interpolation(order, grammar, library, hull=args.hull, jobs=args.jobs, progress=progress)


def _composition(
    args: argparse.Namespace, order: SplitRequest, library: Library, progress: Progress
) -> Splits:
    from morphgen.benchmark.composition import composition

    return composition(order, args.patterns, library, jobs=args.jobs, progress=progress)


def _extrapolation(
    args: argparse.Namespace, order: SplitRequest, library: Library, progress: Progress
) -> Splits:
    from morphgen.benchmark.extrapolation import extrapolation, parse_bound

    bound = parse_bound(args.similarity) if args.similarity else None
    train = _grammars(args.train_category.split(","), library)
    test = _grammars(args.test_category.split(","), library)
    return extrapolation(
        order, train, test, library, similarity=bound, jobs=args.jobs, progress=progress
    )


def _subject(args: argparse.Namespace) -> str:
    """What a split is about, in a word or two for its name."""
    if args.generate is _interpolation:
        return Path(args.grammar).stem + ("" if args.hull == "any" else f"-{args.hull}")
    if args.generate is _extrapolation:
        return "-".join(Path(name).stem for name in args.test_category.split(","))
    words = " ".join(args.patterns).split()
    keys = dict.fromkeys(word.partition("=")[0] for word in words if "={" in word)
    return "-".join(keys) or "robots"


def _order(args: argparse.Namespace) -> SplitRequest:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.token_layout import MAX_LINKS
    from morphgen.errors import BenchmarkError, nearest
    from morphgen.tasks.registry import TASKS

    tasks: list[str] = []
    for text in args.task.split(","):
        found = next((task for task in TASKS if task == text.strip()), None)
        if found is None or found in tasks:
            what = "is named twice" if found else f"is no task{nearest(text, TASKS)}"
            raise BenchmarkError(f"--task {args.task}: {text!r} {what}")
        tasks.append(found)
    try:
        train = tuple(int(text) for text in args.train.split(",")) if args.train else ()
    except ValueError as error:
        raise BenchmarkError(
            f"--train {args.train}: expected a whole number, or several such as 10,30,100"
        ) from error
    regime = args.generate.__name__.removeprefix("_")
    words = [regime, _subject(args), *tasks, *(["obstacles"] if args.obstacles else [])]
    name = args.name or "-".join([*words, f"seed{args.seed}"])
    links = MAX_LINKS if args.max_links is None else args.max_links
    return SplitRequest(name, train, args.test, tuple(tasks), args.obstacles, args.seed, links)


def _grammars(names: Sequence[str], library: Library) -> list[Grammar]:
    """Sound grammars, by name or file."""
    from morphgen.errors import GrammarError
    from morphgen.grammar.analysis import check_grammar
    from morphgen.grammar.grammar_file import find_grammar, load_grammar

    found = []
    for name in names:
        grammar = load_grammar(find_grammar(name.strip(), library.folders), library.folders)
        wrong = check_grammar(grammar, library)
        if wrong:
            raise GrammarError(wrong[0] + (f" (and {len(wrong) - 1} more)" if wrong[1:] else ""))
        found.append(grammar)
    return found


@contextmanager
def _bar(args: argparse.Namespace, total: int | None) -> Iterator[Progress]:
    from tqdm import tqdm

    with tqdm(total=total, unit="robot", file=sys.stderr, disable=args.json or None) as bar:

        def show(done: int) -> None:
            bar.update(done - bar.n)

        yield show


def _files(out: Path, splits: Splits) -> list[Path]:
    """Where each split goes."""
    if out.suffix != ".yaml":
        return [out / f"{split.name}.yaml" for split in splits]
    if len(splits) == 1:
        return [out]
    return [out.with_stem(f"{out.stem}-train{split.provenance['train']}") for split in splits]


def _write(splits: Splits, paths: Sequence[Path]) -> None:
    """Write all files, if none of them is another one's."""
    from morphgen.benchmark.split_file import split_text, write_split
    from morphgen.errors import BenchmarkError

    for split, path in zip(splits, paths, strict=True):
        if path.is_file() and path.read_bytes() != split_text(split).encode():
            raise BenchmarkError(
                f"{path} exists and says otherwise; choose another --name or --out"
            )
    for split, path in zip(splits, paths, strict=True):
        write_split(split, path)


def _data(split: Split, path: Path) -> dict[str, object]:
    from morphgen.benchmark.split import split_id

    facts = {"file": str(path), "name": split.name, "id": split_id(split)}
    return {**facts, "train": len(split.train), "test": len(split.test)}


def _print(split: Split, path: Path) -> None:
    """A line a split, and what is odd about it."""
    print(f"{path}: {split.summary}")
    print(f"  test: {', '.join(member.name for member in split.test)}")
    repeated = len(split.train) - len({(member.robot_hash, member.task) for member in split.train})
    if repeated:
        print(f"  {repeated} train robots have the body and task of an earlier one")
