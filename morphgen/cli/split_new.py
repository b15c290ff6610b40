"""Choose the robots of splits and write them: what ``morphgen split new`` does for any regime."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from morphgen.cli import options as opt
from morphgen.cli.progress import bar
from morphgen.errors import BenchmarkError, nearest
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.new_split import RobotChoice
    from morphgen.benchmark.split import Split
    from morphgen.grammar.library import Library


def new_split(args: argparse.Namespace) -> None:
    """Choose the robots, write the splits and print what they are."""
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_line
    from morphgen.benchmark.new_split import choose_robots
    from morphgen.benchmark.split import split_id
    from morphgen.benchmark.split_file import require_split_name
    from morphgen.benchmark.split_writing import split_paths, write_new_splits
    from morphgen.benchmark.statistics import statistics

    request = _request(args)
    require_split_name(request.name)
    library = opt.library_of(args)
    total = request.train[-1] + request.test if request.train else None
    with bar(args, "sampling", total=total) as update:
        splits = choose_robots(_choice(args), request, library, jobs=args.jobs, progress=update)
    if args.statistics:
        splits = tuple(
            replace(split, statistics=statistics(split, library, jobs=args.jobs))
            for split in splits
        )
    paths = split_paths(args.out, splits)
    write_new_splits(splits, paths)
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
    lines += _hold_out_notes(splits[-1], library)
    if limits := restriction_line(parts[-1]):  # of the largest split
        lines.append(f"  {limits}")
    lines.append(f"next: morphgen split audit {paths[-1]}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def _request(args: argparse.Namespace) -> SplitRequest:
    from morphgen.benchmark.generate import SplitRequest
    from morphgen.benchmark.new_split import default_name
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
    name = args.name or default_name(_choice(args), tasks, args.obstacles, args.seed)
    links = MAX_LINKS if args.max_links is None else args.max_links
    return SplitRequest(name, train, args.test, tuple(tasks), args.obstacles, args.seed, links)


def _choice(args: argparse.Namespace) -> RobotChoice:
    """Return the rules that the options of a regime name."""
    from morphgen.benchmark.new_split import RobotChoice

    grammar = getattr(args, "grammar", "")
    return RobotChoice(
        args.regime,
        hold_out=tuple(getattr(args, "hold_out", ())),
        robots=tuple(getattr(args, "patterns", ())),
        grammar=(grammar,) if args.regime == "interpolation" else _names(grammar),
        train_category=_names(getattr(args, "train_category", "")),
        test_category=_names(getattr(args, "test_category", "")),
        hull=getattr(args, "hull", ""),
        similarity=getattr(args, "similarity", ""),
    )


def _names(text: str) -> tuple[str, ...]:
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
