"""Write a robot's bundle and say what it is and where."""

from __future__ import annotations

import argparse
import json

from morphgen.checks import check
from morphgen.formats.bundle import CARD, bundle_folder, write_bundle
from morphgen.formats.data_files import read_json
from morphgen.model.robot import Robot


def write_and_report(robot: Robot, args: argparse.Namespace) -> int:
    """Write ``args.out / robot.name`` and print a summary.

    Returns:
        1 if the checks find an error in the robot, as ``morphgen check`` does, else 0.
    """
    folder = bundle_folder(args.out, robot.name)
    findings = check(robot)
    code = int(any(finding.severity == "error" for finding in findings))
    write_bundle(robot, folder, findings, picture=not args.no_picture)
    if args.json:
        card = read_json(folder / CARD)
        print(json.dumps({"folder": str(folder), "card": card}))
        return code
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
    return code
