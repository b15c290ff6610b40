"""Options that several commands share, and functions that evaluate them."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from inspect import signature
from typing import TYPE_CHECKING, Any, TypeVar

from morphgen.cli.progress import note, status, track
from morphgen.errors import (
    BenchmarkError,
    CompositionError,
    FormatError,
    MorphgenError,
    one_line,
)
from morphgen.grammar.library import Library, default_library
from morphgen.model.findings import Finding
from morphgen.tables import fitted

if TYPE_CHECKING:  # they load numpy and packages for meshes, which lists do not need
    from morphgen.grammar.robot_source import RobotReference
    from morphgen.model.robot import Robot

T = TypeVar("T")


def arguments(args: argparse.Namespace, function: Callable[..., object]) -> dict[str, Any]:
    """Return the arguments of a function that options of their names give."""
    return {name: getattr(args, name) for name in signature(function).parameters if name in args}


def print_result(args: argparse.Namespace, data: object, text: Callable[[], str]) -> None:
    """Print data as JSON if ``--json`` is given, else text unless it is empty."""
    with fit_terminal(args):
        shown = json.dumps(data, default=str) if args.json else text()
    if shown:
        print(shown)


def fit_terminal(args: argparse.Namespace) -> AbstractContextManager[None]:
    """Fit the tables of a block to the terminal; all columns are for files, pipes and --wide."""
    is_whole = getattr(args, "wide", False) or not sys.stdout.isatty()
    return fitted(None if is_whole else shutil.get_terminal_size().columns)


def finding_line(finding: Finding) -> str:
    """Return a finding as one line, without its repair."""
    return f"{finding.severity} {finding.code} at {finding.where}: {finding.why}"


def severity_counts(findings: Iterable[Finding], severities: Sequence[str]) -> str:
    """Return the number of findings of each severity, such as ``0 error, 2 warning``."""
    counts = Counter[str](finding.severity for finding in findings)
    return ", ".join(f"{counts[severity]} {severity}" for severity in severities)


def given(args: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return the values of options by name, without those that are empty or off."""
    values = {name: getattr(args, name, None) for name in names}
    empty: tuple[object, ...] = (None, (), [], "")
    # 0 equals False, and is a value.
    return {name: x for name, x in values.items() if x not in empty and x is not False}


def library_of(args: argparse.Namespace) -> Library:
    """Return the library with the folders of ``--library``."""
    return default_library(args.library)


def sources_of(
    args: argparse.Namespace, refuse: Callable[[str, FormatError], object] | None = None
) -> list[RobotReference]:
    """Return the sources of the robots that the arguments name, one or several."""
    from morphgen.grammar.robot_source import find_robots

    sources = find_robots(args.words, library_of(args), refuse)
    if args.root is not None and (composed := [s for s in sources if s.path is None]):
        raise FormatError(
            f"--root {args.root}: {composed[0].label} is composed; expected a bundle, a URDF, a "
            "xacro or an MJCF"
        )
    return sources


def read_robots(args: argparse.Namespace) -> list[tuple[RobotReference, Robot]]:
    """Return the robots that the arguments name, one or several, with their sources."""
    from morphgen.grammar.robot_source import read_source

    library, sources = library_of(args), sources_of(args)
    return [
        (source, read_source(source, library, args.root))
        for source in track(sources, args, "reading", "robot", len(sources))
    ]


def read_one_robot(args: argparse.Namespace) -> tuple[RobotReference, Robot]:
    """Return the robot that the arguments name, which must be one, with its source."""
    from morphgen.grammar.robot_source import read_source

    source, *others = sources_of(args)
    if others:
        raise CompositionError(
            f"{' '.join(args.words)}: {len(others) + 1} robots; name one, such as {source.label}"
        )
    with status(args, f"reading {source.label}"):
        return source, read_source(source, library_of(args), args.root)


def for_each_robot(
    args: argparse.Namespace, verb: str, work: Callable[[RobotReference, Library], T]
) -> tuple[dict[str, T], dict[str, dict[str, str]]]:
    """Do something with every robot that the arguments name; a refused one does not stop others.

    Return results, and classes and messages of printed errors, for which the exit code is 2, by the
    label of the source.
    """
    results: dict[str, T] = {}
    refused: dict[str, dict[str, str]] = {}

    def refuse(word: str, error: FormatError) -> None:
        if len(args.words) == 1:
            raise error
        refused[word] = refusal(error, word, word)

    library, sources = library_of(args), sources_of(args, refuse)
    for source in track(sources, args, verb, "robot", len(sources)):
        try:
            results[source.label] = work(source, library)
        except MorphgenError as error:
            if len(sources) == 1 and not refused:
                raise
            refused[source.label] = refusal(error, source.label, source.label)
    return results, refused


def refusal(error: MorphgenError, label: str, name: str) -> dict[str, str]:
    """Print why one of several robots is refused; return it for ``--json``."""
    reason = one_line(str(error))
    if name not in reason:
        reason = f"{label}: {reason}"
    note(f"morphgen: {reason}")
    return {"error": type(error).__name__, "message": reason}


def require_other_name(words: dict[str, str], split: str, word: str) -> None:
    """Require that no other argument names a split of this name; keep the argument."""
    if split in words:
        raise BenchmarkError(
            f"{word}: split {split!r} is also in {words[split]}; expected splits of different names"
        )
    words[split] = word
