"""``morphgen check`` and ``morphgen conform``: findings about robots, and agreement of loaders."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option
from morphgen.cli.progress import note
from morphgen.errors import FormatError, one_line

if TYPE_CHECKING:
    from morphgen.checks.conformance import ConformanceReport
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.findings import Finding

SEVERITIES = ("error", "warning", "info")


@command(
    "check",
    "find faults of robots and say how to repair them",
    opt.ROBOTS,
    flag("--strict", "fail on warnings, too"),
    option("--fix DIR", "make the safe repairs and write bundles to DIR", Path),
    *opt.ROOT_LIBRARY_JSON,
    details="The exit code is 1 if there is an error, or a warning with --strict; and 2 if a robot "
    "cannot be read, which does not stop the others.",
    examples=("check my_arm.urdf", "check robots/ --strict", "check my_arm.urdf --fix repaired"),
)
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
        lambda: "\n".join(_text(label, *result) for label, result in results.items()),
    )
    if refused:
        return 2
    failing = SEVERITIES[:2] if args.strict else SEVERITIES[:1]
    found = (each for findings, _ in results.values() for each in findings)
    return int(any(each.severity in failing for each in found))


def _findings(
    source: RobotSource, library: Library, args: argparse.Namespace, written: dict[Path, str]
) -> tuple[Sequence[Finding], Sequence[Finding]]:
    """Return a robot's findings, and those that its repair into ``--fix`` removed."""
    from morphgen.api.checks import bundle_of, check_source
    from morphgen.checks import check, fix
    from morphgen.formats.bundle import bundle_folder, write_bundle
    from morphgen.formats.urdf.read import UnsoundError
    from morphgen.grammar.robot_source import read_source

    if args.fix is None:
        return check_source(source, library, args.root), ()
    try:
        robot = read_source(source, library, args.root)
    except UnsoundError as error:
        return error.findings, ()
    robot, repaired = fix(robot)
    # A lone URDF need not have a tool.
    is_robot = source.path is None or bundle_of(source) is not None
    findings = check(robot, tool_required=is_robot)
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


def _text(label: str, findings: Sequence[Finding], repaired: Sequence[Finding]) -> str:
    lines = [
        f"{label}: repaired {finding.code} at {finding.where}: {finding.repair}"
        for finding in repaired
    ]
    counts = {name: sum(finding.severity == name for finding in findings) for name in SEVERITIES}
    lines.append(f"{label}: {', '.join(f'{n} {name}' for name, n in counts.items())}")
    lines = [one_line(line) for line in lines]
    for finding in findings:
        where = one_line(f"{finding.severity} {finding.code} at {finding.where}: {finding.why}")
        hint = " (check --fix does it)" if finding.fixable else ""
        lines += [f"  {where}", f"    {one_line(f'fix: {finding.fix}{hint}')}"]
    return "\n".join(lines)


@command(
    "conform",
    "compare robots in every loader and simulator, and measure how they hold and move",
    opt.ROBOTS,
    number("--samples", "number of random configurations", most=100_000, default=100),
    opt.SEED,
    *opt.ROOT_LIBRARY_JSON,
    details="The loaders are yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio; they are "
    "compared in joints, limits, mimic joints, damping, gains, mass, tool pose, gravity torque "
    "and inertia. A URDF, xacro or MJCF has rows for the file as it is, and for the bundle that "
    "morphgen makes of it. A robot then holds its home for 5 s and steps each joint by 0.2 rad or "
    "2 cm, with its files and in environments of MuJoCo and PyBullet. The exit code is 1 if a "
    "loader disagrees about a bundle, or about a file without a known cause, if a joint drifts "
    "more than 0.02 rad or m, or a step does not settle; and 2 if a robot cannot be read, which "
    "does not stop the others.",
    examples=("conform ur5-plane", "conform my_arm.urdf", "conform robots/ --samples 1000"),
)
def conform(args: argparse.Namespace) -> int:
    """Print a row per robot and loader, one per simulator, and the pairs that penetrate at home."""
    from morphgen.api.checks import conform_source

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
    "step off": "step_error",
    "follower off": "follower_error",
    "settles in s": "settling_time",
}
"""Fields of ``HoldRow`` by the titles of their columns."""
_MAX_CELL = 22
"""Number of characters of a robot's or joint's name in a table."""
_MAX_NOTE = 400
"""Number of characters of a row's message; ``--json`` has all."""


def _conformance_text(reports: Mapping[str, ConformanceReport]) -> str:
    """Return the tables of loaders and simulators, each followed by what went wrong."""
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
                notes += [f"    cause: {cause}"[:_MAX_NOTE] for cause in row.causes]
        sections += [_table(rows), "\n".join(notes)]
    sections.append(
        "\n".join(
            f"{Path(label).name}: at home, links {pair} penetrate by {1000 * depth:.3g} mm"
            for label, report in reports.items()
            for pair, depth in report.penetrations.items()
        )
    )
    return "\n\n".join(filter(None, sections))


def _table(rows: Sequence[Mapping[str, str]]) -> str:
    # As headers, the titles would be padded to more than 120 columns.
    lines = [list(rows[0]), *(list(row.values()) for row in rows)] if rows else []
    return opt.table(lines, tablefmt="plain", disable_numparse=True)


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
