"""Time and size of large splits: generating, auditing, building and verifying them.

    python benchmarks/split_scale.py [--train 10,100,1000] [--jobs 1]

Extrapolation from stick, nlink and prims to chain. The splits are generated once, for the largest
size; a smaller split has the first train robots of the larger one. Each step calls the function
behind its command, in a temporary folder. Importing morphgen is not counted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from tabulate import tabulate
from tqdm import tqdm

from morphgen.benchmark.regimes import SplitRequest, extrapolation
from morphgen.benchmark.release import verify
from morphgen.benchmark.split_folder import build_split
from morphgen.benchmark.survey import audit
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.splits.split import Split, split_text, write_split

T = TypeVar("T")

TRAIN, TEST = ("stick", "nlink", "prims"), ("chain",)
MIB = 2**20


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--train", default="10,100,1000", help="robots to train on, ascending")
    parser.add_argument("--test", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    sizes = tuple(int(text) for text in args.train.split(","))
    # The longest chain has 25 links.
    order = SplitRequest("scaled", sizes, args.test, seed=args.seed, max_links=25)
    library = default_library()
    train, test = ([load_grammar(find_grammar(name)) for name in names] for names in (TRAIN, TEST))
    seconds, splits = _timed(lambda: extrapolation(order, train, test, library, jobs=args.jobs))
    rows, sound = [], True
    for split in tqdm(splits, unit="split", file=sys.stderr, disable=None):
        row, passed = _row(split, args)
        rows.append(row)
        sound &= passed
    print(f"{', '.join(TRAIN)} to {', '.join(TEST)}, {args.test} test robots, jobs: {args.jobs}")
    print(f"splits of {args.train} train robots made in {seconds:.1f} s")
    print(tabulate(rows, headers="keys"))
    return int(not sound)


def _row(split: Split, args: argparse.Namespace) -> tuple[dict[str, object], bool]:
    library, jobs = default_library(), args.jobs
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        path = folder / "split.yaml"
        write_split(split, path)
        auditing, done = _timed(lambda: audit(split, library, jobs=jobs))
        building, report = _timed(lambda: build_split(split, folder, library, jobs=jobs))
        again, _ = _timed(lambda: build_split(split, folder, library, jobs=jobs))
        by_file, of_file = _timed(lambda: verify(path, library, jobs=jobs))
        by_folder, of_folder = _timed(lambda: verify(report.folder, library, jobs=jobs))
        files = [each for each in report.folder.rglob("*") if each.is_file()]
        size = sum(each.stat().st_size for each in files)
    whole = not (of_file.differences or of_folder.differences)
    row = {
        "train": len(split.train),
        "file (KiB)": f"{len(split_text(split).encode()) / 1024:.0f}",
        "audit (s)": f"{auditing:.1f}",
        "passed": "yes" if done.passed() else "NO",
        "build (s)": f"{building:.1f}",
        "again (s)": f"{again:.1f}",
        "files": len(files),
        "MiB": f"{size / MIB:.1f}",
        "verify file (s)": f"{by_file:.1f}",
        "folder (s)": f"{by_folder:.1f}",
        "whole": "yes" if whole else "NO",
    }
    return row, whole and done.passed()


def _timed(work: Callable[[], T]) -> tuple[float, T]:
    """Return the duration of a call [s] and its result."""
    start = time.perf_counter()
    result = work()
    return time.perf_counter() - start, result


if __name__ == "__main__":
    sys.exit(main())
