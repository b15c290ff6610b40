"""``morphgen conform``: do all loaders agree on a robot?"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from morphgen.cli.options import Subparsers, add_json


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "conform",
        help="load bundles in every simulator and compare joints, mass and tool pose",
        description="Load bundles in yourdfpy, PyBullet, MuJoCo (URDF and MJCF) and Pinocchio and "
        "compare joints, mass and tool pose. Exit code 1 if one disagrees.",
    )
    parser.add_argument("bundles", nargs="+", type=Path, help="bundles' folders")
    parser.add_argument("--samples", type=int, default=100, help="configurations (default: 100)")
    parser.add_argument("--seed", type=int, default=0)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print a row a bundle and loader."""
    from tabulate import tabulate

    from morphgen.checks.conformance import conformance
    from morphgen.errors import MorphgenError

    if not 1 <= args.samples <= 100_000:
        raise MorphgenError(f"--samples {args.samples}: expected 1 to 100000")
    if args.seed < 0:
        raise MorphgenError(f"--seed {args.seed}: expected 0 or more")
    reports = [conformance(path, args.samples, args.seed) for path in args.bundles]
    if args.json:
        print(json.dumps([asdict(report) for report in reports], indent=2, default=str))
    else:
        rows = [
            {"robot": path.name, **asdict(row)}
            for path, report in zip(args.bundles, reports, strict=True)
            for row in report.rows
        ]
        print(tabulate(rows, headers="keys", floatfmt=".2g"))
    return 0 if all(report.passed for report in reports) else 1
