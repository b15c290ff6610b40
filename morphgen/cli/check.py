"""``morphgen check``: findings about robots."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_json, add_root
from morphgen.errors import one_line

if TYPE_CHECKING:
    from morphgen.model.findings import Finding


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "check",
        help="say what is wrong with robots, and how to mend it",
        description="Say what is wrong with robots. Exit code 1 if there is an error "
        "(with --strict: or a warning).",
    )
    parser.add_argument("robots", nargs="+", type=Path, help="bundles' folders, URDFs or xacros")
    parser.add_argument("--strict", action="store_true", help="warnings fail, too")
    parser.add_argument(
        "--fix",
        metavar="DIR",
        type=Path,
        help="write bundles with the safe repairs applied to this folder",
    )
    add_root(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check every robot; print findings."""
    failing = ("error", "warning") if args.strict else ("error",)
    report: dict[str, dict[str, list[dict[str, object]]]] = {}
    failed = False
    for path in args.robots:
        findings, repaired = _checked(path, args.fix, args.root)
        report[str(path)] = {
            "findings": [finding.as_dict() for finding in findings],
            "repaired": [finding.as_dict() | {"repair": finding.repair} for finding in repaired],
        }
        failed |= any(finding.severity in failing for finding in findings)
        if not args.json:
            _print(path, findings, repaired)
    if args.json:
        print(json.dumps(report, indent=2))
    return int(failed)


def _checked(
    path: Path, fix_into: Path | None, root: Path | None
) -> tuple[tuple[Finding, ...], tuple[Finding, ...]]:
    """What is wrong with a robot, and what was before its repair into a folder, if any."""
    from morphgen.checks import check, fix
    from morphgen.formats.bundle import CARD, bundle_folder, file_findings, read_robot, write_bundle
    from morphgen.formats.urdf import UnsoundError

    try:
        robot = read_robot(path, root=root)
    except UnsoundError as error:
        return error.findings, ()
    is_bundle = (path / CARD).is_file() or (path.parent / CARD).is_file()
    folder = path if path.is_dir() else path.parent
    files = file_findings(folder) if is_bundle else ()
    if fix_into is None:
        return (*check(robot, tool_required=is_bundle), *files), ()
    robot, repaired = fix(robot)
    findings = check(robot, tool_required=is_bundle)
    write_bundle(robot, bundle_folder(fix_into, robot.name), findings)
    return findings, repaired


def _print(path: Path, findings: tuple[Finding, ...], repaired: tuple[Finding, ...]) -> None:
    for finding in repaired:
        print(one_line(f"{path}: repaired {finding.code} at {finding.where}: {finding.repair}"))
    counts = {
        severity: sum(finding.severity == severity for finding in findings)
        for severity in ("error", "warning", "info")
    }
    print(one_line(f"{path}: " + ", ".join(f"{n} {what}" for what, n in counts.items())))
    for finding in findings:
        print(
            "  " + one_line(f"{finding.severity} {finding.code} at {finding.where}: {finding.why}")
        )
        hint = " (check --fix does it)" if finding.fixable else ""
        print("    " + one_line(f"fix: {finding.fix}{hint}"))
