"""``morphgen split audit``, ``build``, ``verify`` and ``stats``."""

from __future__ import annotations

import argparse
import itertools
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli.goals import (
    audit_with_goals,
    bar,
    read_split_or_built,
    ready_goals,
    require_room_for,
    ship_goals,
)
from morphgen.cli.options import Subparsers, add_jobs, add_json, add_library, library_of

if TYPE_CHECKING:
    from morphgen.benchmark.audit import Audit, NearThresholds
    from morphgen.benchmark.split import Split
    from morphgen.benchmark.statistics import PaperRow
    from morphgen.model.findings import Finding
    from morphgen.tasks.split_goals import SplitGoals

LISTED = 10
"""Findings of one code, or differences, that are printed."""


def add(verbs: Subparsers) -> None:
    """Declare the verbs."""
    _add_audit(verbs)
    _add_build(verbs)
    _add_verify(verbs)
    _add_stats(verbs)


def _add_audit(verbs: Subparsers) -> None:
    parser = verbs.add_parser(
        "audit",
        help="look for leaks between train and test",
        description="Look for leaks between train and test and for broken rules of the regime, "
        "and name the train robot nearest to every test robot. Goal sets that a built split ships "
        "are looked at, too: for goals that both sides have, or that cannot be reached. Exit code "
        "1 if there is an error that the split does not accept (with --strict: or a warning).",
    )
    parser.add_argument("split", metavar="SPLIT", help="a split's file, name or built folder")
    parser.add_argument(
        "--near",
        metavar="TREE,COSINE",
        help="bodies whose tree distance is below and whose cosine is above are nearly the same "
        "(default: 0.001,0.99999)",
    )
    parser.add_argument("--strict", action="store_true", help="warnings fail, too")
    parser.add_argument(
        "--goals", action="store_true", help="look at goal sets also if none are shipped"
    )
    _add_goal_seed(parser, "seed that the goal sets must have (default: as shipped, else 0)")
    _add_common(parser)
    parser.set_defaults(run=run_audit)


def _add_build(verbs: Subparsers) -> None:
    parser = verbs.add_parser(
        "build",
        help="write every robot of a split",
        description="Write every robot of a split, with its tokens, into a folder of the split's "
        "name. Interrupted, it goes on where it was when run again; the same split gives the same "
        "bytes, with any --jobs.",
    )
    parser.add_argument("split", metavar="SPLIT", help="a split's file or name")
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("data"), help="default: data/"
    )
    parser.add_argument("--light", action="store_true", help="URDF and derivation only")
    parser.add_argument("--picture", action="store_true", help="draw preview.png of every robot")
    parser.add_argument("--goals", action="store_true", help="ship the goal set of every robot")
    _add_goal_seed(parser, "with --goals: their seed (default: 0)")
    _add_common(parser)
    parser.set_defaults(run=run_build)


def _add_verify(verbs: Subparsers) -> None:
    parser = verbs.add_parser(
        "verify",
        help="prove that a split, or a built one, is what it claims to be",
        description="Compose every robot again and compare: with the hashes in a split's file, or "
        "with all files of a split that was built. Exit code 1 if something differs.",
    )
    parser.add_argument("path", metavar="PATH", help="a split's file or name, or a built folder")
    _add_common(parser)
    parser.set_defaults(run=run_verify)


def _add_stats(verbs: Subparsers) -> None:
    parser = verbs.add_parser(
        "stats",
        help="figures of splits, beside those of the paper",
        description="Print figures of splits: the mean number of links, movable joints and those "
        "on the way to the tool of the train robots, and the cosine similarity of test and train "
        "robots; the paper's in parentheses. Splits with the same robots share a row.",
    )
    parser.add_argument(
        "splits", nargs="*", metavar="SPLIT", help="files or names (default: all that are shipped)"
    )
    parser.add_argument("--markdown", action="store_true", help="print the table as Markdown")
    _add_common(parser)
    parser.set_defaults(run=run_stats)


def _add_goal_seed(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--goal-seed", metavar="S", type=int, help=text)


def _add_common(parser: argparse.ArgumentParser) -> None:
    add_jobs(parser)
    add_library(parser)
    add_json(parser)


def run_audit(args: argparse.Namespace) -> int:
    """Audit and print."""
    from morphgen.benchmark.audit import audit

    near = _near(args.near)
    split, folder = read_split_or_built(args.split)
    library = library_of(args)
    with bar(args) as progress:
        done = audit(split, library, near=near, jobs=args.jobs, progress=progress)
    done, goals = audit_with_goals(args, done, split, folder)
    passed = done.passed(strict=args.strict)
    if args.json:
        sets = {"sets": len(goals.sets), "seed": goals.config.seed} if goals else None
        print(json.dumps({**done.as_dict(), "goals": sets, "passed": passed}))
    else:
        print(_audit_text(done, passed, goals))
    return int(not passed)


def _near(text: str | None) -> NearThresholds:
    from morphgen.benchmark.audit import NEAR_THRESHOLDS, NearThresholds
    from morphgen.errors import BenchmarkError

    if text is None:
        return NEAR_THRESHOLDS
    try:
        tree, cosine = map(float, text.split(","))
    except ValueError as error:
        raise BenchmarkError(
            f"--near {text}: expected a tree distance and a cosine, such as 0.001,0.99999"
        ) from error
    if not (0 <= tree <= 1 and -1 <= cosine <= 1):
        raise BenchmarkError(
            f"--near {text}: a tree distance is from 0 to 1, and a cosine from -1 to 1"
        )
    return NearThresholds(tree, cosine)


def _audit_text(done: Audit, passed: bool, goals: SplitGoals | None) -> str:
    from tabulate import tabulate

    from morphgen.benchmark.similarity import MEASURES

    nearest: dict[str, list[str]] = {}
    for one in done.neighbours:
        nearest.setdefault(one.test, []).append(f"{one.train} {one.value:.3f}")
    rows = [(test, *cells) for test, cells in nearest.items()]
    headers = ("test robot", *(f"nearest by {name}" for name in MEASURES))
    lines = [tabulate(rows, headers, disable_numparse=True)] if rows else []
    for code, findings in _by_code(done.findings).items():
        lines.append(f"{findings[0].severity} {code} ({len(findings)})")
        lines += _shortened([f"  {each.where}: {each.why}" for each in findings])
        lines.append(f"    fix: {findings[0].fix}")
    reasons = {each.code: reason for each, reason in done.accepted}
    for code, findings in _by_code([each for each, _ in done.accepted]).items():
        lines.append(f"accepted {code} ({len(findings)}): {reasons[code]}")
        lines += _shortened([f"  {each.where}: {each.why}" for each in findings])
    if goals:
        lines.append(f"{len(goals.sets)} goal sets were looked at, seed {goals.config.seed}")
    counts = {
        severity: sum(each.severity == severity for each in done.findings)
        for severity in ("error", "warning")
    }
    text = ", ".join(f"{n} {severity}" for severity, n in counts.items())
    lines.append(
        f"{done.split}: {'passed' if passed else 'FAILED'}: {text}, {len(done.accepted)} accepted"
    )
    return "\n".join(lines)


def _by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    found: dict[str, list[Finding]] = {}
    for finding in findings:
        found.setdefault(finding.code, []).append(finding)
    return found


def _shortened(lines: Sequence[str]) -> list[str]:
    more = len(lines) - LISTED
    return [*lines[:LISTED], *([f"  and {more} more (--json lists all)"] if more > 0 else [])]


def run_build(args: argparse.Namespace) -> int:
    """Build and say where."""
    from morphgen.benchmark.split_build import build_split, split_folder_path
    from morphgen.benchmark.split_file import read_split
    from morphgen.benchmark.split_folder_files import BuildSettings
    from morphgen.errors import BenchmarkError

    if args.light and args.picture:
        raise BenchmarkError("--light writes no pictures; say --light or --picture")
    if args.goal_seed is not None and not args.goals:
        raise BenchmarkError("--goal-seed goes with --goals")
    settings = BuildSettings(light=args.light, picture=args.picture)
    split = read_split(args.split)
    library = library_of(args)
    require_room_for(split_folder_path(split, args.out), args.goals)
    goals = ready_goals(args, split) if args.goals else []
    with bar(args) as progress:
        report = build_split(
            split, args.out, library, jobs=args.jobs, settings=settings, progress=progress
        )
    if goals:
        ship_goals(args, report.folder, goals)
    if args.json:
        found = {"folder": str(report.folder), "made": report.num_written, "kept": report.num_kept}
        print(json.dumps(found | ({"goals": len(goals)} if goals else {})))
        return 0
    print(f"{report.folder}: {report.num_written} robots made, {report.num_kept} were there")
    if goals:
        print(f"{len(goals)} goal sets, seed {args.goal_seed or 0}")
    print(f"test it anywhere: morphgen split verify {report.folder}")
    return 0


def run_verify(args: argparse.Namespace) -> int:
    """Verify and print what differs."""
    from morphgen.benchmark.verify import verify

    with bar(args) as progress:
        found = verify(args.path, library_of(args), jobs=args.jobs, progress=progress)
    whole = not found.differences
    if args.json:
        differences = [{"where": each.where, "why": each.why} for each in found.differences]
        data = {"split": found.split.name, "id": found.id, "differences": differences}
        print(json.dumps({**data, "passed": whole}))
        return int(not whole)
    lines = _shortened([f"  {each.where}: {each.why}" for each in found.differences])
    n = len(found.split.train) + len(found.split.test)
    count = len(found.differences)
    differing = f"{count} difference{'' if count == 1 else 's'}"
    verdict = f"all {n} robots are the same" if whole else differing
    print("\n".join([f"{found.split.name}, id {found.id}: {verdict}", *lines]))
    return int(not whole)


def run_stats(args: argparse.Namespace) -> int:
    """Print the table."""
    from tabulate import tabulate

    from morphgen.benchmark.split_file import read_split, split_names
    from morphgen.benchmark.statistics import PAPER_TABLE, paper_row, statistics

    library = library_of(args)
    rows = _same_robots([read_split(name) for name in args.splits or split_names()])
    found: list[tuple[str, list[Split], dict[str, object]]] = []
    for title, splits in rows.items():
        with bar(args, title) as progress:
            figures = statistics(splits[0], library, jobs=args.jobs, progress=progress)
        found.append((title, splits, figures))
    if args.json:
        data = [
            {
                "robots": title,
                "splits": [split.name for split in splits],
                "ours": figures,
                "paper": asdict(theirs) if (theirs := paper_row(title)) else None,
            }
            for title, splits, figures in found
        ]
        print(json.dumps({"rows": data, "paper": PAPER_TABLE}))
        return 0
    lines = [_stats_row(title, figures) for title, _, figures in found]
    style = "github" if args.markdown else "simple"
    print(tabulate(lines, "keys", tablefmt=style, disable_numparse=True))
    print("\nlinks, joints, mass: mean over the train robots; cosine: of test and train robots")
    print(f"in parentheses: {PAPER_TABLE}")
    return 0


def _same_robots(splits: Sequence[Split]) -> dict[str, list[Split]]:
    """Splits that have the same bodies in the same order, by what their names have in common."""
    from morphgen.benchmark.split import SIDES

    groups: dict[tuple[tuple[str, ...], ...], list[Split]] = {}
    for split in splits:
        hashes = tuple(tuple(m.robot_hash for m in split.side(side)) for side in SIDES)
        groups.setdefault(hashes, []).append(split)
    return {_common([split.name for split in group]): group for group in groups.values()}


def _common(names: Sequence[str]) -> str:
    """The words that names begin with; the first name where there are none."""
    words = list(zip(*(name.split("/") for name in names), strict=False))
    same = list(itertools.takewhile(lambda column: len(set(column)) == 1, words))
    return "/".join(column[0] for column in same) or names[0]


def _stats_row(title: str, figures: Mapping[str, Any]) -> dict[str, str]:
    from morphgen.benchmark.statistics import paper_row

    train, cosine = figures["train"], figures["cosine"]
    theirs = paper_row(title)
    row = {"robots": title, "train": train["robots"], "test": figures["test"]["robots"]}
    for key in ("links", "movable", "movable_to_tool"):
        row[key.replace("_", " ")] = _beside(f"{train[key]:.4g}", theirs, key)
    row["cosine"] = _beside(f"{cosine['mean']:.2f}", theirs, "cosine")
    row["least to largest"] = f"{cosine['min']:.2f} to {cosine['max']:.2f}"
    row["mass (kg)"] = f"{train['mass']['mean']:.3g}"
    row["reach (m)"] = f"{train['reach']['min']:.2f} to {train['reach']['max']:.2f}"
    return row


def _beside(ours: str, theirs: PaperRow | None, key: str) -> str:
    """Our figure, the paper's in parentheses if there is one."""
    if theirs is None:
        return ours
    value = getattr(theirs, key)
    return f"{ours} ({'-' if value is None else f'{value:g}'})"
