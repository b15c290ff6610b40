"""``morphgen split audit``, ``build`` and ``verify``: check a split and write its robots."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import Option, command, flag, number, option, path_option
from morphgen.cli.goals import make_goals
from morphgen.cli.progress import bar
from morphgen.errors import BenchmarkError, GrammarError, PartError

if TYPE_CHECKING:
    from morphgen.benchmark.audit import Audit
    from morphgen.benchmark.near_duplicates import NearThresholds
    from morphgen.benchmark.split import Split
    from morphgen.benchmark.verify import Difference
    from morphgen.model.findings import Finding
    from morphgen.tasks.split_goals import SplitGoals

MAX_LISTED = 10
"""Largest number of findings of one code, or of differences, that are printed."""


def _goal_seed(help: str) -> Option:
    return number("--goal-seed", help, least=0)


@command(
    "audit",
    "look for leaks between train and test robots",
    option("split", metavar="SPLIT", help="name of a split, its file, or its built folder"),
    option(
        "--near",
        metavar="TREE,COSINE[,WORKSPACE]",
        help="robots are nearly the same if their tree distance is below, and their cosine "
        "similarity or, at one reach, their workspace overlap above "
        "(default: 0.001,0.99999,0.999)",
    ),
    flag("--strict", "fail on warnings, too"),
    flag("--goals", "audit goal sets even if the split ships none"),
    _goal_seed("seed that the goal sets must have (default: as shipped, else 0)"),
    *opt.JOBS_LIBRARY_JSON,
    details="The audit checks the rules of the split's regime, and names the nearest train robot "
    "of each test robot. If a built split ships goal sets, it also looks for goals that are on "
    "both sides, or out of reach. The exit code is 1 if there is an error that the split does not "
    "accept, or a warning with --strict.",
)
def audit(args: argparse.Namespace) -> int:
    """Audit a split and print the findings."""
    from morphgen.benchmark.audit import audit
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_line
    from morphgen.benchmark.split_source import read_split_or_folder

    near = _near(args.near)
    split, folder = read_split_or_folder(args.split)
    library = opt.library_of(args)
    with bar(args, "auditing") as update:
        result = audit(split, library, near=near, jobs=args.jobs, progress=update)
    result, goals = _audit_goals(args, result, split, folder)
    passed = result.passed(strict=args.strict)
    sets = {"sets": len(goals.sets), "seed": goals.config.seed} if goals else None
    try:
        parts = licenced_parts(split, library)
    except (GrammarError, PartError):  # the audit has a finding about it
        parts = ()
    limited = [part.as_dict() for part in restricted(parts)]
    data = {**result.as_dict(), "goals": sets, "restricted": limited, "passed": passed}
    line = restriction_line(parts)
    opt.print_result(args, data, lambda: _audit_text(result, passed, goals, line))
    return int(not passed)


def _near(text: str | None) -> NearThresholds:
    from morphgen.benchmark.near_duplicates import NEAR_THRESHOLDS, NearThresholds

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


def _audit_goals(
    args: argparse.Namespace, result: Audit, split: Split, folder: Path | None
) -> tuple[Audit, SplitGoals | None]:
    """Add the findings about goal sets to an audit; return the goal sets, too."""
    from morphgen.tasks.goal_audit import audit_goals, goals_to_audit, with_goal_findings

    sample = partial(make_goals, args, split) if args.goals else None
    goals = goals_to_audit(folder, args.goal_seed, sample)
    findings = None
    if goals is not None:
        with bar(args, "auditing goals") as update:
            library = opt.library_of(args)
            findings = audit_goals(split, goals, library, jobs=args.jobs, progress=update)
    return with_goal_findings(result, split, findings), goals


def _audit_text(result: Audit, passed: bool, goals: SplitGoals | None, limits: str) -> str:
    from tabulate import tabulate

    from morphgen.benchmark.similarity import MEASURES

    nearest: dict[str, list[str]] = {}
    for neighbour in result.neighbours:
        cell = f"{neighbour.train} {neighbour.value:.3f}"
        nearest.setdefault(neighbour.test, []).append(cell)
    rows = [(test, *cells) for test, cells in nearest.items()]
    headers = ("test robot", *(f"nearest by {name}" for name in MEASURES))
    lines = [tabulate(rows, headers, disable_numparse=True)] if rows else []
    for code, findings in _by_code(result.findings).items():
        lines.append(f"{findings[0].severity} {code} ({len(findings)})")
        lines += _listed(findings)
        lines.append(f"    fix: {findings[0].fix}")
    reasons = {finding.code: reason for finding, reason in result.accepted}
    for code, findings in _by_code([finding for finding, _ in result.accepted]).items():
        lines.append(f"accepted {code} ({len(findings)}): {reasons[code]}")
        lines += _listed(findings)
    if goals:
        lines.append(f"{len(goals.sets)} goal sets were audited, seed {goals.config.seed}")
    if limits:
        lines.append(limits)
    counts = ", ".join(
        f"{sum(finding.severity == severity for finding in result.findings)} {severity}"
        for severity in ("error", "warning")
    )
    verdict = "passed" if passed else "FAILED"
    lines.append(f"{result.split}: {verdict}: {counts}, {len(result.accepted)} accepted")
    return "\n".join(lines)


def _by_code(findings: Sequence[Finding]) -> dict[str, list[Finding]]:
    groups: dict[str, list[Finding]] = {}
    for finding in findings:
        groups.setdefault(finding.code, []).append(finding)
    return groups


def _listed(findings: Sequence[Finding | Difference]) -> list[str]:
    """Return a line per finding, and how many more there are."""
    more = len(findings) - MAX_LISTED
    lines = [f"  {finding.where}: {finding.why}" for finding in findings[:MAX_LISTED]]
    return [*lines, *([f"  and {more} more (--json lists all)"] if more > 0 else [])]


@command(
    "build",
    "write every robot of a split and its tokens into a folder",
    option("split", metavar="SPLIT", help="name of a split, or its file"),
    path_option("--out", "DIR", "folder where the split's folder goes", default=Path("data")),
    flag("--light", "write the URDF and the derivation only"),
    flag("--picture", "draw preview.png of every robot"),
    flag("--goals", "ship the goal set of every robot"),
    _goal_seed("with --goals: seed of the goal sets (default: 0)"),
    *opt.JOBS_LIBRARY_JSON,
    details="The same split gives the same bytes, with any number of jobs. Run the command again "
    "to continue an interrupted one.",
    examples=("split build interpolation/panda/reach --out data --goals --jobs 4",),
)
def build(args: argparse.Namespace) -> None:
    """Build a split and print where it is."""
    from morphgen.benchmark.licences import licenced_parts, restricted, restriction_text
    from morphgen.benchmark.split_file import read_split
    from morphgen.benchmark.split_folder_files import BuildSettings
    from morphgen.tasks.env_specs import GoalConfig
    from morphgen.tasks.split_building import build_with_goals

    settings = BuildSettings(light=args.light, picture=args.picture)
    if not args.goals:
        opt.reject_idle({"--goal-seed": args.goal_seed is not None}, "only with --goals")
    split, config = read_split(args.split), GoalConfig(args.goal_seed or 0)
    goals = make_goals(args, split, config) if args.goals else []
    with bar(args, "building") as update:
        report = build_with_goals(
            split,
            args.out,
            opt.library_of(args),
            settings,
            goals,
            config,
            jobs=args.jobs,
            progress=update,
        )
    written, kept = report.num_written, report.num_kept
    data: dict[str, object] = {"folder": str(report.folder), "made": written, "kept": kept}
    lines = [f"{report.folder}: {written} robots written, {kept} already existed"]
    if args.goals:
        data["goals"] = len(goals)
        lines.append(f"{len(goals)} goal sets, seed {config.seed}")
    if limited := restricted(licenced_parts(split, opt.library_of(args))):
        data["restricted"] = [part.as_dict() for part in limited]
        lines += [f"restricted: {restriction_text(part)}" for part in limited]
    lines.append(f"verify it anywhere: morphgen split verify {report.folder}")
    opt.print_result(args, data, lambda: "\n".join(lines))


@command(
    "verify",
    "verify that a split, its built folder or its release has the robots that it claims",
    option(
        "path",
        metavar="PATH",
        help="name of a split, its file, its built folder, or the archive of a release",
    ),
    *opt.JOBS_LIBRARY_JSON,
    details="Every robot is composed anew and compared: with the hashes of the split, or with all "
    "files of a built folder or a release. The exit code is 1 if something differs.",
)
def verify(args: argparse.Namespace) -> int:
    """Verify a split and print what differs."""
    from morphgen.benchmark.verify import verify

    with bar(args, "verifying") as update:
        result = verify(args.path, opt.library_of(args), jobs=args.jobs, progress=update)
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
