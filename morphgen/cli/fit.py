"""``morphgen fit``: meshes to boxes, cylinders and spheres, or to spheres alone."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option
from morphgen.cli.progress import bar, print_line, status, track
from morphgen.errors import FitError, FormatError, MorphgenError

if TYPE_CHECKING:
    from morphgen.fitting.fitted_robot import Agreement
    from morphgen.fitting.link_fit import FitOptions, LinkFit
    from morphgen.fitting.quality import Quality
    from morphgen.fitting.robot_fit import FitReport
    from morphgen.model.robot import Robot

DEFAULT_IOU, DEFAULT_CONFIGURATIONS = 0.9, 1000
COLUMNS = {
    "link": "",
    "primitives": "",
    "solid": "",
    "IoU": ".3f",
    "coverage": ".3f",
    "volume ratio": ".2f",
    "protruding": ".2f",
    "protrusion mm": ".1f",
    "protrusion p95": ".1f",
    "gap mm": ".1f",
    "gap p95": ".1f",
    "Hausdorff mm": ".1f",
    "s": ".1f",
}
"""Headers of the table of fits, and how their numbers are written."""


@dataclass(frozen=True)
class Target:
    """A robot, or a part alone, to which primitives are fitted."""

    label: str
    """Name that the user gave."""
    robot: Robot
    path: Path | None
    """File or folder of the robot; None if it is composed or a part."""
    is_part: bool


@command(
    "fit",
    "fit primitives to meshes, and measure how good they are",
    option("words ROBOT", f"a part, a mesh file, or {opt.ROBOTS_HELP}", nargs="*"),
    flag("--all", "fit every part with meshes, and store the fits in the library"),
    flag("--missing", "with --all: only the parts without stored fits").needing("--all"),
    option("--max-primitives K", "largest number of primitives per link (default: 1)", int).without(
        "--all", "--spheres"
    ),
    option(
        "--iou",
        "with --max-primitives: use the fewest primitives that reach this intersection over "
        f"union (default: {DEFAULT_IOU})",
        float,
    )
    .needing("--max-primitives")
    .without("--all", "--spheres"),
    number(
        "--spheres", "fit N spheres to each link, and no other primitives, for planners"
    ).without("--all"),
    option(
        "--cover SHARE",
        "with --spheres: share of each link's volume that they must cover, such as 0.995 "
        "(default: the largest intersection over union)",
        float,
    ).needing("--spheres"),
    flag("--enclose", "enclose every point of the link, for conservative collision checks").without(
        "--all", "--spheres"
    ),
    flag("--visual", "replace the visual shapes, too").needing("--out").without("--all"),
    option(
        "--out DIR", "write the robot's bundle to DIR; several robots: a bundle each in DIR", Path
    ).without("--all"),
    opt.NO_PICTURE.needing("--out").without("--all"),
    number(
        "--configurations",
        "with --out: number of random configurations in which collisions are compared with "
        f"those of the meshes (default: {DEFAULT_CONFIGURATIONS})",
    )
    .needing("--out")
    .without("--all"),
    opt.JOBS,
    *(each.without("--all") for each in (opt.SEED, opt.ROOT, opt.JSON)),
    opt.LIBRARY,
    details="With --out, the robot is written with the primitives as its collision shapes. --all "
    "stores one primitive and up to four for every part, always the same ones.",
    examples=(
        "fit panda",
        "fit robots/ur5-plane --max-primitives 4 --out robots/ur5-plane-prims",
        "fit link.stl --max-primitives 3",
        "fit panda --spheres 8 --cover 0.995",
    ),
    extra="fit",
)
def fit(args: argparse.Namespace) -> None:
    """Fit, print the table and write bundles."""
    from morphgen.fitting.link_fit import FitOptions
    from morphgen.model.geometry import MESH_SUFFIXES

    if args.all == bool(args.words):
        raise MorphgenError("name a part, a robot or a mesh file, or say --all")
    options = FitOptions(**opt.given(args, (each.name for each in fields(FitOptions))))
    if args.all:
        _fit_all_parts(args)
        return
    if len(args.words) == 1 and Path(args.words[0]).suffix.lower() in MESH_SUFFIXES:
        _fit_mesh(args, options)
        return
    targets = _targets(args)
    if args.out:
        _require_own_names(targets)
    results = []
    for target in targets:
        folder = _folder(args, target, several=len(targets) > 1) if args.out else None
        if len(targets) > 1 and not args.json:
            print(f"{target.robot.name}:")
        results.append(_fit_robot(target, folder, options, args))
    if args.json:
        print(json.dumps(results if len(results) > 1 else results[0]))


def _require_own_names(targets: Sequence[Target]) -> None:
    """Require that no two robots have one name, which is that of their folder."""
    labels: dict[str, str] = {}
    for target in targets:
        other = labels.setdefault(target.robot.name, target.label)
        if other != target.label:  # one robot may be named twice
            raise FormatError(
                f"{target.label} and {other} are both named {target.robot.name!r}; fit them one "
                "at a time, into folders of their own"
            )


def _fit_mesh(args: argparse.Namespace, options: FitOptions) -> None:
    from morphgen.fitting.link_fit import fit_shapes
    from morphgen.model.geometry import Mesh, Shape

    path = Path(args.words[0])
    if args.out:
        raise MorphgenError(f"--out writes a robot, and {path} is a mesh; use --json")
    try:
        with status(args, f"fitting {path}"):
            fit = fit_shapes([Shape(Mesh(path))], options)
    except FitError as error:
        raise MorphgenError(f"{path}: {error}") from error

    def text() -> str:
        primitives = [
            f"{shape.geometry} at {pose.position}, quaternion {pose.quaternion}"
            for shape in fit.primitives
            if (pose := shape.T_link_shape)
        ]
        return "\n".join([_table([_row(path.name, fit)]), *primitives])

    opt.print_result(args, {"mesh": str(path), **fit.as_dict()}, text)


def _targets(args: argparse.Namespace) -> list[Target]:
    """Return what the arguments name: a part, or robots."""
    from morphgen.grammar.part import load_part
    from morphgen.grammar.robot_source import is_robot_file

    library = opt.library_of(args)
    word = args.words[0]
    if len(args.words) == 1 and word in library.paths and not is_robot_file(word):
        if args.root is not None:
            raise MorphgenError(f"--root {args.root}: only with a bundle or a description")
        return [Target(word, load_part(library.manifest(word)).fragment, None, is_part=True)]
    return [
        Target(source.label, robot, source.path, is_part=False)
        for source, robot in opt.read_robots(args)
    ]


def _folder(args: argparse.Namespace, target: Target, *, several: bool) -> Path:
    """Return the folder of the bundle."""
    from morphgen.formats.bundle import bundle_folder, require_replaceable

    parent, name = (args.out, target.robot.name) if several else (args.out.parent, args.out.name)
    folder = bundle_folder(parent, name)
    if target.path is not None:
        source = target.path.resolve()
        # A robot may be named by its bundle, or by a file in it.
        if folder.resolve() in (source, source.parent):
            raise FormatError(f"--out {args.out} is the robot itself; name another folder")
    require_replaceable(folder)
    return folder


def _fit_robot(
    target: Target, folder: Path | None, options: FitOptions, args: argparse.Namespace
) -> dict[str, object]:
    """Fit one robot, write its bundle if a folder is given, and return the data of ``--json``."""
    from morphgen.checks import check
    from morphgen.fitting.fitted_robot import fit_robot
    from morphgen.formats.bundle import write_bundle

    folders = opt.library_of(args).folders
    with bar(args, f"fitting {target.label}", "link"):
        fit = fit_robot(target.robot, options, folders, visual=args.visual, jobs=args.jobs)
    report = fit.report
    if not args.json:
        print(_report_text(report))
    if folder is None:
        return report.as_dict()
    configurations = args.configurations or DEFAULT_CONFIGURATIONS
    with status(args, f"comparing collisions in {configurations} configurations"):
        of_primitives, of_hulls = fit.agreement(configurations, args.seed)
    fitted = replace(fit.robot, name=folder.name)  # a bundle's folder has the name of its robot
    findings = check(fitted, tool_required=not target.is_part)
    write_bundle(fitted, folder, findings, picture=not args.no_picture)
    if not args.json:
        print(_agreement_text(of_primitives, of_hulls, configurations))
        print(folder)
    return report.as_dict() | {
        "agreement": of_primitives.as_dict(),
        "agreement_of_hulls": of_hulls.as_dict(),
    }


def _fit_all_parts(args: argparse.Namespace) -> None:
    from morphgen.fitting.robot_fit import parts_with_meshes, store_parts

    parts = parts_with_meshes(opt.library_of(args), missing=args.missing)
    for path in track(store_parts(parts, jobs=args.jobs), args, "fitting", "part", len(parts)):
        print_line(str(path))


def _report_text(report: FitReport) -> str:
    rows = [_row(row.link, row.fit, row.same_as) for row in report.links]
    if report.mean is not None:
        seconds = sum(row.fit.seconds for row in report.links)
        rows.append(("mean", "", "", *_quality_cells(report.mean), seconds))
    findings = [
        f"{finding.severity} {finding.code} at {finding.where}: {finding.why}"
        for finding in report.findings
    ]
    return "\n".join([_table(rows), *findings])


def _agreement_text(primitives: Agreement, hulls: Agreement, n: int) -> str:
    rows = [
        (name, result.accuracy, result.precision, result.recall)
        for name, result in (("primitives", primitives), ("convex hulls of meshes", hulls))
    ]
    table = opt.table(rows, ("", "agree", "precision", "recall"), floatfmt=".3f")
    return f"collisions in {n} random configurations, compared with the meshes' triangles:\n{table}"


def _table(rows: list[tuple[object, ...]]) -> str:
    return opt.table(rows, list(COLUMNS), floatfmt=tuple(COLUMNS.values()))


def _row(link: str, fit: LinkFit, same_as: str | None = None) -> tuple[object, ...]:
    kinds = Counter(type(shape.geometry).__name__.lower() for shape in fit.primitives)
    named = ", ".join(f"{n} {kind}" if n > 1 else kind for kind, n in sorted(kinds.items()))
    solid = f"as {same_as}" if same_as else fit.solid
    return (link, named, solid, *_quality_cells(fit.quality), fit.seconds)


def _quality_cells(quality: Quality) -> tuple[float, ...]:
    """Return the cells of a fit's quality; distances in millimetres."""
    distances = (
        quality.protrusion_mean,
        quality.protrusion_p95,
        quality.gap_mean,
        quality.gap_p95,
        quality.hausdorff,
    )
    shares = (quality.iou, quality.coverage, quality.volume_ratio, quality.protrusion_share)
    return (*shares, *(1e3 * distance for distance in distances))
