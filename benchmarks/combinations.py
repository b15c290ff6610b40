"""Compose, check and load every arm of the paper with every end-effector.

    python benchmarks/combinations.py [--arms ur5,panda] [--ees plane] [--samples 100] [--out DIR]

Prints one row per combination: the findings, the number of ignored self-collision pairs, and for
each loader the largest error of the tool position. The exit code is 1 if a loader disagrees or a
check finds an error. Warnings are listed and written on the robot's card.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.formats.bundle import write_bundle
from morphgen.grammar.compose import compose
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.request import default_name, parse_request

PAPER_ARMS = ("ur5", "panda", "kinova_gen3", "jaco2", "xarm7", "lwr", "yumi_right", "widowx")


def main() -> int:
    """Run all combinations."""
    library = default_library()
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--arms", type=_names, default=list(PAPER_ARMS))
    parser.add_argument("--ees", type=_names, default=library.names("ee"))
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--out", type=Path, help="keep the bundles here")
    args = parser.parse_args()
    rows: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory() as scratch:
        pairs = [(arm, ee) for arm in args.arms for ee in args.ees]
        for arm, ee in tqdm(pairs, unit="robot", file=sys.stderr):
            rows.append(_row(arm, ee, library, args.out or Path(scratch), args.samples))
    print(tabulate(rows, headers="keys"))
    failed = [row for row in rows if row["passed"] != "yes"]
    print(f"{len(rows)} combinations, {len(rows) - len(failed)} passed, {len(failed)} failed")
    return int(bool(failed))


def _row(arm: str, ee: str, library: Library, out: Path, samples: int) -> dict[str, object]:
    start = time.perf_counter()
    derivation = parse_request([f"arm={arm}", f"ee={ee}"], library)
    robot = compose(derivation, library, default_name(derivation, library))
    findings = check(robot)
    folder = write_bundle(robot, out / robot.name, findings, picture=False)
    report = conformance(folder, samples, 0)
    severe = [finding for finding in findings if finding.severity != "info"]
    errors = [finding for finding in severe if finding.severity == "error"]
    return {
        "robot": robot.name,
        "links": len(robot.links),
        "dof": robot.dof,
        "kg": f"{robot.mass:.3g}",
        "findings": ",".join(sorted({finding.code for finding in severe})) or "none",
        "ignored": len(robot.ignore_pairs),
        **{row.loader: _micrometres(row.position_error) for row in report.rows},
        "s": f"{time.perf_counter() - start:.1f}",
        "passed": "yes" if report.passed and not errors else "NO",
    }


def _micrometres(error: float | None) -> str:
    return "-" if error is None else f"{error * 1e6:.2g} um"


def _names(text: str) -> list[str]:
    return text.split(",")


if __name__ == "__main__":
    sys.exit(main())
