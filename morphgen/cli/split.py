"""``morphgen split``: list, print and release splits of train and test robots."""

from __future__ import annotations

import argparse
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from morphgen.api.goals import goals as sample_goals
from morphgen.api.splits import DEFAULT_TRAIN, NewSplit
from morphgen.api.splits import split as open_split
from morphgen.benchmark import release as releases
from morphgen.benchmark.audit import Audit
from morphgen.benchmark.hold_out import related_parts
from morphgen.benchmark.licences import (
    licenced_parts,
    restricted,
    restriction_line,
    restriction_text,
)
from morphgen.benchmark.release import build_with_goals
from morphgen.benchmark.scores.results import study_results
from morphgen.benchmark.split_folder import BuildSettings, Difference, read_split_or_folder
from morphgen.benchmark.survey import (
    PAPER_TABLE,
    PaperRow,
    RobotDifficulty,
    difficulty_csv,
    difficulty_table,
    paper_row,
    split_difficulty,
    statistics,
)
from morphgen.cli import options as opt
from morphgen.cli.progress import bar
from morphgen.encoding.similarity import MEASURES, NEAR_THRESHOLDS, NearThresholds
from morphgen.errors import BenchmarkError, GrammarError, PartError
from morphgen.formats.files import require_writable_file, write_file
from morphgen.grammar.library import Library
from morphgen.model.findings import Finding
from morphgen.rl.baselines import BASELINES
from morphgen.splits.split import HOLD_OUT, SIDES, Split, split_id
from morphgen.splits.split_file import read_split, split_names, split_paths, write_new_splits
from morphgen.tables import table
from morphgen.tasks.goals.split_goals import GoalResult, sample_split_goals
from morphgen.tasks.scenes.env_specs import GoalConfig


def goals(args: argparse.Namespace) -> int:
    """Sample goal sets and print a table with the failures."""
    with bar(args, "sampling goals"):
        sets = sample_goals(" ".join(args.words), **opt.arguments(args, sample_goals))
    opt.print_result(args, sets.as_dict(), lambda: str(sets))
    return int(not sets.passed)


MAX_LISTED = 10
"""Largest number of findings of one code, or of differences, that are printed."""


def audit(args: argparse.Namespace) -> int:
    """Audit a split and print the findings."""
    near, split = _near(args.near), open_split(args.split, library=args.library)
    with bar(args, "auditing"):
        result = split.audit(near=near, goals=args.goals, goal_seed=args.goal_seed, jobs=args.jobs)
    passed = result.passed(strict=args.strict)
    try:
        parts = split.licences()
    except (GrammarError, PartError):  # the audit has a finding about it
        parts = ()
    limited = [part.as_dict() for part in restricted(parts)]
    data = {**result.as_dict(), "restricted": limited, "passed": passed}
    opt.print_result(args, data, lambda: _audit_text(result, passed, restriction_line(parts)))
    return int(not passed)


def _near(text: str | None) -> NearThresholds:
    if text is None:
        return NEAR_THRESHOLDS
    try:
        tree, cosine, *more = map(float, text.split(","))
        near = NearThresholds(tree, cosine, *more)
    except (ValueError, TypeError) as error:
        raise BenchmarkError(
            f"--near {text}: expected a tree distance and a cosine, such as 0.001,0.99999; a third "
            "number is the workspace overlap"
        ) from error
    if not (0 <= tree <= 1 and -1 <= cosine <= 1 and 0 <= near.workspace <= 1):
        raise BenchmarkError(
            f"--near {text}: a tree distance is from 0 to 1, a cosine from -1 to 1, and a "
            "workspace overlap from 0 to 1"
        )
    return near


def _audit_text(result: Audit, passed: bool, limits: str) -> str:
    rows = [
        (test, *(f"{found.train} {found.value:.3f}" for found in trains.values()))
        for test, trains in result.nearest.items()
    ]
    headers = ("test robot", *(f"nearest by {name}" for name in MEASURES))
    lines = [table(rows, headers)] if rows else []
    reasons = {finding.code: reason for finding, reason in result.accepted}
    for code, findings in _by_code(result.findings).items():
        lines.append(f"{findings[0].severity} {code} ({len(findings)})")
        lines += [*_listed(findings), f"    fix: {findings[0].fix}"]
    for code, findings in _by_code([finding for finding, _ in result.accepted]).items():
        lines.append(f"accepted {code} ({len(findings)}): {reasons[code]}")
        lines += _listed(findings)
    if result.goals:
        lines.append("{sets} goal sets were audited, seed {seed}".format_map(result.goals))
    if limits:
        lines.append(limits)
    counts = opt.severity_counts(result.findings, ("error", "warning"))
    verdict = "passed" if passed else "FAILED"
    lines.append(f"{result.split}: {verdict}: {counts}, {len(result.accepted)} accepted")
    return "\n".join(lines)


def _by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    """Return the findings of each code, in the order of the first of each."""
    codes = dict.fromkeys(finding.code for finding in findings)
    return {code: [each for each in findings if each.code == code] for code in codes}


def _listed(findings: Sequence[Finding | Difference]) -> list[str]:
    """Return a line per finding, and how many more there are."""
    more = len(findings) - MAX_LISTED
    lines = [f"  {finding.where}: {finding.why}" for finding in findings[:MAX_LISTED]]
    return [*lines, *([f"  and {more} more (--json lists all)"] if more > 0 else [])]


def build(args: argparse.Namespace) -> None:
    """Build a split and print where it is."""
    settings = BuildSettings(light=args.light, picture=args.picture)
    split, config = read_split(args.split), GoalConfig(args.goal_seed or 0)
    library, goals = opt.library_of(args), list[GoalResult]()
    if args.goals:
        with bar(args, "sampling goals"):
            goals = sample_split_goals(split, library, config, jobs=args.jobs)
    with bar(args, "building"):
        report = build_with_goals(split, args.out, library, settings, goals, config, jobs=args.jobs)
    written, kept = report.num_written, report.num_kept
    data: dict[str, object] = {"folder": str(report.folder), "made": written, "kept": kept}
    lines = [f"{report.folder}: {written} robots written, {kept} already existed"]
    if args.goals:
        data["goals"] = len(goals)
        lines.append(f"{len(goals)} goal sets, seed {config.seed}")
    if limited := restricted(licenced_parts(split, library)):
        data["restricted"] = [part.as_dict() for part in limited]
        lines += [f"restricted: {restriction_text(part)}" for part in limited]
    lines.append(f"verify it anywhere: morphgen split verify {report.folder}")
    opt.print_result(args, data, lambda: "\n".join(lines))


def verify(args: argparse.Namespace) -> int:
    """Verify a split and print what differs."""
    with bar(args, "verifying"):
        result = releases.verify(args.path, opt.library_of(args), jobs=args.jobs)
    differences, split = result.differences, result.split
    data = {
        "split": split.name,
        "id": result.id,
        "differences": [{"where": each.where, "why": each.why} for each in differences],
        "passed": not differences,
        **({"content": result.content} if result.content else {}),
    }

    def text() -> str:
        verdict = f"{len(differences)} difference{'' if len(differences) == 1 else 's'}"
        if not differences:
            verdict = f"all {len(split.train) + len(split.test)} robots are the same"
        lines = [f"{split.name}, id {result.id}: {verdict}", *_listed(differences)]
        if result.content and not differences:
            lines.append(f"  content: {result.content}")
        return "\n".join(lines)

    opt.print_result(args, data, text)
    return int(bool(differences))


def difficulty(args: argparse.Namespace) -> None:
    """Measure the robots of splits, print a table per split and write the file."""
    if args.csv is not None:
        require_writable_file(args.csv, "--csv", ".csv")
    words: dict[str, str] = {}
    splits = [read_split_or_folder(name)[0] for name in args.splits]
    for split, name in zip(splits, args.splits, strict=True):
        opt.require_other_name(words, split.name, name)
    results = [study_results(args.study, split) if args.study else {} for split in splits]
    library = opt.library_of(args)
    rows: list[RobotDifficulty] = []
    for split, known in zip(splits, results, strict=True):
        with bar(args, split.name):
            rows += split_difficulty(split, library, results=known, jobs=args.jobs)
    baselines = [name for name in BASELINES if any(name in known for known in results)]
    if args.csv is not None:
        write_file(args.csv, difficulty_csv(rows, baselines))
    files = [] if args.csv is None else [str(args.csv)]
    data = {"rows": [row.as_dict() for row in rows], "files": files}
    opt.print_result(args, data, lambda: _difficulty_text(rows, splits, baselines, files))


def _difficulty_text(
    rows: Sequence[RobotDifficulty],
    splits: Sequence[Split],
    baselines: Sequence[str],
    files: Sequence[str],
) -> str:
    """Return a table per split, each with the baselines of its tasks, and the written files."""
    parts = []
    for split in splits:
        own = [row for row in rows if row.split == split.name]
        columns = [name for name in baselines if any(name in row.baselines for row in own)]
        parts.append(f"{split.name}\n{difficulty_table(own, columns)}")
    notes = ["nearest: the most similar other train robot and its value by each measure"]
    if baselines:
        notes.append("baselines: score, success rate")
    return "\n".join(["\n\n".join(parts), "", *notes, *files])


def stats(args: argparse.Namespace) -> None:
    """Print a table with a row per set of robots."""
    library = opt.library_of(args)
    groups = _by_robots([read_split(name) for name in args.splits or split_names()])
    statistics_by_title: dict[str, dict[str, Any]] = {}
    for title, splits in groups.items():
        with bar(args, title):
            statistics_by_title[title] = statistics(splits[0], library, jobs=args.jobs)
    limits = {
        title: restricted(licenced_parts(splits[0], library)) for title, splits in groups.items()
    }
    data = [
        {
            "robots": title,
            "splits": [split.name for split in splits],
            "ours": statistics_by_title[title],
            "paper": paper_row(title),
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
            table([list(row.values()) for row in rows], list(rows[0]), style=style),
            "",
            "links, joints, mass: mean over the train robots; cosine: of test and train robots",
            f"in parentheses: {PAPER_TABLE}",
        ]
        for title, parts in limits.items():
            lines += [f"restricted licence in {title}: {restriction_text(part)}" for part in parts]
        return "\n".join(lines)

    opt.print_result(args, {"rows": data, "paper": PAPER_TABLE}, text)


def _by_robots(splits: Sequence[Split]) -> dict[str, list[Split]]:
    """Return splits of one folder with the same robots, by what their names have in common."""
    groups: dict[tuple[str, tuple[tuple[str, ...], ...]], list[Split]] = {}
    for split in splits:
        # The robots are compared in their order.
        hashes = tuple(tuple(m.robot_hash for m in split.side(side)) for side in SIDES)
        groups.setdefault((split.name.rpartition("/")[0], hashes), []).append(split)
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
        paper = paper_row[key]
        return f"{value} ({'-' if paper is None else f'{paper:g}'})"

    row = {"robots": title, "train": train["robots"], "test": statistics["test"]["robots"]}
    for key in ("links", "movable", "movable_to_tool"):
        row[key.replace("_", " ")] = with_paper(f"{train[key]:.4g}", key)
    row["cosine"] = with_paper(f"{cosine['mean']:.2f}", "cosine")
    row["least to largest"] = f"{cosine['min']:.2f} to {cosine['max']:.2f}"
    row["mass (kg)"] = f"{train['mass']['mean']:.3g}"
    row["reach (m)"] = f"{train['reach']['min']:.2f} to {train['reach']['max']:.2f}"
    return row


def new(args: argparse.Namespace) -> None:
    """Choose the robots, write the splits and print what they are."""
    if args.subcommand is None and not args.hold_out:
        args.parser.error("the following arguments are required: --hold-out, or COMMAND")
    choice = opt.given(args, NewSplit.__annotations__)
    choice["regime"] = args.subcommand or HOLD_OUT
    train = args.train
    if train is None:
        train = () if choice["regime"] == "composition" else (DEFAULT_TRAIN,)
    # Smaller splits are parts of the largest.
    total = train[-1] + args.test if train else None
    with bar(args, "sampling", total=total):
        loaded = open_split(args.name or "", train=train, library=args.library, **choice)
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
