"""``morphgen check``: findings about robots."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    Subparsers,
    add_json,
    add_library,
    add_robots,
    add_root,
    library_of,
    sources_named,
)
from morphgen.errors import one_line

if TYPE_CHECKING:
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.findings import Finding


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "check",
        help="say what is wrong with robots, and how to mend it",
        description="Say what is wrong with robots. Exit code 1 if there is an error "
        "(with --strict: or a warning).",
    )
    add_robots(parser)
    parser.add_argument("--strict", action="store_true", help="warnings fail, too")
    parser.add_argument(
        "--fix",
        metavar="DIR",
        type=Path,
        help="write bundles with the safe repairs applied to this folder",
    )
    add_root(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Check every robot; print findings."""
    failing = ("error", "warning") if args.strict else ("error",)
    report: dict[str, dict[str, list[dict[str, object]]]] = {}
    failed = False
    library = library_of(args)
    for source in sources_named(args):
        findings, repaired = _checked(source, library, args)
        report[source.label] = {
            "findings": [finding.as_dict() for finding in findings],
            "repaired": [finding.as_dict() | {"repair": finding.repair} for finding in repaired],
        }
        failed |= any(finding.severity in failing for finding in findings)
        if not args.json:
            _print(source.label, findings, repaired)
    if args.json:
        print(json.dumps(report, indent=2))
    return int(failed)


def _checked(
    source: RobotSource, library: Library, args: argparse.Namespace
) -> tuple[tuple[Finding, ...], tuple[Finding, ...]]:
    """Return a robot's findings, and those that its repair into ``--fix`` removed."""
    from morphgen.checks import check, fix
    from morphgen.formats.bundle import CARD, bundle_folder, file_findings, write_bundle
    from morphgen.formats.urdf import UnsoundError
    from morphgen.grammar.robot_source import read_source

    try:
        robot = read_source(source, library, args.root)
    except UnsoundError as error:
        return error.findings, ()
    folder = source.path if source.path is None or source.path.is_dir() else source.path.parent
    is_bundle = folder is not None and (folder / CARD).is_file()
    files = file_findings(folder) if folder is not None and is_bundle else ()
    tool_required = is_bundle or source.path is None
    if args.fix is None:
        return (*check(robot, tool_required=tool_required), *files), ()
    robot, repaired = fix(robot)
    findings = check(robot, tool_required=tool_required)
    write_bundle(robot, bundle_folder(args.fix, robot.name), findings)
    return findings, repaired


def _print(label: str, findings: tuple[Finding, ...], repaired: tuple[Finding, ...]) -> None:
    for finding in repaired:
        print(one_line(f"{label}: repaired {finding.code} at {finding.where}: {finding.repair}"))
    counts = {
        severity: sum(finding.severity == severity for finding in findings)
        for severity in ("error", "warning", "info")
    }
    print(one_line(f"{label}: " + ", ".join(f"{n} {what}" for what, n in counts.items())))
    for finding in findings:
        print(
            "  " + one_line(f"{finding.severity} {finding.code} at {finding.where}: {finding.why}")
        )
        hint = " (check --fix does it)" if finding.fixable else ""
        print("    " + one_line(f"fix: {finding.fix}{hint}"))
