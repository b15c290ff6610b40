"""``morphgen conform``: do all loaders agree on a robot?"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    Subparsers,
    add_json,
    add_library,
    add_robots,
    add_root,
    library_of,
    sources_named,
    whole_number,
)

if TYPE_CHECKING:
    from morphgen.checks.conformance import ConformanceReport
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "conform",
        help="load robots in every simulator and compare joints, mass and tool pose",
        description="Load robots in yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio and "
        "compare joints, mass and tool pose. Exit code 1 if one disagrees.",
    )
    add_robots(parser)
    parser.add_argument(
        "--samples",
        type=whole_number(1, 100_000),
        default=100,
        metavar="N",
        help="configurations (default: 100)",
    )
    parser.add_argument("--seed", type=whole_number(0), default=0)
    add_root(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print a row a bundle and loader."""
    from tabulate import tabulate
    from tqdm import tqdm

    library = library_of(args)
    reports = {
        source.label: _report(source, library, args)
        for source in tqdm(
            sources_named(args), unit="robot", leave=False, disable=args.json or None
        )
    }
    if args.json:
        print(json.dumps([asdict(report) for report in reports.values()], indent=2, default=str))
    else:
        rows = [
            {"robot": Path(label).name, **asdict(row)}
            for label, report in reports.items()
            for row in report.rows
        ]
        print(tabulate(rows, headers="keys", floatfmt=".2g"))
    return 0 if all(report.passed for report in reports.values()) else 1


def _report(source: RobotSource, library: Library, args: argparse.Namespace) -> ConformanceReport:
    """Load the bundle, or one that is written for it: loaders read files."""
    from morphgen.checks import check
    from morphgen.checks.conformance import conformance
    from morphgen.formats.bundle import CARD, bundle_folder, write_bundle
    from morphgen.grammar.robot_source import read_source

    if source.path is not None and (source.path / CARD).is_file():
        return conformance(source.path, args.samples, args.seed)
    robot = read_source(source, library, args.root)
    with TemporaryDirectory() as folder:
        bundle = bundle_folder(Path(folder), robot.name)
        write_bundle(robot, bundle, check(robot), picture=False)
        return conformance(bundle, args.samples, args.seed)
