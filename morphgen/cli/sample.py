"""``morphgen grammar``, ``sample``, ``derive`` and ``mutate``: grammars and their robots."""

from __future__ import annotations

import argparse
import itertools
import json
import math
import tempfile
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

from morphgen.cli import options as opt
from morphgen.cli.progress import bar, status, track
from morphgen.errors import FormatError
from morphgen.fitting.replace_collision import as_spheres, with_geometry
from morphgen.formats.bundle import CARD, URDF, read_card, write_bundle
from morphgen.formats.data_files import read_text
from morphgen.grammar import analysis
from morphgen.grammar.analysis import check_grammar, count_structures, load_sound_grammar, variables
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, difference, outline, parse_derivation
from morphgen.grammar.grammar_file import (
    Grammar,
    find_grammar,
    grammar_from_text,
    grammar_text,
    load_grammar,
)
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words
from morphgen.grammar.robot_set import (
    DERIVATION,
    GRAMMAR,
    SetConfig,
    light_urdf,
    make_in_processes,
    make_on_ray,
    make_set,
    read_index,
    read_settings,
)
from morphgen.grammar.robot_source import find_robots, is_robot_folder, light_derivation
from morphgen.grammar.sampling import mutate as mutations
from morphgen.grammar.syntax import COUNT_DIGITS, MAX_COUNT, MAX_TEXT
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
    """Print the number of structures and the sampled values."""
    grammar = load_sound_grammar(args.grammar, opt.library_of(args))
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


def enumerate_structures(args: argparse.Namespace) -> None:
    """Print a derivation per line."""
    library = opt.library_of(args)
    grammar = load_sound_grammar(args.grammar, library)
    structures = analysis.enumerate_structures(grammar, library)
    texts = map(str, itertools.islice(structures, args.limit))
    if args.json:
        print(json.dumps(list(texts)))
        return
    for text in texts:
        print(text)


def print_grammar(args: argparse.Namespace) -> None:
    """Print the text of the grammar."""
    text = grammar_text(_grammar(args))
    opt.print_result(args, text, lambda: text.removesuffix("\n"))


MAX_LISTED = 3
"""Largest number of reasons, and of robots with the body of another one, that are printed."""


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
    work = make_in_processes(args.jobs) if args.ray is None else make_on_ray(args.ray or None)
    with bar(args, "sampling", total=args.n):
        report = make_set(config, args.n, work)

    def summary() -> str:
        lines = [f"{folder}: {report.made} robots written, {report.kept} already existed"]
        rejected = Counter(report.rejected)
        draws = report.made + report.kept + rejected.total()
        for reason, times in rejected.most_common(MAX_LISTED):
            lines.append(f"  {times} of {draws} draws rejected: {reason}")
        if others := sum(times for _, times in rejected.most_common()[MAX_LISTED:]):
            lines.append(f"  {others} rejected for other reasons; --json has all")
        if twins := [f"{name} as {same}" for name, same in report.duplicates]:
            number = f"{len(twins)} robot{' has' if len(twins) == 1 else 's have'}"
            more = ", ..." if len(twins) > MAX_LISTED else ""
            listed = ", ".join(twins[:MAX_LISTED])
            lines.append(f"  {number} the same body as an earlier one: {listed}{more}")
        return "\n".join(lines)

    opt.print_result(args, {"folder": str(folder), **asdict(report)}, summary)


def derive(args: argparse.Namespace) -> int:
    """Print or replay a derivation."""
    library = opt.library_of(args)
    source, *others = find_robots(args.words, library)
    if others:
        raise FormatError(f"{source.label} and {others[0].label}: expected one robot")
    if source.path is None:
        derivation, _ = parse_words(source.words, library)
    else:
        derivation = _stored_derivation(source.path)
    if not args.replay:
        opt.print_result(args, str(derivation), lambda: outline(derivation))
        return 0
    if source.path is None:
        raise FormatError(f"--replay: {source.label} has no URDF yet; expected a robot's folder")
    path = source.path / URDF
    with status(args, "composing"):
        text = _replayed_urdf(source.path, derivation, library)
    same = text == path.read_text(encoding="utf-8")
    opt.print_result(
        args, {"same": same}, lambda: f"{path}: {'the same bytes' if same else 'other bytes'}"
    )
    return int(not same)


def mutate(args: argparse.Namespace) -> None:
    """Write neighbours as bundles and print what differs."""
    name, folder = args.robot.name, args.robot.resolve().parent
    if not (folder / GRAMMAR).is_file():
        _require_folder(args.robot)
        raise FormatError(
            f"{args.robot} is not in a set made by morphgen sample (no {folder / GRAMMAR})"
        )
    records = {record["name"]: record for record in read_index(folder)}
    if name not in records:
        raise FormatError(f"{name!r} is not in the index of {folder}")
    settings = read_settings(folder)
    grammar = grammar_from_text(read_text(folder / GRAMMAR, MAX_TEXT), settings["grammar"])
    origin = _stored_derivation(args.robot)
    out = args.out or folder.parent / f"{folder.name}-mutants-{args.seed}"
    neighbours = mutations(
        grammar,
        opt.library_of(args),
        records[name]["choices"],
        args.n,
        seed=args.seed,
        name=name,
        where=parse_conditions(settings["where"], "--where"),
    )
    changes: dict[str, Any] = {}
    for neighbour in track(neighbours, args, "sampling", "robot", args.n):
        robot = neighbour.robot
        path = write_bundle(
            robot, out / robot.name, neighbour.findings, picture=not args.no_picture
        )
        changes[str(path)] = difference(origin, neighbour.derivation)
    opt.print_result(
        args,
        changes,
        lambda: "\n".join(f"{path}: {'; '.join(lines)}" for path, lines in changes.items()),
    )


def _replayed_urdf(folder: Path, derivation: Derivation, library: Library) -> str:
    """Return the URDF that a derivation gives, as in a bundle or in a light set."""
    robot = compose(derivation, library, folder.resolve().name)
    if not (folder / CARD).is_file():  # a light set has no meshes and no card
        return light_urdf(robot)
    card = read_card(folder)
    if "convex" in card:
        robot = with_geometry(robot, "convex", library.folders)
    primitives = card.get("primitives")
    if primitives is not None:
        if "links" in primitives:
            raise FormatError(
                f"{folder} has primitives of morphgen fit, which its derivation does not include: "
                "replay the robot that was fitted"
            )
        if "spheres" in primitives:
            number, cover = primitives["spheres"], primitives.get("cover")
            if not isinstance(number, int) or not isinstance(cover, float | None):
                raise FormatError(
                    f"{folder / CARD}: primitives: spheres {number!r}, cover {cover!r}; expected "
                    "an integer, and a number or null"
                )
            robot = as_spheres(robot, library.folders, spheres=number, cover=cover)
        else:
            robot = with_geometry(robot, "primitive", library.folders)
    with tempfile.TemporaryDirectory() as scratch:  # a URDF names its meshes relative to its bundle
        bundle = write_bundle(robot, Path(scratch) / robot.name, picture=False)
        return (bundle / URDF).read_text(encoding="utf-8")


def _stored_derivation(folder: Path) -> Derivation:
    _require_folder(folder)
    if light := light_derivation(folder):
        return light
    if not is_robot_folder(folder):
        raise FormatError(f"{folder} is not a robot: it has neither {CARD} nor {DERIVATION}")
    text = read_card(folder).get("derivation")
    if not isinstance(text, str):
        raise FormatError(
            f"{folder / CARD} has no derivation: the robot was imported, not composed"
        )
    return parse_derivation(text, str(folder / CARD))


def _require_folder(folder: Path) -> None:
    if not folder.exists():
        raise FormatError(f"{folder}: no such file or folder")
