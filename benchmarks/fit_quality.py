"""Quality of primitive fits, compared with trimesh's tightest bound and scikit-robot.

    python benchmarks/fit_quality.py [--only ur5,panda] [--solid link,as-read]
        [--fits one,four] [--jobs 2] [--json rows.json]

Measures every link of every real arm. All methods use the same solid and the measure of
`morphgen.fitting.link_fit`. Prints one table per definition of the solid:

- ``link``: the interior of the link as `morphgen.fitting.solid` defines it.
- ``as-read``: a mesh's own triangles if trimesh reads the file as a closed surface, else the convex
  hull. COLLADA files split vertices at sharp edges and are therefore never closed, so that links
  from COLLADA files (all of the Jaco's) are fuller than they should be.
- ``hull``: the convex hull of each mesh, which simulators use for collisions.

A row is an arm; values are means over its links (links with the same meshes are fitted once):

- IoU of one primitive: trimesh's tightest of oriented box, cylinder and sphere (AnyBody's method),
  scikit-robot's, ours; ours with up to four primitives, and their number.
- CPU seconds per link, for ours including the measurement: scikit-robot's, ours with one primitive
  and with up to four.

``--fits`` names the fits of morphgen to measure. With ``--json``, an interrupted run goes on where
it stopped.
scikit-robot comes with `pip install morphgen[bench]`; without it its columns are missing.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import trimesh
from tabulate import tabulate
from tqdm import tqdm

from morphgen.files import write_atomic
from morphgen.fitting.link_fit import FitOptions, fit_solid, quality
from morphgen.fitting.solid import Solid, solid_of, solid_of_mesh
from morphgen.formats.fits import shapes_key
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import solid_mesh
from morphgen.model.mesh import is_flat, load_mesh
from morphgen.processes import parallel_map
from morphgen.typing import Array

T = TypeVar("T")
Row = dict[str, float]
"""Measured values of a link by column."""
FOUR = ("ur5", "panda", "xarm7", "jaco2")
"""The arms for which issues of this project set targets."""
FITS = {"one": FitOptions(), "four": FitOptions(max_primitives=4, iou=1.0)}
"""Fits that are measured, by their name in the columns."""
IOUS = ("iou trimesh", "iou skrobot", "iou one", "iou four")
COLUMNS = (*IOUS, "n four", "s skrobot", "s one", "s four")


@dataclass(frozen=True)
class Task:
    """One link of one arm."""

    arm: str
    link: str
    shapes: tuple[Shape, ...]


def main() -> int:
    """Measure all links and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="arms, separated by commas")
    parser.add_argument("--solid", default="link", help=f"of {', '.join(SOLIDS)}; by commas")
    parser.add_argument("--fits", default=",".join(FITS), help="by commas (default: %(default)s)")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="write rows here; go on from those there")
    args = parser.parse_args()
    solids = args.solid.split(",")
    if unknown := set(solids) - set(SOLIDS):
        parser.error(f"no solid {', '.join(sorted(unknown))}; valid: {', '.join(SOLIDS)}")
    fits = args.fits.split(",")
    if unknown := set(fits) - set(FITS):
        parser.error(f"no fit {', '.join(sorted(unknown))}; valid: {', '.join(FITS)}")
    peer = find_spec("skrobot") is not None
    tasks = link_tasks({name for name in args.only.split(",") if name})
    unique = {shapes_key(task.shapes): task for task in tasks}
    stored = json.loads(args.json.read_text("utf-8")) if args.json and args.json.exists() else []
    entries: dict[tuple[str, str], dict[str, Any]] = {
        (entry["solid"], entry["shapes"]): entry for entry in stored
    }
    needed = {f"iou {fit}" for fit in (*fits, *(["skrobot"] if peer else []))}
    for name in solids:
        missing = {
            key: task
            for key, task in unique.items()
            if (name, key) not in entries or not needed <= entries[name, key]["row"].keys()
        }
        measure = partial(_measure, solid_name=name, fits=fits, peer=peer)
        measured = parallel_map(measure, list(missing.values()), args.jobs, chunk=1)
        shown = tqdm(measured, total=len(missing), unit="link")
        for (key, task), row in zip(missing.items(), shown, strict=True):
            link = {"arm": task.arm, "link": task.link}
            before = entries[name, key]["row"] if (name, key) in entries else {}
            entries[name, key] = {"solid": name, "shapes": key, **link, "row": {**before, **row}}
            if args.json:
                write_atomic(args.json, json.dumps(list(entries.values()), indent=1) + "\n")
        found: dict[str, list[Row]] = defaultdict(list)
        for task in tasks:
            found[task.arm].append(entries[name, shapes_key(task.shapes)]["row"])
        print(f"\nsolid: {name}")
        _print(found)
    if not peer:
        print("scikit-robot is not installed: no peer in this run (pip install 'morphgen[bench]')")
    return 0


def _print(found: Mapping[str, Sequence[Row]]) -> None:
    # Rows of earlier runs may have columns that others lack.
    measured = set.intersection(*(set(row) for of in found.values() for row in of))
    columns = [name for name in COLUMNS if name in measured]
    rows = [
        [arm, *(float(np.mean([row[name] for row in of])) for name in columns)]
        for arm, of in sorted(found.items())
    ]
    table = [*rows, *_means("mean of all arms", rows)]
    table += _means(f"mean of {', '.join(FOUR)}", [row for row in rows if row[0] in FOUR])
    print(tabulate(table, ["arm", *columns], floatfmt=".3f"))


def link_tasks(only: set[str]) -> list[Task]:
    """Return the links with shapes of the named real arms, or of all real arms."""
    return [
        Task(manifest.name, link.name, link.solid_shapes)
        for manifest in default_library().manifests("arm")
        if not manifest.is_template and not manifest.scaling
        if not only or manifest.name in only
        for link in load_part(manifest).fragment.links
        if link.solid_shapes
    ]


def _hull(shapes: Sequence[Shape]) -> Solid:
    return _joined([trimesh.convex.convex_hull(mesh) for mesh, _ in _meshes(shapes)])


def _as_read(shapes: Sequence[Shape]) -> Solid:
    found = []
    for mesh, is_closed in _meshes(shapes):
        solid = solid_of_mesh(mesh) if is_closed else None
        found.append(solid.mesh if solid else trimesh.convex.convex_hull(mesh))
    return _joined(found)


def _meshes(shapes: Sequence[Shape]) -> Iterator[tuple[trimesh.Trimesh, bool]]:
    """Return meshes in the link frame and whether each file is closed as read; skip flat meshes."""
    for shape in shapes:
        geometry, is_closed = shape.geometry, True
        if isinstance(geometry, Mesh):
            is_closed = bool(trimesh.load_mesh(geometry.path).is_watertight)
        mesh = (load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)).copy()
        mesh.apply_transform(shape.T_link_shape.matrix)
        if not is_flat(np.asarray(mesh.vertices)):
            yield mesh, is_closed


def _joined(meshes: list[trimesh.Trimesh]) -> Solid:
    return Solid(cast(trimesh.Trimesh, trimesh.util.concatenate(meshes)), "watertight")


SOLIDS: dict[str, Callable[[Sequence[Shape]], Solid]] = {
    "link": solid_of,
    "as-read": _as_read,
    "hull": _hull,
}


def _measure(task: Task, *, solid_name: str, fits: Sequence[str], peer: bool) -> Row:
    solid = SOLIDS[solid_name](task.shapes)
    row = {"iou trimesh": quality(solid, [_tightest(solid)]).iou}
    if peer:
        shape, seconds = _timed(lambda: _scikit_robot(solid))
        row |= {"iou skrobot": quality(solid, [shape]).iou, "s skrobot": seconds}
    for name in fits:
        fit, seconds = _timed(partial(fit_solid, solid, FITS[name]))
        row |= {
            f"iou {name}": fit.quality.iou,
            f"n {name}": float(len(fit.primitives)),
            f"s {name}": seconds,
        }
    return row


def _tightest(solid: Solid) -> Shape:
    """Return the smallest of trimesh's bounding primitives."""
    T_box, extents = trimesh.bounds.oriented_bounds(solid.mesh)
    cylinder = trimesh.bounds.minimum_cylinder(solid.mesh)
    centre, radius = trimesh.nsphere.minimum_nsphere(solid.mesh)
    T_sphere = trimesh.transformations.translation_matrix(centre)
    x, y, z = (float(extent) for extent in extents)
    options: list[tuple[float, Box | Cylinder | Sphere, Array]] = [
        (x * y * z, Box((x, y, z)), np.linalg.inv(T_box)),
        (
            np.pi * cylinder["radius"] ** 2 * cylinder["height"],
            Cylinder(float(cylinder["radius"]), float(cylinder["height"])),
            cylinder["transform"],
        ),
        (4 / 3 * np.pi * radius**3, Sphere(float(radius)), T_sphere),
    ]
    _, geometry, T_link_shape = min(options, key=lambda option: float(option[0]))
    return Shape(geometry, Pose.from_matrix(np.asarray(T_link_shape)))


def _scikit_robot(solid: Solid) -> Shape:
    from skrobot.utils.primitive_fitting import fit_primitive_to_mesh, primitive_params_to_origin

    found = fit_primitive_to_mesh(solid.mesh)
    xyz, rpy = (tuple(float(v) for v in part) for part in primitive_params_to_origin(found))
    geometry: Box | Cylinder | Sphere
    match found["type"]:
        case "box":
            x, y, z = (float(extent) for extent in found["extents"])
            geometry = Box((x, y, z))
        case "cylinder":
            geometry = Cylinder(float(found["radius"]), float(found["height"]))
        case _:
            geometry = Sphere(float(found["radius"]))
    return Shape(geometry, Pose.from_xyz_rpy((xyz[0], xyz[1], xyz[2]), (rpy[0], rpy[1], rpy[2])))


def _timed(fit: Callable[[], T]) -> tuple[T, float]:
    start = time.process_time()
    return fit(), time.process_time() - start


def _means(label: str, rows: Sequence[list[Any]]) -> list[list[Any]]:
    return [[label, *np.mean([row[1:] for row in rows], axis=0).tolist()]] if rows else []


if __name__ == "__main__":
    sys.exit(main())
