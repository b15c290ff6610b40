"""``morphgen list`` and ``grammar list``: parts and grammars, without the packages for meshes."""

from __future__ import annotations

import argparse

from tabulate import tabulate

from morphgen.cli import options as opt
from morphgen.cli.progress import status
from morphgen.grammar.catalogue import catalogue
from morphgen.grammar.grammar_file import grammar_names, grammar_summary

PART_KINDS = {"bases": "base", "arms": "arm", "ees": "ee", "segments": "segment", "bodies": "body"}


def list_parts(args: argparse.Namespace) -> None:
    """Print a table with a row per part."""
    with status(args, "reading the parts"):
        rows = catalogue(opt.library_of(args), PART_KINDS.get(args.kind))
    opt.print_result(args, rows, lambda: tabulate(rows, headers="keys", floatfmt=".3g"))


def list_grammars(args: argparse.Namespace) -> None:
    """Print the names and summaries."""
    rows = [{"name": name, "robots": grammar_summary(name)} for name in grammar_names()]
    opt.print_result(args, rows, lambda: tabulate(rows, headers="keys"))
