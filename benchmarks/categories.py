"""Sample robots of every morphology category, count their links, check and load them.

    python benchmarks/categories.py [--n 100] [--seed 0] [--only chain,arm3] [--samples 20]

Prints one row per category: links and movable joints next to the paper's numbers, rejected draws,
whether `morphgen check --strict` passes for all bundles, the largest difference of the tool
position between any two loaders, and robots sampled per second by one process (without writing and
loading). The exit code is 1 if a category differs from the paper, a check fails or loaders
disagree.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tabulate import tabulate
from tqdm import tqdm

from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.grammar_file import find_grammar, grammar_names, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robot
from morphgen.grammar.syntax import Derivation

Counts = tuple[Iterable[int], Iterable[int]]
"""Allowed numbers of links and of movable joints."""


@dataclass(frozen=True)
class Spec:
    """The paper's numbers of links and movable joints of one category."""

    text: str
    """Text of the table: links / movable joints."""
    counts: Callable[[Derivation], Counts]


def _same(links: int, movable: int) -> Spec:
    return Spec(f"{links} / {movable}", lambda derivation: ([links], [movable]))


def _within(links: tuple[int, int], movable: tuple[int, int]) -> Spec:
    counts = (range(links[0], links[1] + 1), range(movable[0], movable[1] + 1))
    text = f"{links[0]}-{links[1]} / {movable[0]}-{movable[1]}"
    return Spec(text, lambda derivation: counts)


def _by_number(text: str, part: str, links: tuple[int, int], movable: tuple[int, int]) -> Spec:
    """Return a spec whose counts are linear in the number n of a part: (a, b) means a n + b."""

    def counts(derivation: Derivation) -> Counts:
        n = sum(node.part == part for node in derivation.walk())
        return [links[0] * n + links[1]], [movable[0] * n + movable[1]]

    return Spec(text, counts)


SPEC = {
    "arm3": _same(10, 9),
    "arm5": _same(23, 8),
    "stick": _same(5, 3),
    "nlink": _by_number("n+2 / n", "beam", (1, 2), (1, 0)),
    "prims": _same(7, 5),
    "chain": _by_number("3n+4 / 2n+3", "bead", (3, 4), (2, 3)),
    "panda_variations": _same(11, 9),
    "cubes": _same(3, 2),
    "planar_arm": _within((6, 10), (4, 9)),
    "arm_ed": _same(19, 8),
    "multi_finger": _within((8, 19), (5, 18)),
    "tongs": _within((10, 12), (7, 9)),
    "cartpole": _same(3, 2),
}


def main() -> int:
    """Sample and check all categories, and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--n", type=int, default=100, help="robots of each category")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=lambda text: text.split(","), default=list(SPEC))
    parser.add_argument("--samples", type=int, default=20, help="configurations for the loaders")
    args = parser.parse_args()
    missing = set(SPEC) ^ (set(grammar_names()) - {"serial"})  # which the paper does not have
    rows = []
    with (
        tempfile.TemporaryDirectory() as scratch,
        tqdm(total=args.n * len(args.only), unit="robot", file=sys.stderr, disable=None) as bar,
    ):
        for category in args.only:
            rows.append(_row(category, args, Path(scratch), bar.update))
    print(tabulate(rows, headers="keys"))
    failed = [row["category"] for row in rows if "NO" in row.values()]
    print(f"{len(rows)} categories of {args.n} robots, {len(failed)} failed")
    if missing:
        print(f"categories and grammars do not match: {', '.join(sorted(missing))}")
    return int(bool(failed or missing))


def _row(
    category: str, args: argparse.Namespace, out: Path, done: Callable[[], object]
) -> dict[str, object]:
    library = default_library()
    grammar = load_grammar(find_grammar(category))
    links, movable = Counter[int](), Counter[int]()
    rejected: Counter[str] = Counter()
    as_specified = clean = conforms = True
    error = seconds = 0.0
    sample_robot(grammar, library, 0, seed=args.seed)
    for index in range(args.n):
        start = time.perf_counter()
        drawn = sample_robot(grammar, library, index, seed=args.seed)
        seconds += time.perf_counter() - start
        robot = drawn.robot
        links[len(robot.links)] += 1
        movable[len(robot.movable_joints)] += 1
        rejected.update(drawn.rejected)
        wanted = SPEC[category].counts(drawn.derivation)
        as_specified &= len(robot.links) in wanted[0] and len(robot.movable_joints) in wanted[1]
        folder = write_bundle(robot, out / category, drawn.findings, picture=False)
        clean &= all(finding.severity == "info" for finding in check(read_bundle(folder)))
        report = conformance(folder, args.samples, 0)
        conforms &= report.passed
        error = max(error, *(row.position_error or 0.0 for row in report.rows))
        done()
    return {
        "category": category,
        "links": _range(links),
        "movable": _range(movable),
        "spec": SPEC[category].text,
        "as spec": "yes" if as_specified else "NO",
        "rejected draws": sum(rejected.values()),
        "check clean": "yes" if clean else "NO",
        "loaders agree": "yes" if conforms else "NO",
        "max error": f"{error * 1e6:.2g} um",
        "robots/s": f"{args.n / seconds:.0f}",
    }


def _range(counts: Counter[int]) -> str:
    low, high = min(counts), max(counts)
    return f"{low}" if low == high else f"{low}-{high}"


if __name__ == "__main__":
    sys.exit(main())
