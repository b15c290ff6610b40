"""``morphgen fit``: meshes to boxes, cylinders and spheres."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    ROBOTS_HELP,
    Subparsers,
    add_jobs,
    add_json,
    add_library,
    add_root,
    library_of,
    sources_named,
    whole_number,
)

if TYPE_CHECKING:
    from morphgen.fitting.agreement import Agreement
    from morphgen.fitting.link_fit import FitOptions, LinkFit
    from morphgen.fitting.quality import Quality
    from morphgen.fitting.robot_fit import FitReport
    from morphgen.model.robot import Robot

IOU, CONFIGURATIONS = 0.9, 1000
"""Unless the user says otherwise."""
HEADERS = (
    "link",
    "primitives",
    "solid",
    "IoU",
    "coverage",
    "volume ratio",
    "protrusion mm",
    "p95",
    "gap mm",
    "p95",
    "Hausdorff mm",
    "s",
)


@dataclass(frozen=True)
class Target:
    """A robot or the body of a part, to which primitives are fitted."""

    label: str
    """How the user names it."""
    robot: Robot
    path: Path | None
    """Its file or folder, if it has one of its own."""
    is_part: bool


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "fit",
        help="fit boxes, cylinders and spheres to meshes, and say how good they are",
        description="Fit boxes, cylinders and spheres to the meshes of a part, a robot or a file, "
        "and say how good they are. With --out, write the robot with primitives as its collision "
        "shapes.",
        epilog="examples: morphgen fit panda; morphgen fit robots/ur5-plane --max-primitives 4 "
        "--out robots/ur5-plane-prims; morphgen fit link.stl --max-primitives 3",
    )
    parser.add_argument(
        "words", nargs="*", metavar="ROBOT", help=f"a part, a mesh file, or {ROBOTS_HELP}"
    )
    parser.add_argument("--all", action="store_true", help="fit and store every part with meshes")
    parser.add_argument(
        "--missing", action="store_true", help="with --all: only what is not stored"
    )
    parser.add_argument(
        "--max-primitives", type=int, metavar="K", help="the most of a link (default: 1)"
    )
    parser.add_argument(
        "--iou",
        type=float,
        default=IOU,
        help=f"take the fewest primitives that reach it (default: {IOU})",
    )
    parser.add_argument(
        "--enclose", action="store_true", help="hold every point of the link, for safe collisions"
    )
    parser.add_argument("--visual", action="store_true", help="replace the visuals, too")
    parser.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="write the robot's bundle here; of several robots, one bundle each",
    )
    parser.add_argument("--no-picture", action="store_true", help="do not draw preview.png")
    parser.add_argument(
        "--configurations",
        type=whole_number(1),
        default=CONFIGURATIONS,
        metavar="N",
        help=f"compare collisions in so many configurations (default: {CONFIGURATIONS}; "
        "with --out)",
    )
    add_jobs(parser)
    parser.add_argument("--seed", type=whole_number(0), default=0)
    add_root(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Fit, print the table, write."""
    from morphgen.errors import MorphgenError
    from morphgen.fitting.link_fit import FitOptions
    from morphgen.model.geometry import MESH_SUFFIXES

    if args.all == bool(args.words):
        raise MorphgenError("name a part, a robot or a mesh file, or say --all")
    try:
        most = 1 if args.max_primitives is None else args.max_primitives
        options = FitOptions(most, args.iou, args.enclose, args.seed)
    except ValueError as error:
        raise MorphgenError(str(error)) from error
    if args.missing and not args.all:
        raise MorphgenError("--missing goes with --all")
    if args.all:
        return _store_all(args)
    given = {"--visual": args.visual, "--no-picture": args.no_picture}
    if idle := [name for name, value in given.items() if value and not args.out]:
        raise MorphgenError(f"{' '.join(idle)}: only with --out")
    if len(args.words) == 1 and Path(args.words[0]).suffix.lower() in MESH_SUFFIXES:
        return _mesh(args, options)
    return _robots(args, options)


def _mesh(args: argparse.Namespace, options: FitOptions) -> int:
    from morphgen.errors import FitError, MorphgenError
    from morphgen.fitting.link_fit import fit_shapes
    from morphgen.model.geometry import Mesh, Shape

    path = Path(args.words[0])
    if args.out:
        raise MorphgenError(f"--out writes a robot, and {path} is a mesh; use --json")
    try:
        fit = fit_shapes([Shape(Mesh(path))], options)
    except FitError as error:
        raise MorphgenError(f"{path}: {error}") from error
    if args.json:
        print(json.dumps({"mesh": str(path), **fit.as_dict()}))
        return 0
    _print_table([_row(path.name, fit)])
    for shape in fit.primitives:
        pose = shape.T_link_shape
        print(f"{shape.geometry} at {pose.position}, quaternion {pose.quaternion}")
    return 0


def _robots(args: argparse.Namespace, options: FitOptions) -> int:
    targets = _targets(args)
    several = len(targets) > 1
    data = []
    for target in targets:
        folder = _folder(args, target, several) if args.out else None
        if several and not args.json:
            print(f"{target.robot.name}:")
        data.append(_robot(target, folder, options, args))
    if args.json:
        print(json.dumps(data if several else data[0]))
    return 0


def _robot(
    target: Target, folder: Path | None, options: FitOptions, args: argparse.Namespace
) -> dict[str, object]:
    """Fit one robot, write its bundle if a folder is given, and return what ``--json`` prints."""
    from dataclasses import replace

    from morphgen.fitting.agreement import agreement
    from morphgen.fitting.part_fits import fits_of
    from morphgen.fitting.replace_collision import with_fits, with_primitives
    from morphgen.formats.fits import read_stored_fits

    robot = target.robot
    report = _fit(target, options, args)
    data = report.as_dict()
    if not args.json:
        _print_report(report)
    if folder is None:
        return data
    primitives = {row.link: row.fit.primitives for row in report.links}
    fits = fits_of(robot, report, read_stored_fits(library_of(args).folders))
    made = replace(
        with_fits(with_primitives(robot, primitives, visual=args.visual), fits),
        name=folder.name,
        provenance={**robot.provenance, "primitives": report.without_times()},
    )
    compared, hulls = agreement(robot, made, args.configurations, args.seed)
    _write(made, folder, target.is_part, args)
    if not args.json:
        _print_agreement(compared, hulls, args.configurations)
        print(folder)
    return data | {"agreement": compared.as_dict(), "agreement_of_hulls": hulls.as_dict()}


def _folder(args: argparse.Namespace, target: Target, several: bool) -> Path:
    """Where the bundle goes; refused before the long work if it cannot go there."""
    from morphgen.errors import FormatError
    from morphgen.formats.bundle import bundle_folder, require_replaceable

    parent, name = (args.out, target.robot.name) if several else (args.out.parent, args.out.name)
    folder = bundle_folder(parent, name)
    if target.path is not None:
        source = target.path.resolve()
        if folder.resolve() in (source, *source.parents[:1]):
            raise FormatError(f"--out {args.out} is the robot itself; name another folder")
    require_replaceable(folder)
    return folder


def _write(robot: Robot, folder: Path, is_part: bool, args: argparse.Namespace) -> None:
    from morphgen.checks import check
    from morphgen.formats.bundle import write_bundle

    findings = check(robot, tool_required=not is_part)
    write_bundle(robot, folder, findings, picture=not args.no_picture)


def _targets(args: argparse.Namespace) -> list[Target]:
    """Return what is to be fitted: a part by its name, or robots."""
    from morphgen.errors import FormatError
    from morphgen.grammar.part import load_part
    from morphgen.grammar.robot_source import is_robot_file, read_source

    library = library_of(args)
    word = args.words[0]
    if len(args.words) == 1 and word in library.paths and not is_robot_file(word):
        if args.root is not None:
            raise FormatError(f"--root {args.root}: only with a bundle, a URDF or a xacro")
        return [Target(word, load_part(library.manifest(word)).fragment, None, is_part=True)]
    return [
        Target(source.label, read_source(source, library, args.root), source.path, is_part=False)
        for source in sources_named(args)
    ]


def _fit(target: Target, options: FitOptions, args: argparse.Namespace) -> FitReport:
    from tqdm import tqdm

    from morphgen.errors import FitError
    from morphgen.fitting.robot_fit import fit_links
    from morphgen.formats.fits import shapes_to_fit

    links = sum(1 for link in target.robot.links if shapes_to_fit(link))
    if not links:
        raise FitError(f"{target.label}: no link has a shape")
    quiet = args.json or None
    with tqdm(total=links, unit="link", file=sys.stderr, disable=quiet, leave=False) as bar:
        report = fit_links(
            target.robot, options, jobs=args.jobs, progress=lambda link: bar.update()
        )
    return report


def _store_all(args: argparse.Namespace) -> int:
    from tqdm import tqdm

    from morphgen.errors import MorphgenError
    from morphgen.fitting.part_fits import parts_with_meshes, store_parts

    given = {
        "--out": args.out,
        "--root": args.root,
        "--enclose": args.enclose,
        "--visual": args.visual,
        "--no-picture": args.no_picture,
        "--max-primitives": args.max_primitives is not None,
        "--iou": args.iou != IOU,
        "--configurations": args.configurations != CONFIGURATIONS,
        "--seed": args.seed,
        "--json": args.json,
    }
    if idle := [name for name, value in given.items() if value]:
        raise MorphgenError(
            "--all stores one primitive and up to four for every part, always the same ones: it "
            f"takes no {' or '.join(idle)}"
        )
    library = library_of(args)
    parts = parts_with_meshes(library, missing=args.missing)
    stored = store_parts(parts, jobs=args.jobs)
    for path in tqdm(stored, total=len(parts), unit="part", file=sys.stderr):
        tqdm.write(str(path))
    return 0


def _print_report(report: FitReport) -> None:
    rows = [_row(each.link, each.fit, each.same_as) for each in report.links]
    if report.mean is not None:
        seconds = sum(each.fit.seconds for each in report.links)
        rows.append(("mean", "", "", *_figures(report.mean), seconds))
    _print_table(rows)
    for finding in report.findings:
        print(f"{finding.severity} {finding.code} at {finding.where}: {finding.why}")


def _print_agreement(primitives: Agreement, hulls: Agreement, n: int) -> None:
    from tabulate import tabulate

    rows = [
        (name, found.accuracy, found.precision, found.recall)
        for name, found in (("primitives", primitives), ("convex hulls of meshes", hulls))
    ]
    print(f"collisions in {n} random configurations, compared with the meshes' triangles:")
    print(tabulate(rows, ("", "agree", "precision", "recall"), floatfmt=".3f"))


def _print_table(rows: list[tuple[object, ...]]) -> None:
    from tabulate import tabulate

    formats = ("", "", "", ".3f", ".3f", ".2f", ".1f", ".1f", ".1f", ".1f", ".1f", ".1f")
    print(tabulate(rows, HEADERS, floatfmt=formats))


def _row(link: str, fit: LinkFit, same_as: str | None = None) -> tuple[object, ...]:
    kinds = Counter(type(shape.geometry).__name__.lower() for shape in fit.primitives)
    named = ", ".join(f"{n} {kind}" if n > 1 else kind for kind, n in sorted(kinds.items()))
    solid = f"as {same_as}" if same_as else fit.solid
    return (link, named, solid, *_figures(fit.quality), fit.seconds)


def _figures(quality: Quality) -> tuple[float, ...]:
    """Figures of a row; distances in millimetres."""
    distances = (
        quality.protrusion_mean,
        quality.protrusion_p95,
        quality.gap_mean,
        quality.gap_p95,
        quality.hausdorff,
    )
    shares = (quality.iou, quality.coverage, quality.volume_ratio)
    return (*shares, *(1e3 * distance for distance in distances))
