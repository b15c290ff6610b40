"""``morphgen check``, ``conform`` and ``export``: findings, agreement of loaders, other formats."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from morphgen import checks
from morphgen.api.checks import bundle_of, check_source, conform_source
from morphgen.checks.conformance import ConformanceReport
from morphgen.cli import options as opt
from morphgen.cli.progress import note
from morphgen.errors import FormatError, one_line
from morphgen.formats.bundle import bundle_folder, write_bundle
from morphgen.formats.files import require_writable_folder
from morphgen.formats.urdf.read import UnsoundError
from morphgen.grammar.library import Library
from morphgen.grammar.robot_source import RobotReference, read_source
from morphgen.model.findings import Finding
from morphgen.tables import table

SEVERITIES = ("error", "warning", "info")


def check(args: argparse.Namespace) -> int:
    """Check every robot and print the findings."""
    written: dict[Path, str] = {}
    results, refused = opt.for_each_robot(
        args, "checking", lambda source, library: _findings(source, library, args, written)
    )
    data = {
        label: {
            "findings": [finding.as_dict() for finding in findings],
            "repaired": [finding.as_dict() | {"repair": finding.repair} for finding in repaired],
        }
        for label, (findings, repaired) in results.items()
    }
    opt.print_result(
        args,
        data | refused,
        lambda: "\n".join(
            [*(_text(label, *result) for label, result in results.items()), *_totals(results)]
        ),
    )
    if refused:
        return 2
    failing = SEVERITIES[:2] if args.strict else SEVERITIES[:1]
    found = (each for findings, _ in results.values() for each in findings)
    return int(any(each.severity in failing for each in found))


def _findings(
    source: RobotReference, library: Library, args: argparse.Namespace, written: dict[Path, str]
) -> tuple[Sequence[Finding], Sequence[Finding]]:
    """Return a robot's findings, and those that its repair into ``--fix`` removed."""
    if args.fix is None:
        return check_source(source, library, args.root), ()
    try:
        robot = read_source(source, library, args.root)
    except UnsoundError as error:
        return error.findings, ()
    robot, repaired = checks.fix(robot)
    # A lone URDF need not have a tool.
    is_robot = source.path is None or bundle_of(source) is not None
    findings = checks.check(robot, tool_required=is_robot)
    folder = bundle_folder(args.fix, robot.name)
    if folder in written:
        raise FormatError(
            f"{source.label}: {folder} is that of {written[folder]}, which has the same name; "
            "repair them one at a time, into folders of their own"
        )
    write_bundle(robot, folder, findings)
    written[folder] = source.label
    note(f"written: {folder}")  # stdout is for the findings, or for JSON
    return findings, repaired


def _totals(results: Mapping[str, tuple[Sequence[Finding], Sequence[Finding]]]) -> list[str]:
    if len(results) < 2:
        return []
    counts = Counter[str](
        severity for findings, _ in results.values() for severity in {f.severity for f in findings}
    )
    with_findings = ", ".join(f"{counts[each]} with {each}s" for each in SEVERITIES[:2])
    return [f"{len(results)} robots: {with_findings}"]


def _text(label: str, findings: Sequence[Finding], repaired: Sequence[Finding]) -> str:
    lines = [
        f"{label}: repaired {finding.code} at {finding.where}: {finding.repair}"
        for finding in repaired
    ]
    lines.append(f"{label}: {opt.severity_counts(findings, SEVERITIES)}")
    lines = [one_line(line) for line in lines]
    for finding in findings:
        hint = " (check --fix does it)" if finding.fixable else ""
        lines += [f"  {one_line(opt.finding_line(finding))}"]
        lines += [f"    {one_line(f'fix: {finding.fix}{hint}')}"]
    return "\n".join(lines)


def conform(args: argparse.Namespace) -> int:
    """Print a row per robot and loader, and one per simulator."""
    reports, refused = opt.for_each_robot(
        args,
        "loading",
        lambda source, library: conform_source(
            source, library, args.root, samples=args.samples, seed=args.seed
        ),
    )
    data = [asdict(report) for report in reports.values()]
    refusals = [{"robot": label, **error} for label, error in refused.items()]
    opt.print_result(args, [*data, *refusals], lambda: _conformance_text(reports))
    return 2 if refused else int(not all(report.passed for report in reports.values()))


_LOADER_COLUMNS = {
    "source": "source",
    "loader": "loader",
    "agrees": "passed",
    "joints": "joints",
    "mass": "mass",
    "m off": "position_error",
    "rad off": "rotation_error",
    "limits": "limits",
    "mimic": "mimic",
    "damping": "damping",
    "gains": "gains",
    "gravity": "gravity_error",
    "inertia": "inertia_error",
}
"""Fields of ``ConformanceRow`` by the titles of their columns."""
_SIMULATOR_COLUMNS = {
    "simulator": "simulator",
    "passed": "passed",
    "drift": "drift",
    "joint": "joint",
}
"""Fields of ``HoldRow`` by the titles of their columns."""
_MAX_CELL = 22  # number of characters of a robot's or joint's name in a table
_MAX_NOTE = 400  # number of characters of a row's message; `--json` has all


def _conformance_text(reports: Mapping[str, ConformanceReport]) -> str:
    sections = []
    for rows_of, columns in (("rows", _LOADER_COLUMNS), ("holds", _SIMULATOR_COLUMNS)):
        rows, notes = [], []
        for label, report in reports.items():
            name = Path(label).name
            for row in getattr(report, rows_of):
                cells = {title: _cell(getattr(row, each)) for title, each in columns.items()}
                rows.append({"robot": name[:_MAX_CELL]} | cells)
                if row.message:
                    where = " ".join(
                        filter(
                            None, (cells.get("source"), cells.get("loader") or cells["simulator"])
                        )
                    )
                    notes.append(f"{name}, {where}: {one_line(row.message)}"[:_MAX_NOTE])
        # In the style plain, the titles are not padded to more than 120 columns.
        lines = [list(row.values()) for row in rows]
        text = table(lines, ("robot", *columns), style="plain", last=("joint",)) if rows else ""
        sections += [text, "\n".join(notes)]
    return "\n\n".join(filter(None, sections))


def _cell(value: str | bool | float | None) -> str:
    """Return a value of a row as text; empty if there is none."""
    match value:
        case None:
            return ""
        case bool():
            return "yes" if value else "NO"
        case str():
            return value[:_MAX_CELL]
        case _:
            return f"{value:.2g}"


def export(args: argparse.Namespace) -> int:
    """Write a file or a folder for each robot."""
    from morphgen.api.export import write_export  # seconds to import

    if args.out is not None:
        require_writable_folder(args.out)
    paths: list[Path] = []

    def write(source: RobotReference, library: Library) -> None:
        robot = read_source(source, library, args.root)
        paths.append(write_export(source, robot, args.format, args.out, paths))

    _, refused = opt.for_each_robot(args, "exporting", write)
    refusals = [{"robot": label, **error} for label, error in refused.items()]
    data = [*map(str, paths), *refusals]
    opt.print_result(args, data, lambda: "\n".join(map(str, paths)))
    return 2 if refused else 0
