"""``morphgen fit``: meshes to boxes, cylinders and spheres, or to spheres alone."""

from __future__ import annotations

import argparse
from collections import Counter
from dataclasses import fields, replace
from pathlib import Path

from morphgen.checks import check
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, print_line, track
from morphgen.errors import FormatError, MorphgenError
from morphgen.fitting.link_fit import FitOptions, LinkFit, Quality
from morphgen.fitting.replace_collision import fit_robot, mesh_robot
from morphgen.fitting.robot_fit import FitReport, parts_without_fits, store_part
from morphgen.formats.bundle import bundle_folder, require_replaceable, write_bundle
from morphgen.grammar.part import load_part
from morphgen.grammar.robot_source import RobotReference, is_robot_file
from morphgen.model.geometry import MESH_SUFFIXES
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.tables import table

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
}
"""Headers of the table of fits, and how their numbers are written."""


def fit(args: argparse.Namespace) -> None:
    """Fit, print the table and write a bundle."""
    if args.all == bool(args.words):
        raise MorphgenError("name a part, a robot or a mesh file, or say --all alone")
    options = FitOptions(**opt.given(args, (each.name for each in fields(FitOptions))))
    if args.all:
        parts = parts_without_fits(opt.library_of(args))
        paths = parallel_map(store_part, parts, args.jobs, chunk=1)
        for path in track(paths, args, "fitting", "part", len(parts)):
            print_line(str(path))
        return
    source, robot = _target(args)
    folder = _folder(args.out, source) if args.out else None
    with bar(args, f"fitting {source.label if source else robot.name}", "link"):
        fit = fit_robot(robot, options, opt.library_of(args).folders, jobs=args.jobs)
    opt.print_result(args, fit.report.as_dict(), lambda: _report_text(fit.report))
    if folder is not None:
        fitted = replace(fit.robot, name=folder.name)  # a bundle's folder has its robot's name
        findings = check(fitted, tool_required=source is not None)
        write_bundle(fitted, folder, findings, picture=not args.no_picture)
        if not args.json:
            print(folder)


def _target(args: argparse.Namespace) -> tuple[RobotReference | None, Robot]:
    """Return what the arguments name: a part or a mesh file, which have no source, or a robot."""
    library = opt.library_of(args)
    word = args.words[0]
    is_mesh = Path(word).suffix.lower() in MESH_SUFFIXES
    if len(args.words) == 1 and (is_mesh or (word in library.paths and not is_robot_file(word))):
        if args.root is not None:
            raise MorphgenError(f"--root {args.root}: only with a bundle or a description")
        if is_mesh:
            return None, mesh_robot(Path(word))
        return None, load_part(library.manifest(word)).fragment
    return opt.read_one_robot(args)


def _folder(out: Path, source: RobotReference | None) -> Path:
    """Return the folder of the bundle."""
    folder = bundle_folder(out.parent, out.name)
    if source is not None and source.path is not None:
        path = source.path.resolve()
        # A robot may be named by its bundle, or by a file in it.
        if folder.resolve() in (path, path.parent):
            raise FormatError(f"--out {out} is the robot itself; name another folder")
    require_replaceable(folder)
    return folder


def _report_text(report: FitReport) -> str:
    rows = [_row(row.link, row.fit, row.same_as) for row in report.links]
    if report.mean is not None:
        rows.append(("mean", "", "", *_quality_cells(report.mean)))
    return "\n".join([_table(rows), *map(opt.finding_line, report.findings)])


def _table(rows: list[tuple[object, ...]]) -> str:
    return table(rows, list(COLUMNS), formats=list(COLUMNS.values()))


def _row(link: str, fit: LinkFit, same_as: str | None = None) -> tuple[object, ...]:
    kinds = Counter(type(shape.geometry).__name__.lower() for shape in fit.primitives)
    named = ", ".join(f"{n} {kind}" if n > 1 else kind for kind, n in sorted(kinds.items()))
    solid = f"as {same_as}" if same_as else fit.solid
    return (link, named, solid, *_quality_cells(fit.quality))


def _quality_cells(quality: Quality) -> tuple[float, ...]:
    """Return the cells of a fit's quality; distances in millimetres."""
    shares = ("iou", "coverage", "volume_ratio", "protrusion_share")
    distances = ("protrusion_mean", "protrusion_p95", "gap_mean", "gap_p95", "hausdorff")
    return (
        *(getattr(quality, name) for name in shares),
        *(1e3 * getattr(quality, name) for name in distances),
    )
