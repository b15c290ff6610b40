"""Import every URDF and xacro of some packages, and compare with ROS's ``check_urdf``.

    python benchmarks/import_scoreboard.py [PACKAGE|DIR ...] [--conform] [--all]

A package is a pip name and must be installed; the default is those of ``PACKAGES``. A process of
its own imports each file with the package's folder as root. The outcomes are:

    imported   the bundle was written (with --conform: and all loaders agree)
    wrong      the file was imported, but a loader disagrees (--conform)
    refused    morphgen gives a one-line reason
    fragment   a xacro with macros only, without a robot
    CRASHED    a traceback or a time-out

``check_urdf`` (Debian package liburdfdom-tools) reads the refused URDF files; it cannot read xacro.
The script lists the files that it accepts and morphgen refuses, each with the reason; --all lists
every file that is not imported. With --conform, the loaders also read each file that is imported as
it is: a table counts in how many files they differ from morphgen. The exit code is 1 if any outcome
is CRASHED or wrong.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import re
import runpy
import shutil
import subprocess
import sys
import tempfile
import threading
import traceback
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, distribution
from multiprocessing.connection import Connection
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

from morphgen.checks.conformance import compare_file, conformance
from morphgen.errors import MorphgenError
from morphgen.formats.resolve import default_finder

PACKAGES = {
    "pybullet": "pybullet_data",
    "robosuite": "robosuite",
    "airo-models": "airo_models",
    "dexmate-urdf": "dexmate_urdf",
    "rtb-data": "rtbdata",
    "example-robot-data": "cmeel.prefix/share/example-robot-data/robots",
}
"""Folder with the robots of each package."""
TIMEOUT_S = 300
_CHECKER = shutil.which("check_urdf")
_FORK = multiprocessing.get_context("fork")
_FRAGMENT = re.compile(r"<link|<xacro:(?!macro|include|property|arg)\w")


@dataclass(frozen=True)
class Outcome:
    """Result of importing one file."""

    package: str
    file: str
    result: str
    reason: str = ""
    accepted: bool | None = None
    """Whether ``check_urdf`` accepts the file; None if it did not read it."""
    loaders: tuple[tuple[str, str], ...] = ()
    """Each loader that was given the file as it is, and its differences; empty without any."""


def main() -> int:
    """Import all files and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sources", nargs="*", metavar="PACKAGE|DIR", default=list(PACKAGES))
    parser.add_argument("--conform", action="store_true", help="load all in every loader, too")
    parser.add_argument("--all", action="store_true", help="list all that is not imported")
    parser.add_argument("--only", default="", help="only files whose path contains this")
    parser.add_argument("--jobs", type=int, default=2)
    args = parser.parse_args()
    folders = [(source, _folder(source)) for source in args.sources]
    files = [
        (package, root, path)
        for package, root in folders
        for path in _files(root)
        if args.only in str(path)
    ]
    tqdm.set_lock(threading.RLock())  # by default it is one for all processes
    with tempfile.TemporaryDirectory() as scratch, ThreadPoolExecutor(args.jobs) as pool:
        jobs = [
            pool.submit(_outcome, package, root, path, Path(scratch) / str(i), args.conform)
            for i, (package, root, path) in enumerate(files)
        ]
        outcomes = [job.result() for job in tqdm(jobs, unit="file", file=sys.stderr)]
    _print(outcomes, everything=args.all)
    return int(any(outcome.result in ("CRASHED", "wrong") for outcome in outcomes))


def _folder(source: str) -> Path:
    if Path(source).is_dir():
        return Path(source).resolve()
    try:
        return Path(str(distribution(source).locate_file(PACKAGES.get(source, "")))).resolve()
    except PackageNotFoundError:
        sys.exit(f"{source} is neither a folder nor an installed package")


def _files(root: Path) -> Iterator[Path]:
    yield from sorted([*root.rglob("*.urdf"), *root.rglob("*.xacro")])


def _outcome(package: str, root: Path, path: Path, out: Path, conform: bool) -> Outcome:
    """Import one file in a process of its own."""
    receiving, sending = _FORK.Pipe(duplex=False)
    child = _FORK.Process(target=_import, args=(sending, root, path, out, conform))
    child.start()
    sending.close()
    result, reason, loaders = "CRASHED", f"no answer in {TIMEOUT_S} s", ()
    if receiving.poll(TIMEOUT_S):
        try:
            result, reason, loaders = receiving.recv()
        except EOFError:
            reason = "the process died"
    child.kill()
    child.join()
    shutil.rmtree(out, ignore_errors=True)
    accepted = _is_accepted(path) if result == "refused" else None
    file = path.relative_to(root).as_posix()
    return Outcome(package, file, result, reason, accepted, loaders)


def _import(answer: Connection, root: Path, path: Path, out: Path, conform: bool) -> None:
    tqdm.set_lock(threading.RLock())  # the fork may have copied a lock that a thread holds
    printed, errors = io.StringIO(), io.StringIO()
    words = ["import", str(path), "--root", str(root), "--no-picture", "--out", str(out)]
    try:
        with contextlib.redirect_stdout(printed), contextlib.redirect_stderr(errors):
            code = _morphgen([*words, "--name", "robot"])
        if code == 2:
            is_fragment = path.suffix == ".xacro" and _is_fragment(path)
            reason = errors.getvalue().strip().removeprefix("morphgen: ").replace(f"{root}/", "")
            answer.send(("fragment" if is_fragment else "refused", reason, ()))
            return
        rows = conformance(out / "robot", samples=20).rows if conform else ()
        bad = [f"{row.loader}: {row.message}" for row in rows if row.passed is False]
        loaders = tuple(_as_it_is(path, root)) if conform else ()
        answer.send(("wrong" if bad else "imported", "; ".join(bad), loaders))
    except BaseException:
        answer.send(("CRASHED", traceback.format_exc().strip().splitlines()[-1], ()))


def _as_it_is(path: Path, root: Path) -> Iterator[tuple[str, str]]:
    """Yield the loaders of a file and their differences; see ``Outcome.loaders``."""
    try:
        rows = compare_file(path, default_finder(root=root), samples=20)
    except MorphgenError as error:  # it can be imported, but no loader may get it
        yield "all", f"no copy for loaders: {error}".replace(f"{root}/", "")
        return
    for row in rows:
        if row.passed is not None:
            yield row.loader, row.message


def _morphgen(words: list[str]) -> int:
    """Run a command as ``python -m morphgen`` does; return its exit code."""
    sys.argv[1:] = words
    try:
        runpy.run_module("morphgen", run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def _is_accepted(path: Path) -> bool | None:
    if _CHECKER is None or path.suffix == ".xacro":
        return None
    done = subprocess.run([_CHECKER, str(path)], capture_output=True, text=True, errors="replace")
    return done.returncode == 0 and "Successfully" in done.stdout


def _is_fragment(path: Path) -> bool:
    """Return whether a xacro only defines macros and properties for other files."""
    text = path.read_text(encoding="utf-8", errors="replace")
    outside = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    outside = re.sub(r"<(xacro:)?macro\b.*?</(xacro:)?macro>", "", outside, flags=re.DOTALL)
    return _FRAGMENT.search(outside) is None


def _print(outcomes: list[Outcome], *, everything: bool) -> None:
    results = ("imported", "wrong", "refused", "fragment", "CRASHED")
    rows = []
    for package in dict.fromkeys(outcome.package for outcome in outcomes):
        own = [outcome for outcome in outcomes if outcome.package == package]
        counts = Counter(outcome.result for outcome in own)
        accepted = sum(outcome.accepted is True for outcome in own)
        rows.append([package, len(own), *(counts[result] for result in results), accepted])
    heads = ["package", "files", *results, "refused, but accepted by check_urdf"]
    print(tabulate(rows, heads))
    if any(outcome.loaders for outcome in outcomes):
        _print_loaders(outcomes)
    if _CHECKER is None:
        print("check_urdf is not installed (Debian: liburdfdom-tools)")
    for outcome in outcomes:
        bad = outcome.result in ("CRASHED", "wrong") or outcome.accepted
        if bad or (everything and outcome.result == "refused"):
            verdict = {True: "accepts", False: "refuses", None: "not asked"}[outcome.accepted]
            print(f"{outcome.package}: {outcome.file}: {outcome.result} (check_urdf: {verdict})")
            print(f"    {outcome.reason[:300]}")


def _print_loaders(outcomes: list[Outcome]) -> None:
    """Print in how many files as they are each loader agrees and differs."""
    read = [answer for outcome in outcomes for answer in outcome.loaders]
    rows = []
    for loader in sorted({loader for loader, _ in read}):
        own = [difference for name, difference in read if name == loader]
        rows.append([loader, len(own), own.count(""), len(own) - own.count("")])
    print(tabulate(rows, ["loader", "files as they are", "agrees", "differs"]))


if __name__ == "__main__":
    sys.exit(main())
