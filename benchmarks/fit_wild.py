"""Quality of primitive fits for meshes on which the fitter was not tuned.

    python benchmarks/fit_wild.py [--only talos,icub] [--jobs 2]

Fits every link with meshes of every URDF of example-robot-data (arms, hands, legged robots,
humanoids); links with the same meshes are fitted once. Each link gets one primitive, and up to four
where an intersection over union of 0.9 needs them. Prints the distribution, the methods that made
the solids, the refused links, and the ten worst links with two explanations: the share of its
bounding box and the share of its convex hull that the solid fills.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from importlib.metadata import files
from pathlib import Path

import numpy as np
from tabulate import tabulate
from tqdm import tqdm

from morphgen.errors import MorphgenError
from morphgen.fitting.link_fit import FitOptions, fit_solid
from morphgen.fitting.solid import solid_of
from morphgen.formats.bundle import read_robot
from morphgen.formats.fits import are_primitives, shapes_key
from morphgen.model.geometry import Shape
from morphgen.processes import parallel_map

QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95)
WORST = 10
PROBES = 2**14

Row = tuple[str, str, float, float, int, float, float, float]
"""Link, solid, IoU of one and of several primitives, their number, box and hull shares, seconds."""


def main() -> int:
    """Fit all links and print the summary."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="parts of file names, separated by commas")
    parser.add_argument("--jobs", type=int, default=1)
    args = parser.parse_args()
    links, refused = _links([word for word in args.only.split(",") if word])
    measured = parallel_map(_measure, list(links.items()), args.jobs, chunk=1)
    found = list(tqdm(measured, total=len(links), unit="link"))
    rows = [row for row in found if not isinstance(row, str)]
    refused += [row for row in found if isinstance(row, str)]
    print(f"{len(rows)} links; solids: {dict(Counter(row[1] for row in rows))}")
    spread = [
        (label, float(np.mean(values)), *np.quantile(values, QUANTILES).tolist())
        for label, values in (
            ("one primitive", [row[2] for row in rows]),
            ("up to four", [row[3] for row in rows]),
        )
    ]
    print(tabulate(spread, ["IoU", "mean", *(f"{q:.0%}" for q in QUANTILES)], floatfmt=".3f"))
    print(f"seconds a link: median {np.median([row[7] for row in rows]):.1f}")
    worst = sorted(rows, key=lambda row: row[3])[:WORST]
    heads = ["link", "solid", "one", "up to four", "n", "of its box", "of its hull", "s"]
    print(tabulate(worst, heads, floatfmt=".3f"))
    for reason in refused:
        print(f"refused: {reason}")
    return 0


def _links(words: list[str]) -> tuple[dict[str, tuple[Shape, ...]], list[str]]:
    """Return the shapes by robot and link, without repeated meshes, and the unreadable files."""
    urdfs = sorted(
        Path(str(entry.locate()))
        for entry in files("example-robot-data") or []
        if entry.suffix == ".urdf" and (not words or any(word in entry.name for word in words))
    )
    found: dict[str, tuple[Shape, ...]] = {}
    seen: set[str] = set()
    refused = []
    for path in tqdm(urdfs, unit="robot"):
        try:
            robot = read_robot(path)
        except MorphgenError as error:
            refused.append(f"{path.name}: {str(error).removeprefix(str(path))}")
            continue
        for link in robot.links:
            shapes = link.solid_shapes
            if not are_primitives(shapes) and (key := shapes_key(shapes)) not in seen:
                seen.add(key)
                found[f"{path.stem}:{link.name}"] = shapes
    return found, refused


def _measure(named: tuple[str, tuple[Shape, ...]]) -> Row | str:
    name, shapes = named
    try:
        solid = solid_of(shapes)
        one = fit_solid(solid, FitOptions(max_primitives=1))
        start = time.perf_counter()
        several = fit_solid(solid, FitOptions(max_primitives=4))
        seconds = time.perf_counter() - start
    except MorphgenError as error:
        return f"{name}: {error}"
    low, high = solid.mesh.bounds
    probes = np.random.default_rng(0).uniform(low, high, (PROBES, 3))
    filled = float(solid.contains(probes).mean())
    return (
        name,
        solid.method,
        one.quality.iou,
        several.quality.iou,
        len(several.primitives),
        filled,
        filled * float(np.prod(high - low) / solid.hull.volume),
        seconds,
    )


if __name__ == "__main__":
    sys.exit(main())
