"""Compare loaders and simulators on every arm with every end-effector, and on drawn robots.

    python benchmarks/conformance.py [--n 100] [--seed 0] [--samples 20] [--only TEXT] [--count N]
        [--doctor COMMAND] [--out results/conformance] [--report]

The robots are all arms with all end-effectors of the library (arms with two flanges get two), and
``--n`` robots of each grammar, in an order that the seed shuffles, so that any beginning of the
list is a sample of it. For each, ``morphgen conform`` compares the loaders, holds the home for 5 s
in the simulators and lists the links that penetrate at home. ``--doctor`` names the command
``mjcf-doctor`` (a pip package of others, which needs no morphgen), which then checks the MJCF.

A row per robot goes to ``rows.csv`` in ``--out``. Robots that have a row are skipped, so an
interrupted run resumes. ``--only`` keeps robots or groups whose name contains the text, ``--count``
stops after as many new robots, ``--report`` only prints the tables of the stored rows. The exit
code is 1 if a loader disagrees.
"""

from __future__ import annotations

import argparse
import csv
import json
import random
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from tabulate import tabulate
from tqdm import tqdm

from morphgen.api.checks import conform
from morphgen.checks.conformance import MAX_DRIFT
from morphgen.checks.rules import home_penetrations
from morphgen.formats.bundle import MJCF, write_bundle
from morphgen.formats.files import write_file
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import find_grammar, grammar_names, load_grammar
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.request import parse_request
from morphgen.grammar.sampling import sample_robot

ROWS = "rows.csv"
COMPOSED = "arm x end-effector"
TWO_FLANGES = ("yumi",)
"""Arms with the ports ``left`` and ``right`` instead of ``flange``."""
SIMULATORS = {"mujoco (mjcf)": "mjcf", "pybullet (urdf)": "urdf"}
"""Columns of the simulators, by the names of the rows of ``morphgen conform``."""


@dataclass(frozen=True)
class Item:
    """A robot of the list."""

    group: str
    """``COMPOSED``, or the name of a grammar."""
    name: str
    words: tuple[str, ...] = ()
    """Words of ``morphgen compose``."""
    index: int = 0
    """Number of a robot that the grammar draws."""


@dataclass(frozen=True)
class Row:
    """Result of one robot, as text or numbers of a CSV file."""

    group: str
    robot: str
    seed: int
    links: int
    dof: int
    loaders: str
    """Differences of the loaders; empty if all agree."""
    mjcf: str
    """Drift in MuJoCo with ``robot.xml`` [rad or m]; ``-`` if it was not measured. Rows of earlier
    versions have further numbers behind it."""
    urdf: str
    """The same in PyBullet with ``robot.urdf``."""
    penetrations: str
    """Pairs of links that penetrate at home, and their depth."""
    doctor: str
    """Errors and warnings of mjcf-doctor; ``-`` if it was not run."""

    def holds(self, column: str) -> bool:
        """Return whether the robot holds its home in a simulator."""
        drift, *_ = getattr(self, column).split()
        return drift != "-" and float(drift) < MAX_DRIFT  # stored drifts are rounded


def main() -> int:
    """Measure the robots that have no row, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=100, help="robots of each grammar")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=20, help="configurations for the loaders")
    parser.add_argument("--only", default="", help="robots or groups whose name contains this")
    parser.add_argument("--count", type=int, help="stop after this many new robots")
    parser.add_argument("--doctor", help="command of mjcf-doctor")
    parser.add_argument("--out", type=Path, default=Path("results/conformance"))
    parser.add_argument("--report", action="store_true", help="print the stored rows only")
    args = parser.parse_args()
    file = args.out / ROWS
    rows = _read(file)
    if not args.report:
        _drop_cut_off_row(file)
        library = default_library()
        known = {(row.robot, row.seed) for row in rows}
        todo = [
            item
            for item in _items(library, args.n, args.seed)
            if args.only in item.name or args.only in item.group
            if (item.name, args.seed) not in known
        ][: args.count]
        for item in tqdm(todo, unit="robot", file=sys.stderr, disable=None):
            rows.append(_measure(item, library, args))
            _append(file, rows[-1])
    _print(rows)
    return int(any(row.loaders for row in rows))


def _items(library: Library, n: int, seed: int) -> list[Item]:
    """Return all robots, shuffled."""
    items = []
    for arm in library.names("arm"):
        for ee in library.names("ee"):
            if ee == "none":
                continue
            two = (f"left.ee={ee}", f"right.ee={ee}")
            words = (f"arm={arm}", *(two if arm in TWO_FLANGES else (f"ee={ee}",)))
            items.append(Item(COMPOSED, f"{arm}-{ee}", words))
    for grammar in grammar_names():
        items += [Item(grammar, f"{grammar}-{i:06}", index=i) for i in range(n)]
    random.Random(seed).shuffle(items)
    return items


def _measure(item: Item, library: Library, args: argparse.Namespace) -> Row:
    if item.words:
        robot = compose(parse_request(list(item.words), library), library, item.name)
    else:
        grammar = load_grammar(find_grammar(item.group))
        robot = sample_robot(grammar, library, item.index, seed=args.seed).robot
    with tempfile.TemporaryDirectory() as scratch:
        folder = write_bundle(robot, Path(scratch) / robot.name, picture=False)
        report = conform(folder, samples=args.samples, seed=args.seed)
        doctor = _doctor(folder / MJCF, args.doctor) if args.doctor else "-"
    holds = {row.simulator: row for row in report.holds}
    return Row(
        group=item.group,
        robot=item.name,
        seed=args.seed,
        links=len(robot.links),
        dof=robot.dof,
        loaders="; ".join(f"{r.loader}: {r.message}" for r in report.rows if r.passed is False),
        **{
            column: "-" if holds[name].drift is None else f"{holds[name].drift:.2g}"
            for name, column in SIMULATORS.items()
        },
        penetrations="; ".join(
            f"{a}, {b} {1000 * depth:.2g} mm"
            for (a, b), depth in sorted(home_penetrations(robot).items())
        ),
        doctor=doctor,
    )


def _doctor(mjcf: Path, command: str) -> str:
    """Return the errors and warnings of mjcf-doctor."""
    done = subprocess.run(
        [command, "check", str(mjcf), "--json", "--quiet"], capture_output=True, text=True
    )
    start = done.stdout.find("[\n")
    if start < 0:
        sys.exit(f"{command} gives no JSON: {done.stdout}{done.stderr}")
    (result,) = json.loads(done.stdout[start:])
    severe = [found for found in result["findings"] if found["level"] in ("ERROR", "WARN")]
    return "; ".join(
        f"{found['level'].lower()} {found['code']} {found['subject']}: {found['message']}"
        for found in severe
    )


def _read(file: Path) -> list[Row]:
    """Return the stored rows; a last one that was cut off is left out."""
    if not file.exists():
        return []
    with file.open(newline="", encoding="utf-8") as stream:
        stored = list(csv.DictReader(stream))
    numbers = ("seed", "links", "dof")
    complete: list[dict[str, Any]] = [row for row in stored if None not in row.values()]
    names = [field.name for field in fields(Row)]  # rows of earlier versions have more
    return [
        Row(**({name: row[name] for name in names} | {name: int(row[name]) for name in numbers}))
        for row in complete
    ]


def _drop_cut_off_row(file: Path) -> None:
    """Remove the last row if the run that wrote it was killed within its line."""
    content = file.read_bytes() if file.exists() else b""
    if content and not content.endswith(b"\n"):
        write_file(file, content[: content.rfind(b"\n") + 1])


def _append(file: Path, row: Row) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    is_new, names = not file.exists(), [field.name for field in fields(Row)]
    if not is_new:  # an earlier version may have written the file, with more columns
        with file.open(newline="", encoding="utf-8") as stream:
            names = next(csv.reader(stream))
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, names, lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(asdict(row))


def _print(rows: list[Row]) -> None:
    groups = sorted({row.group for row in rows}, key=lambda group: (group != COMPOSED, group))
    table = [_summary(group, [row for row in rows if row.group == group]) for group in groups]
    print(tabulate([*table, _summary("all", rows)], headers="keys", disable_numparse=True))
    for text, robots in sorted(_doctor_findings(rows).items()):
        print(f"mjcf-doctor: {text}: {len(robots)}, such as {', '.join(sorted(robots)[:3])}")


def _doctor_findings(rows: list[Row]) -> dict[str, list[str]]:
    """Return the robots of each error and warning."""
    findings: dict[str, list[str]] = {}
    for row in rows:
        for text in {" ".join(part.split()[:2]) for part in row.doctor.split("; ")} - {"", "-"}:
            findings.setdefault(text, []).append(row.robot)
    return findings


def _summary(group: str, rows: list[Row]) -> dict[str, object]:
    tested = [row for row in rows if row.doctor != "-"]
    return {
        "robots": group,
        "number": len(rows),
        "loaders agree": sum(not row.loaders for row in rows),
        **{
            f"holds: {column}": sum(row.holds(column) for row in rows)
            for column in SIMULATORS.values()
        },
        "penetrate": sum(bool(row.penetrations) for row in rows),
        "doctor: clean": f"{sum(not row.doctor for row in tested)}/{len(tested)}",
    }


if __name__ == "__main__":
    sys.exit(main())
