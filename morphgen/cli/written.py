"""Write a robot's bundle and say what it is and where."""

from __future__ import annotations

import argparse
import json
import re

from morphgen.checks import check
from morphgen.errors import FormatError
from morphgen.formats.bundle import CARD, write_bundle
from morphgen.model.robot import Robot

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")


def write_and_report(robot: Robot, args: argparse.Namespace) -> int:
    """Write ``args.out / robot.name``, print a summary and return the exit code."""
    if not _NAME.fullmatch(robot.name):
        raise FormatError(
            f"name {robot.name!r}: use letters, digits, '-', '_' and '.', a letter or digit first"
        )
    findings = check(robot)
    folder = write_bundle(robot, args.out / robot.name, findings, picture=not args.no_picture)
    if args.json:
        card = json.loads((folder / CARD).read_text(encoding="utf-8"))
        print(json.dumps({"folder": str(folder), "card": card}))
        return 0
    print(
        f"{folder}: {len(robot.links)} links, {robot.dof} DoF, {robot.mass:.3g} kg, "
        f"{len(robot.ignore_pairs)} pairs ignored for self-collision"
    )
    for repair in robot.provenance.get("repairs", ()):  # type: ignore[attr-defined]
        print(f"  repaired {repair}")
    for finding in findings:
        if finding.severity != "info":
            print(f"  {finding.severity} {finding.code} at {finding.where}: {finding.why}")
    for path in sorted(folder.iterdir()):
        print(f"  {path.name}{'/' if path.is_dir() else ''}")
    return 0
