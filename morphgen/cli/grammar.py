"""``morphgen grammar``: check, count and enumerate grammars."""

from __future__ import annotations

import argparse
import itertools
import json
import math
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_json, add_library, library_of, whole_number

if TYPE_CHECKING:
    from morphgen.grammar.grammar_file import Grammar


def add_parser(commands: Subparsers) -> None:
    """Declare the command and its own."""
    parser = commands.add_parser("grammar", help="list, check, count, enumerate or print grammars")
    actions = parser.add_subparsers(metavar="ACTION", required=True)
    listing = actions.add_parser("list", help="name the grammars that come with morphgen")
    add_json(listing)
    listing.set_defaults(run=run_list)
    for name, run, summary in (
        ("check", run_check, "say what is wrong; exit code 1 if anything is"),
        ("count", run_count, "how many structures; which parameters are drawn"),
        ("enumerate", run_enumerate, "every structure, with typical values"),
        ("print", run_print, "the grammar with its includes as one text"),
    ):
        action = actions.add_parser(name, help=summary, description=summary)
        action.add_argument("grammar", help="a grammar's name or file")
        if name == "enumerate":
            action.add_argument(
                "--limit", type=whole_number(0), default=50, metavar="N", help="default: 50"
            )
        add_library(action)
        add_json(action)
        action.set_defaults(run=run)


def run_list(args: argparse.Namespace) -> int:
    """Print the names and what their robots are."""
    from tabulate import tabulate

    from morphgen.grammar.grammar_file import grammar_names, grammar_summary

    rows = [{"name": name, "robots": grammar_summary(name)} for name in grammar_names()]
    print(json.dumps(rows) if args.json else tabulate(rows, headers="keys"))
    return 0


def run_check(args: argparse.Namespace) -> int:
    """Print every fault."""
    from morphgen.grammar.analysis import check_grammar

    grammar = _load(args)
    found = check_grammar(grammar, library_of(args))
    if args.json:
        print(json.dumps(found))
    else:
        print("\n".join(found) or f"{grammar.name}: sound")
    return int(bool(found))


def run_count(args: argparse.Namespace) -> int:
    """Print the number of structures and what is drawn."""
    from morphgen.grammar.analysis import variables
    from morphgen.grammar.limits import COUNT_DIGITS, MAX_COUNT
    from morphgen.grammar.structures import count_structures

    grammar = _load(args)
    structures = count_structures(grammar)
    finite = structures != math.inf
    drawn = variables(grammar)
    if args.json:
        number = int(structures) if structures <= MAX_COUNT else None
        names = [
            {"where": v.location, "draw": v.text, "continuous": v.distribution.is_continuous}
            for v in drawn
        ]
        print(json.dumps({"structures": number, "finite": finite, "variables": names}))
        return 0
    text = f"{structures}" if structures <= MAX_COUNT else f"more than 10^{COUNT_DIGITS}"
    text = text if finite else "infinitely many"
    print(f"{grammar.name}: {text} structures, {len(drawn)} values drawn")
    for variable in drawn:
        kind = "continuous" if variable.distribution.is_continuous else "discrete"
        print(f"  {kind:10}  {variable.location} = {variable.text}")
    return 0


def run_enumerate(args: argparse.Namespace) -> int:
    """Print a derivation a line."""
    from morphgen.grammar.structures import enumerate_structures

    structures = enumerate_structures(_load(args), library_of(args))
    texts = map(str, itertools.islice(structures, args.limit))
    if args.json:
        print(json.dumps(list(texts)))
        return 0
    for text in texts:
        print(text)
    return 0


def run_print(args: argparse.Namespace) -> int:
    """Print the grammar."""
    from morphgen.grammar.grammar_file import grammar_text

    text = grammar_text(_load(args))
    print(json.dumps(text) if args.json else text, end="" if not args.json else "\n")
    return 0


def _load(args: argparse.Namespace) -> Grammar:
    from morphgen.grammar.grammar_file import find_grammar, load_grammar

    folders = library_of(args).folders
    return load_grammar(find_grammar(args.grammar, folders), folders)
