"""Every URDF and xacro of the two data packages through ``morphgen import``.

    python benchmarks/import_scoreboard.py [--limit N] [--verbose]

Each file is imported in a process of its own and comes out as one of

    imported   the bundle loads in every simulator with the same joints, mass and poses
    wrong      it was imported, but a loader disagrees
    refused    exit code 2 and one line that says why
    fragment   a xacro of macros or a URDF without a root link of its own: no robot in it
    CRASHED    a traceback, or a time-out

Exit code 1 if anything crashed or is wrong.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import distribution
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

ROOTS = {
    "rtb-data": "rtbdata",
    "example-robot-data": "cmeel.prefix/share/example-robot-data/robots",
}
TIMEOUT_S = 300
_FRAGMENT = re.compile(r"<link|<xacro:(?!macro|include|property|arg)\w")


@dataclass(frozen=True)
class Outcome:
    """What became of a file."""

    file: str
    result: str
    reason: str = ""


def main() -> int:
    """Import everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit", type=int, help="only the first N files")
    parser.add_argument("--only", default="", help="only files whose path contains this")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    files = [(name, path) for name, path in _files() if args.only in str(path)][: args.limit]
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as pool:
        jobs = [
            pool.submit(_import, name, path, Path(scratch) / str(i))
            for i, (name, path) in enumerate(files)
        ]
        outcomes = [job.result() for job in tqdm(jobs, unit="file", file=sys.stderr)]
    print(tabulate([(o.result, o.file, o.reason) for o in outcomes], ["result", "file", "reason"]))
    counts = Counter(outcome.result for outcome in outcomes)
    print(", ".join(f"{n} {result}" for result, n in counts.most_common()))
    return int(counts["CRASHED"] + counts["wrong"] > 0)


def _files() -> Iterator[tuple[str, Path]]:
    for package, folder in ROOTS.items():
        root = Path(str(distribution(package).locate_file(folder)))
        for path in sorted([*root.rglob("*.urdf"), *root.rglob("*.xacro")]):
            yield path.relative_to(root).as_posix(), path


def _import(name: str, path: Path, out: Path) -> Outcome:
    done = _run(["import", str(path), "--no-picture", "--out", str(out), "--name", "robot"])
    if done is None:
        return Outcome(name, "CRASHED", f"no answer in {TIMEOUT_S} s")
    if done.returncode == 2 and "Traceback" not in done.stderr:
        reason = done.stderr.strip().splitlines()[-1].removeprefix("morphgen: ")
        is_fragment = path.suffix == ".xacro" and _is_fragment(path)
        return Outcome(name, "fragment" if is_fragment else "refused", _short(reason, path))
    if done.returncode != 0:
        return Outcome(name, "CRASHED", done.stderr.strip().splitlines()[-1])
    folder = out / "robot"
    compared = _run(["conform", str(folder), "--samples", "20", "--json"])
    if compared is None or compared.returncode not in (0, 1):
        return Outcome(name, "CRASHED", "conform: " + (compared.stderr[-160:] if compared else ""))
    (report,) = json.loads(compared.stdout)
    if not report["passed"]:
        bad = [f"{r['loader']}: {r['message']}" for r in report["rows"] if r["passed"] is False]
        return Outcome(name, "wrong", "; ".join(bad))
    card = json.loads((folder / "card.json").read_text(encoding="utf-8"))
    shutil.rmtree(folder)
    return Outcome(name, "imported", f"{card['links']} links, {card['dof']} DoF")


def _run(arguments: list[str]) -> subprocess.CompletedProcess[str] | None:
    """Run a morphgen command; None if it does not answer in time."""
    command = [sys.executable, "-m", "morphgen.cli", *arguments]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S)
    except subprocess.TimeoutExpired:
        return None


def _is_fragment(path: Path) -> bool:
    """Whether a xacro only defines macros and properties, for other files to use."""
    text = path.read_text(encoding="utf-8", errors="replace")
    outside = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    outside = re.sub(r"<(xacro:)?macro\b.*?</(xacro:)?macro>", "", outside, flags=re.DOTALL)
    return _FRAGMENT.search(outside) is None


def _short(reason: str, path: Path) -> str:
    return reason.replace(str(path), path.name)[:160]


if __name__ == "__main__":
    sys.exit(main())
