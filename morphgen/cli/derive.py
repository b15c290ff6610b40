"""``morphgen derive`` and ``morphgen mutate``: a robot's derivation, and its neighbours."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli.options import Subparsers, add_json, add_library, library_of, whole_number

if TYPE_CHECKING:
    from morphgen.grammar.derivation import Derivation


def add_parser(commands: Subparsers) -> None:
    """Declare both commands."""
    parser = commands.add_parser(
        "derive",
        help="print, replay or compare the derivation of a robot",
        description="Print the derivation of a robot. --replay rebuilds its URDF and exits with 1 "
        "unless every byte is the same; --diff compares it with another's.",
    )
    parser.add_argument("robot", type=Path, help="a bundle's folder, light or whole")
    parser.add_argument("--replay", action="store_true", help="rebuild the URDF and compare it")
    parser.add_argument("--diff", metavar="OTHER", type=Path, help="another robot's folder")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)

    parser = commands.add_parser(
        "mutate",
        help="draw neighbours of a robot: one choice of its grammar made anew",
        description="Draw neighbours of a sampled robot: one production or parameter changed.",
    )
    parser.add_argument(
        "robot", type=Path, help="a robot's folder in a set made by morphgen sample"
    )
    parser.add_argument("-n", type=whole_number(1), default=10, help="how many (default: 10)")
    parser.add_argument("--seed", type=whole_number(0), default=0)
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: <set>-mutants")
    parser.add_argument("--no-picture", action="store_true", help="do not draw preview.png")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run_mutate)


def run(args: argparse.Namespace) -> int:
    """Print, replay or compare."""
    from morphgen.grammar.derivation import difference, outline

    derivation = _derivation(args.robot)
    if args.diff is not None:
        lines = difference(derivation, _derivation(args.diff))
        print(json.dumps(lines) if args.json else "\n".join(lines) or "the same")
        return int(bool(lines))
    if args.replay:
        return _replay(args, derivation)
    print(json.dumps(str(derivation)) if args.json else outline(derivation))
    return 0


def run_mutate(args: argparse.Namespace) -> int:
    """Write neighbours as bundles."""
    from tqdm import tqdm

    from morphgen.errors import FormatError
    from morphgen.formats.bundle import write_bundle
    from morphgen.formats.data_files import read_text
    from morphgen.grammar.derivation import difference
    from morphgen.grammar.grammar_file import grammar_from_text
    from morphgen.grammar.limits import MAX_TEXT
    from morphgen.grammar.robot_set import GRAMMAR, read_index, read_settings
    from morphgen.grammar.sampling import mutate

    folder = args.robot.resolve().parent
    if not (folder / GRAMMAR).is_file():
        raise FormatError(f"{args.robot} is in no set made by morphgen sample (no {GRAMMAR})")
    records = {record["name"]: record for record in read_index(folder)}
    if args.robot.name not in records:
        raise FormatError(f"{args.robot.name!r} is not in the index of {folder}")
    name = read_settings(folder)["grammar"]
    grammar = grammar_from_text(read_text(folder / GRAMMAR, MAX_TEXT), name)
    choices = records[args.robot.name]["choices"]
    origin = _derivation(args.robot)
    out = args.out or folder.parent / f"{folder.name}-mutants"
    neighbours = mutate(
        grammar, library_of(args), choices, args.n, seed=args.seed, name=args.robot.name
    )
    report = []
    for found in tqdm(
        neighbours, total=args.n, unit="robot", file=sys.stderr, disable=args.json or None
    ):
        where = write_bundle(
            found.robot, out / found.robot.name, found.findings, picture=not args.no_picture
        )
        report.append((str(where), difference(origin, found.derivation)))
    if args.json:
        print(json.dumps(dict(report)))
        return 0
    for text, lines in report:
        print(f"{text}: {'; '.join(lines)}")
    return 0


def _replay(args: argparse.Namespace, derivation: Derivation) -> int:
    import tempfile

    from morphgen.errors import FormatError
    from morphgen.fitting.replace_collision import as_primitives
    from morphgen.formats.bundle import CARD, URDF, write_bundle
    from morphgen.grammar.compose import compose
    from morphgen.grammar.robot_set import light_urdf

    library = library_of(args)
    robot = compose(derivation, library, args.robot.resolve().name)
    primitives = _card(args.robot).get("primitives")
    if primitives is not None:
        if "links" in primitives:
            raise FormatError(
                f"{args.robot} carries primitives of morphgen fit, of which its derivation knows "
                "nothing: replay the robot that was fitted"
            )
        robot = as_primitives(robot, library.folders)
    if (args.robot / CARD).is_file():
        with tempfile.TemporaryDirectory() as scratch:
            folder = write_bundle(robot, Path(scratch) / robot.name, picture=False)
            text = (folder / URDF).read_text(encoding="utf-8")
    else:
        text = light_urdf(robot)
    same = text == (args.robot / URDF).read_text(encoding="utf-8")
    if args.json:
        print(json.dumps({"same": same}))
    else:
        print(f"{args.robot / URDF}: {'the same bytes' if same else 'other bytes'}")
    return int(not same)


def _derivation(folder: Path) -> Derivation:
    from morphgen.errors import FormatError
    from morphgen.formats.bundle import CARD
    from morphgen.formats.data_files import read_text
    from morphgen.grammar.derivation import parse_derivation
    from morphgen.grammar.limits import MAX_DERIVATION_TEXT
    from morphgen.grammar.robot_set import DERIVATION

    light, card = folder / DERIVATION, folder / CARD
    if light.is_file():
        return parse_derivation(read_text(light, MAX_DERIVATION_TEXT), str(light))
    if not card.is_file():
        raise FormatError(f"{folder} is no robot: it has neither {CARD} nor {DERIVATION}")
    content = _card(folder)
    if not isinstance(content.get("derivation"), str):
        raise FormatError(f"{card} has no derivation: the robot was imported, not composed")
    return parse_derivation(content["derivation"], str(card))


def _card(folder: Path) -> dict[str, Any]:
    """A bundle's card; empty for a robot of a light set."""
    from morphgen.errors import FormatError
    from morphgen.formats.bundle import CARD
    from morphgen.formats.data_files import read_json

    card = folder / CARD
    if not card.is_file():
        return {}
    content = read_json(card)
    if not isinstance(content, dict):
        raise FormatError(f"{card}: expected an object, not {type(content).__name__}")
    return content
