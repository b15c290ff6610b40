"""``morphgen list``: the parts that can be composed."""

from __future__ import annotations

import argparse
import json

from morphgen.cli.options import Subparsers, add_json, add_library, library_of

_KINDS = {"bases": "base", "arms": "arm", "ees": "ee", "segments": "segment", "bodies": "body"}


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "list",
        help="list arms, end-effectors and bases",
        description="List the parts: degrees of freedom, reach (m), mass (kg), source, licence.",
    )
    parser.add_argument("kind", nargs="?", choices=list(_KINDS), help="only these")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print a row a part."""
    from tabulate import tabulate

    from morphgen.grammar.catalogue import catalogue

    rows = catalogue(library_of(args), _KINDS.get(args.kind))
    if args.json:
        print(json.dumps(rows, indent=2))
    else:
        print(tabulate(rows, headers="keys", floatfmt=".3g"))
    return 0
