"""``morphgen sample``: robots from a grammar."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from morphgen.cli.options import (
    Subparsers,
    add_jobs,
    add_json,
    add_library,
    library_of,
    whole_number,
)


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "sample",
        help="draw robots from a grammar",
        description="Draw robots from a grammar into a folder. Interrupted, it goes on where it "
        "was when run again; the same seed gives the same robots, with any --jobs.",
    )
    parser.add_argument("grammar", help="a grammar's name or file (see: morphgen grammar list)")
    parser.add_argument(
        "-n", type=whole_number(1), default=10, help="how many robots (default: 10)"
    )
    parser.add_argument("--seed", type=whole_number(0), default=0)
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: robots/<grammar>")
    parser.add_argument(
        "--where",
        metavar="CONDITION",
        action="append",
        default=[],
        help="keep only robots such as 'reach > 0.4 and dof >= 5'; may be repeated",
    )
    parser.add_argument("--light", action="store_true", help="URDF and derivation only")
    parser.add_argument("--no-picture", action="store_true", help="do not draw preview.png")
    add_jobs(parser)
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        nargs="?",
        const="",
        help="work on the Ray cluster at this address (without one: on a local Ray)",
    )
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make the set and report."""
    import json
    from dataclasses import asdict

    from tqdm import tqdm

    from morphgen.errors import GrammarError
    from morphgen.grammar.analysis import check_grammar
    from morphgen.grammar.conditions import require_condition
    from morphgen.grammar.grammar_file import find_grammar, grammar_text, load_grammar
    from morphgen.grammar.robot_set import SetConfig, SetWorker, make_serially, make_set
    from morphgen.grammar.syntax import parse_condition
    from morphgen.grammar.workers import make_in_processes, make_on_ray

    library = library_of(args)
    grammar = load_grammar(find_grammar(args.grammar, library.folders), library.folders)
    wrong = check_grammar(grammar, library)
    if wrong:
        raise GrammarError(wrong[0] + (f" (and {len(wrong) - 1} more)" if wrong[1:] else ""))
    for text in args.where:
        require_condition(parse_condition(text))
    folder = args.out or Path("robots") / grammar.name
    plan = SetConfig(
        folder,
        grammar.name,
        grammar_text(grammar),
        args.seed,
        tuple(args.where),
        args.light,
        not args.no_picture,
        tuple(args.library),
    )
    work: SetWorker = make_serially
    if args.ray is not None:
        work = make_on_ray(args.ray or None)
    elif args.jobs > 1:
        work = make_in_processes(args.jobs)
    with tqdm(total=args.n, unit="robot", file=sys.stderr, disable=args.json or None) as bar:

        def show(done: int) -> None:
            bar.n = min(done, args.n)
            bar.refresh() if done >= args.n else bar.update(0)

        report = make_set(plan, args.n, work, show)
    if args.json:
        print(json.dumps({"folder": str(folder), **asdict(report)}))
        return 0
    print(f"{folder}: {report.made} made, {report.kept} were there")
    for reason, times in sorted(report.rejected.items(), key=lambda entry: -entry[1]):
        print(f"  {times} draws rejected: {reason}")
    for name, earlier in report.duplicates:
        print(f"  {name} has the same body as {earlier}")
    return 0
