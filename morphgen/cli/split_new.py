"""Choose the robots of splits and write them: what ``morphgen split new`` does for any regime."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from morphgen.cli import options as opt
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
    lines += _hold_out_notes(splits[-1], library)
    lines.append(f"next: morphgen split audit {paths[-1]}")
    opt.print_result(args, data, lambda: "\n".join(lines))


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
    words = [
        args.regime,
        args.robots_word(args),
        *tasks,
        *(["obstacles"] if args.obstacles else []),
    ]
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
    """Write all files, or none if one of them exists with another content.

    A file with the same content that another version of morphgen made is kept.
    """
    from morphgen.benchmark.split_file import write_split

    missing = []
    for split, path in zip(splits, paths, strict=True):
        if not path.is_file():
            missing.append((split, path))
        elif not _holds(path, split):
            raise BenchmarkError(
                f"{path} exists with another content; choose another --name or --out"
            )
    for split, path in missing:
        write_split(split, path)


def _holds(path: Path, split: Split) -> bool:
    """Test if a file is a split's, apart from the version of morphgen that made it."""
    from morphgen.benchmark.split_file import read_split_file, split_text

    try:
        version = read_split_file(path).split.version
    except BenchmarkError:
        return False
    return path.read_bytes() == split_text(replace(split, version=version)).encode()


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
    from morphgen.benchmark.hold_out_audit import related_parts
    from morphgen.benchmark.split import HOLD_OUT

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
