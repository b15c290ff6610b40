"""Quality of sphere models of arms, beside those that other tools ship or fit.

    python benchmarks/spheres.py [--only panda,ur5] [--spheres 8] [--cover 0.995] [--links]
                                 [--peer NAME FILE]... [--json rows.json]

Fits spheres to the collision meshes of every link: once for the largest intersection over union
(IoU), once so that they cover a share of the link. All sets are measured on the same solids by
`morphgen.fitting.link_fit`; a row has the means over the links of an arm:

- spheres: their number in the whole arm.
- IoU, coverage, volume: of the union of spheres and the solid, volume over that of the solid.
- protruding: share of the union's surface that is outside of the solid; distance of its surface
  from the solid [mm], 0 where inside, mean and 95th percentile.
- gap: distance of the solid's surface from the spheres [mm], 0 where inside, likewise.
- s: CPU seconds of the whole arm, the measurement excluded.

`--peer NAME FILE` measures the spheres of a file in cuRobo's format (`collision_spheres` by link,
also within `robot_cfg: kinematics:`) on the arm whose links it names. If ballpark
(https://github.com/chungmin99/ballpark) is installed, its `spherize` is measured with the same
number of spheres per link.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import trimesh
import yaml
from tabulate import tabulate
from tqdm import tqdm

from fit_quality import FOUR, Task, link_tasks
from morphgen.fitting.link_fit import quality
from morphgen.fitting.search import best_spheres, sample_solid
from morphgen.fitting.solid import Solid, solid_of
from morphgen.model.geometry import Pose, Shape, Sphere

T = TypeVar("T")
COLUMNS = {
    "IoU": ("iou", 1, ".3f"),
    "coverage": ("coverage", 1, ".4f"),
    "volume": ("volume_ratio", 1, ".3f"),
    "protruding": ("protrusion_share", 1, ".2f"),
    "mean mm": ("protrusion_mean", 1e3, ".1f"),
    "p95 mm": ("protrusion_p95", 1e3, ".1f"),
    "gap mean": ("gap_mean", 1e3, ".1f"),
    "gap p95": ("gap_p95", 1e3, ".1f"),
    "s": ("seconds", 1, ".1f"),
}
"""Columns: field of a row, factor, format."""
Spheres = Mapping[str, Sequence[Shape]]
"""Spheres by link."""


def main() -> int:
    """Measure the sets and print the tables."""
    parser = argparse.ArgumentParser(description="Quality of sphere models of arms.")
    parser.add_argument("--only", default=",".join(FOUR), help="names of arms")
    parser.add_argument("--spheres", type=int, default=8, help="number per link")
    parser.add_argument("--cover", type=float, default=0.995, help="share to cover")
    parser.add_argument("--peer", nargs=2, action="append", default=[], metavar=("NAME", "FILE"))
    parser.add_argument("--links", action="store_true", help="print a row per link, too")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    peers = [(name, read_peer(Path(file))) for name, file in args.peer]
    tasks = link_tasks({name for name in args.only.split(",") if name})
    if not tasks:
        parser.error(f"--only {args.only}: no arm has such a name")
    covering = f"{args.spheres} a link, cover {args.cover:g}"
    fits = {f"{args.spheres} a link": None, covering: args.cover}
    spherize = _ballpark()
    rows: list[dict[str, Any]] = []
    for task in tqdm(tasks, unit="link"):
        solid, solid_seconds = _timed(partial(solid_of, task.shapes))
        for name, cover in fits.items():
            shapes, seconds = _timed(partial(_fit, solid, args.spheres, cover))
            rows.append(_row(task, f"morphgen, {name}", solid, shapes, solid_seconds + seconds))
        for name, spheres in peers:
            if task.link in spheres:
                rows.append(_row(task, name, solid, spheres[task.link], None))
        if spherize is not None:
            shapes, seconds = _timed(partial(spherize, solid.mesh, args.spheres))
            rows.append(_row(task, "ballpark", solid, shapes, seconds))
    if args.links:
        _print(((row["arm"], row["set"], row["link"]), [row]) for row in rows)
    sets = dict.fromkeys((row["arm"], row["set"]) for row in rows)
    _print(
        ((*key, len(group)), group)
        for key in sets
        if (group := [row for row in rows if (row["arm"], row["set"]) == key])
    )
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return 0


def read_peer(path: Path) -> Spheres:
    """Read the spheres of a file in cuRobo's format; those of radius 0 and less are no spheres."""
    data = yaml.safe_load(path.read_text(encoding="utf-8"))
    data = data.get("robot_cfg", data)
    data = data.get("kinematics", data)
    return {
        link: [
            _sphere(sphere["center"], sphere["radius"])
            for sphere in spheres
            if sphere["radius"] > 0
        ]
        for link, spheres in data["collision_spheres"].items()
    }


def _sphere(centre: Iterable[float], radius: float) -> Shape:
    x, y, z = map(float, centre)
    return Shape(Sphere(float(radius)), Pose((x, y, z)))


def _fit(solid: Solid, spheres: int, cover: float | None) -> Sequence[Shape]:
    return best_spheres(sample_solid(solid, 0), spheres, cover, 0).shapes


def _ballpark() -> Callable[[trimesh.Trimesh, int], Sequence[Shape]] | None:
    """Return ballpark's fit of one mesh; None if it is missing, or another package of its name."""
    if find_spec("ballpark") is None:
        return None
    import ballpark

    if not hasattr(ballpark, "spherize"):
        return None

    def spherize(mesh: trimesh.Trimesh, n: int) -> Sequence[Shape]:
        spheres = ballpark.spherize(mesh, target_spheres=n)
        return [_sphere(sphere.center, sphere.radius) for sphere in spheres]

    return spherize


def _row(
    task: Task, name: str, solid: Solid, shapes: Sequence[Shape], seconds: float | None
) -> dict[str, Any]:
    measured = asdict(quality(solid, shapes))
    label = {"arm": task.arm, "set": name, "link": task.link, "spheres": len(shapes)}
    return {**label, **measured, "seconds": seconds}


def _print(groups: Iterable[tuple[tuple[object, ...], Sequence[Mapping[str, Any]]]]) -> None:
    """Print a row for each group: the means of its links, the sums of spheres and seconds."""
    table = []
    for label, group in groups:
        cells: list[float | None] = []
        for field, factor, _ in COLUMNS.values():
            values = [row[field] for row in group]
            if None in values:
                cells.append(None)
            else:
                cells.append(factor * float((np.sum if field == "seconds" else np.mean)(values)))
        table.append([*label, sum(row["spheres"] for row in group), *cells])
    formats = ("", "", "", "", *(form for *_, form in COLUMNS.values()))
    header = ["arm", "set", "links", "spheres", *COLUMNS]
    print(tabulate(table, header, floatfmt=formats, missingval="-"))


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    start = time.process_time()
    return work(), time.process_time() - start


if __name__ == "__main__":
    sys.exit(main())
