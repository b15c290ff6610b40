"""Robots sampled per second with one and with two processes, and the time of each step.

    python benchmarks/sample_speed.py [--grammar arm3] [--n 2000]

Samples light sets (URDF and derivation) into new temporary folders and compares them byte for byte.
Each run is a process of its own, so that its memory can be measured. With one job, time starts
after a first small set; with two jobs it includes the start of the workers. A separate run with one
process measures the share of each step.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import wraps
from multiprocessing import get_context
from pathlib import Path
from typing import ParamSpec, TypeVar

from tabulate import tabulate

from morphgen.grammar import compose, sampling
from morphgen.grammar import values as conditions
from morphgen.grammar.grammar_file import find_grammar, grammar_text, load_grammar
from morphgen.grammar.sampling import SetConfig, make_set
from morphgen.progress import show_progress

P = ParamSpec("P")
T = TypeVar("T")

STEPS = (
    (sampling, "derive", "derive"),
    (compose, "load_part", "xacro fill + parse"),
    (sampling, "join", "join"),
    (sampling, "survey_contacts", "collision survey"),
    (sampling, "check", "check"),
    (conditions, "reach", "reach"),
    (sampling, "write_light", "write"),
)
"""Module and name of each measured function, and its step. Nested steps are counted once."""


@dataclass(frozen=True)
class Run:
    """Measurements of one run."""

    seconds: float
    memory_early: float
    """Peak memory of the parent process after a tenth of the robots [MiB]."""
    memory_end: float


def main() -> int:
    """Measure the runs and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--grammar", default="arm3")
    parser.add_argument("--n", type=int, default=2000)
    args = parser.parse_args()
    grammar = load_grammar(find_grammar(args.grammar))
    text = grammar_text(grammar)
    runs = {}
    with tempfile.TemporaryDirectory() as scratch:
        plan = SetConfig(Path(scratch), grammar.name, text, 0, (), True, False, ())
        for jobs in (1, 2):
            own = replace(plan, folder=Path(scratch) / f"{jobs}")
            runs[jobs] = _apart(_measure, own, args.n, jobs)
        same = _content(Path(scratch) / "1") == _content(Path(scratch) / "2")
        shares = _apart(_shares, replace(plan, folder=Path(scratch) / "s"), max(args.n // 4, 50))
    rows = [
        (
            jobs,
            f"{run.seconds:.1f}",
            f"{args.n / run.seconds:.1f}",
            run.memory_early,
            run.memory_end,
        )
        for jobs, run in runs.items()
    ]
    print(f"{args.n} robots of {grammar.name}, light")
    print(tabulate(rows, ["jobs", "s", "robots/s", "MiB at 10%", "MiB at the end"], floatfmt=".0f"))
    print(f"speed-up with 2 jobs: {runs[1].seconds / runs[2].seconds:.2f}")
    print(f"the same bytes: {'yes' if same else 'NO'}")
    print(tabulate(shares, ["step", "ms a robot", "share"], floatfmt=".2f"))
    return int(not same)


def _apart(measure: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
    """Call a function in a fresh process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(measure, *arguments, **options).result()


def _measure(plan: SetConfig, n: int, jobs: int) -> Run:
    early = 0.0

    def watch(done: float, total: int | None) -> None:
        nonlocal early
        if not early and done >= n / 10:
            early = _peak()

    if jobs == 1:
        _warm(plan)
    start = time.perf_counter()
    with show_progress(watch):
        make_set(plan, n, jobs)
    return Run(time.perf_counter() - start, early, _peak())


def _shares(plan: SetConfig, n: int) -> list[tuple[str, float, str]]:
    """Return for each step its name, time per robot [ms] and share."""
    clock = _Clock()
    for module, name, step in STEPS:
        setattr(module, name, clock.around(getattr(module, name), step))
    _warm(plan)
    clock.spent.clear()
    start = time.perf_counter()
    make_set(plan, n)
    total = time.perf_counter() - start
    clock.spent["everything else"] = total - sum(clock.spent.values())
    return [
        (step, 1e3 * seconds / n, f"{100 * seconds / total:.0f}%")
        for step, seconds in sorted(clock.spent.items(), key=lambda entry: -entry[1])
    ]


class _Clock:
    """Time spent in each step, without the steps nested in it."""

    def __init__(self) -> None:
        self.spent: defaultdict[str, float] = defaultdict(float)
        self._inside = [0.0]

    def around(self, function: Callable[P, T], step: str) -> Callable[P, T]:
        """Return the function, wrapped so that its time is counted."""

        @wraps(function)
        def timed(*args: P.args, **options: P.kwargs) -> T:
            self._inside.append(0.0)
            start = time.perf_counter()
            try:
                return function(*args, **options)
            finally:
                whole = time.perf_counter() - start
                self.spent[step] += whole - self._inside.pop()
                self._inside[-1] += whole

        return timed


def _warm(plan: SetConfig) -> None:
    make_set(replace(plan, folder=plan.folder.with_name(f"{plan.folder.name}w")), 3)


def _content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def _peak() -> float:
    """Return the peak memory of this process so far [MiB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)


if __name__ == "__main__":
    sys.exit(main())
