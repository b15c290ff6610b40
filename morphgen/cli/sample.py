"""``morphgen grammar`` and ``sample``: grammars and their robots."""

from __future__ import annotations

import argparse
import math
from collections import Counter
from dataclasses import asdict
from pathlib import Path

from morphgen.cli import options as opt
from morphgen.cli.progress import bar
from morphgen.grammar.analysis import check_grammar, count_structures, load_sound_grammar
from morphgen.grammar.grammar_file import (
    Grammar,
    find_grammar,
    grammar_text,
    load_grammar,
)
from morphgen.grammar.sampling import SetConfig, make_set
from morphgen.grammar.syntax import COUNT_DIGITS, MAX_COUNT
from morphgen.grammar.values import parse_conditions


def _grammar(args: argparse.Namespace) -> Grammar:
    """Return the grammar of the arguments, which may have faults."""
    folders = opt.library_of(args).folders
    return load_grammar(find_grammar(args.grammar, folders), folders)


def check(args: argparse.Namespace) -> int:
    """Print every fault."""
    library = opt.library_of(args)
    grammar = _grammar(args)
    faults = check_grammar(grammar, library)
    opt.print_result(args, faults, lambda: "\n".join(faults) or f"{grammar.name}: sound")
    return int(bool(faults))


def count(args: argparse.Namespace) -> None:
    """Print the number of structures."""
    grammar = load_sound_grammar(args.grammar, opt.library_of(args))
    structures = count_structures(grammar)
    is_exact, is_finite = structures <= MAX_COUNT, structures != math.inf
    number = f"{structures}" if is_exact else f"more than 10^{COUNT_DIGITS}"
    text = f"{grammar.name}: {number if is_finite else 'infinitely many'} structures"
    data = {"structures": int(structures) if is_exact else None, "finite": is_finite}
    opt.print_result(args, data, lambda: text)


def print_grammar(args: argparse.Namespace) -> None:
    """Print the text of the grammar."""
    text = grammar_text(_grammar(args))
    opt.print_result(args, text, lambda: text.removesuffix("\n"))


MAX_LISTED = 3  # largest number of reasons that are printed


def sample(args: argparse.Namespace) -> None:
    """Sample a set of robots and print how many were written and rejected."""
    grammar = load_sound_grammar(args.grammar, opt.library_of(args))
    parse_conditions(args.where, "--where")  # refuses invalid ones
    folder = args.out or Path("robots") / grammar.name
    config = SetConfig(
        folder,
        grammar.name,
        grammar_text(grammar),
        args.seed,
        tuple(args.where),
        args.light,
        not args.no_picture,
        tuple(args.library),
    )
    with bar(args, "sampling", total=args.n):
        report = make_set(config, args.n, args.jobs)

    def summary() -> str:
        lines = [f"{folder}: {report.made} robots written, {report.kept} already existed"]
        if report.distinct < report.made + report.kept:
            lines.append(f"  different robots: {report.distinct}")
        rejected = Counter(report.rejected)
        draws = report.made + report.kept + rejected.total()
        for reason, times in rejected.most_common(MAX_LISTED):
            lines.append(f"  {times} of {draws} draws rejected: {reason}")
        if others := sum(times for _, times in rejected.most_common()[MAX_LISTED:]):
            lines.append(f"  {others} rejected for other reasons; --json has all")
        return "\n".join(lines)

    opt.print_result(args, {"folder": str(folder), **asdict(report)}, summary)
