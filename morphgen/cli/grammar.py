"""``morphgen grammar``: list, check, count, enumerate and print grammars."""

from __future__ import annotations

import argparse
import itertools
import json
import math

from morphgen.cli import options as opt
from morphgen.cli.command import Command, command, number, option

GRAMMAR = option("grammar", help="name of a grammar (see: morphgen grammar list), or its file")


@command("list", "list the grammars that come with morphgen", opt.JSON)
def list_grammars(args: argparse.Namespace) -> None:
    """Print the names and summaries."""
    from tabulate import tabulate

    from morphgen.grammar.grammar_file import grammar_names, grammar_summary

    rows = [{"name": name, "robots": grammar_summary(name)} for name in grammar_names()]
    opt.print_result(args, rows, lambda: tabulate(rows, headers="keys"))


@command(
    "check",
    "check a grammar for faults",
    GRAMMAR,
    *opt.LIBRARY_JSON,
    details="The exit code is 1 if it has any.",
)
def check(args: argparse.Namespace) -> int:
    """Print every fault."""
    from morphgen.grammar.analysis import check_grammar

    library = opt.library_of(args)
    grammar = opt.load_grammar_named(args.grammar, library)
    faults = check_grammar(grammar, library)
    opt.print_result(args, faults, lambda: "\n".join(faults) or f"{grammar.name}: sound")
    return int(bool(faults))


@command(
    "count",
    "count the structures of a grammar, and list the values that are sampled",
    GRAMMAR,
    *opt.LIBRARY_JSON,
)
def count(args: argparse.Namespace) -> None:
    """Print the number of structures and the sampled values."""
    from morphgen.grammar.analysis import variables
    from morphgen.grammar.limits import COUNT_DIGITS, MAX_COUNT
    from morphgen.grammar.structures import count_structures

    grammar = opt.load_grammar_named(args.grammar, opt.library_of(args), sound=True)
    structures, sampled = count_structures(grammar), variables(grammar)
    data = {
        "structures": int(structures) if structures <= MAX_COUNT else None,
        "finite": structures != math.inf,
        "variables": [
            {"where": v.location, "draw": v.text, "continuous": v.distribution.is_continuous}
            for v in sampled
        ],
    }

    def text() -> str:
        number = f"{structures}" if structures <= MAX_COUNT else f"more than 10^{COUNT_DIGITS}"
        number = "infinitely many" if structures == math.inf else number
        lines = [f"{grammar.name}: {number} structures, {len(sampled)} values drawn"]
        for variable in sampled:
            kind = "continuous" if variable.distribution.is_continuous else "discrete"
            lines.append(f"  {kind:10}  {variable.location} = {variable.text}")
        return "\n".join(lines)

    opt.print_result(args, data, text)


@command(
    "enumerate",
    "print every structure of a grammar, with typical values",
    GRAMMAR,
    number("--limit", "largest number of structures", default=50, least=0),
    *opt.LIBRARY_JSON,
)
def enumerate_structures(args: argparse.Namespace) -> None:
    """Print a derivation per line."""
    from morphgen.grammar.structures import enumerate_structures

    library = opt.library_of(args)
    grammar = opt.load_grammar_named(args.grammar, library, sound=True)
    structures = enumerate_structures(grammar, library)
    texts = map(str, itertools.islice(structures, args.limit))
    if args.json:
        print(json.dumps(list(texts)))
        return
    for text in texts:
        print(text)


@command("print", "print a grammar and its includes as one text", GRAMMAR, *opt.LIBRARY_JSON)
def print_grammar(args: argparse.Namespace) -> None:
    """Print the text of the grammar."""
    from morphgen.grammar.grammar_file import grammar_text

    text = grammar_text(opt.load_grammar_named(args.grammar, opt.library_of(args)))
    opt.print_result(args, text, lambda: text.removesuffix("\n"))


grammar = Command(
    "grammar",
    "list, check, count, enumerate or print grammars",
    commands=(list_grammars, check, count, enumerate_structures, print_grammar),
)
