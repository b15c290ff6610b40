"""``morphgen similarity``: how alike robots are."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from morphgen.cli.options import (
    Subparsers,
    add_json,
    add_library,
    add_max_links,
    add_robots,
    add_root,
    library_of,
    max_links_for,
    sources_named,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from morphgen.benchmark.similarity import Features
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource

    Matrices = dict[str, NDArray[np.float64]]

T = TypeVar("T")

MEASURES = ("cosine", "tree", "workspace", "all")
WHOLE = 20
"""The most robots whose matrix is printed."""


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "similarity",
        help="compare robots: tokens, kinematic trees, workspaces",
        description="Compare robots with each other. Up to 20 the matrix is printed, beyond that "
        "each robot's nearest one.",
        epilog="examples: morphgen similarity robots/ur5-plane robots/panda-stick; "
        "morphgen similarity robots/arm3 --measure all --heatmap arm3.png",
    )
    add_robots(parser)
    parser.add_argument(
        "--measure",
        choices=MEASURES,
        default="tree",
        help="default: tree",
    )
    parser.add_argument("--heatmap", metavar="FILE.png", type=Path, help="draw the matrix")
    parser.add_argument(
        "--map", metavar="FILE.png", type=Path, help="draw the robots by their distances"
    )
    parser.add_argument("--csv", metavar="FILE", type=Path, help="write a line a pair")
    add_root(parser)
    add_max_links(parser, "23, or as many as the largest robot has")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare, print, draw, write."""
    from morphgen.benchmark.similarity import get_measure
    from morphgen.errors import BenchmarkError

    measures = MEASURES[:-1] if args.measure == "all" else (args.measure,)
    _require_writable(args)
    library = library_of(args)
    sources = sources_named(args)
    if len(sources) < 2:
        raise BenchmarkError(f"{sources[0].label} is one robot; name others to compare it with")
    robots = _features(sources, library, args)
    names = _names(robots, sources)
    matrices = _matrices(robots, measures, quiet=args.json)
    written = _write(args, names, matrices)
    if args.json:
        found = {
            name: {
                "larger_is_more_alike": get_measure(name).larger_is_more_alike,
                "matrix": matrices[name].tolist(),
            }
            for name in measures
        }
        print(json.dumps({"robots": names, "measures": found, "files": written}))
        return 0
    print("\n\n".join(_text(names, name, matrices) for name in measures))
    for file in written:
        print(file)
    return 0


def _require_writable(args: argparse.Namespace) -> None:
    """Refuse before the long work what could not be written after it."""
    from morphgen.errors import BenchmarkError

    for option, path in (("--heatmap", args.heatmap), ("--map", args.map), ("--csv", args.csv)):
        if path is None:
            continue
        if option != "--csv" and path.suffix.lower() != ".png":
            raise BenchmarkError(f"{option} {path}: expected a name that ends in .png")
        if path.is_dir() or not path.parent.is_dir():
            why = "it is a folder" if path.is_dir() else f"there is no folder {path.parent}"
            raise BenchmarkError(f"{option} {path}: {why}")


def _features(
    sources: Sequence[RobotSource], library: Library, args: argparse.Namespace
) -> list[Features]:
    from tqdm import tqdm

    from morphgen.benchmark.similarity import features
    from morphgen.errors import BenchmarkError
    from morphgen.fitting.token_shapes import token_shapes
    from morphgen.grammar.robot_source import read_source

    def bar(things: Sequence[T]) -> Iterable[T]:
        return tqdm(things, unit="robot", file=sys.stderr, disable=args.json or None, leave=False)

    robots = [read_source(source, library, args.root) for source in bar(sources)]
    max_links = max_links_for(args, robots)
    made = []
    for source, robot in bar(list(zip(sources, robots, strict=True))):
        try:
            shapes = token_shapes(robot, library.folders)
            made.append(features(robot, shapes, max_links=max_links))
        except BenchmarkError as error:
            raise BenchmarkError(f"{source.label}: {error}") from error
    return made


def _names(robots: Sequence[Features], sources: Sequence[RobotSource]) -> list[str]:
    """Return the robots' names, or how the user named them if two names are the same."""
    names = [robot.name for robot in robots]
    return names if len(set(names)) == len(names) else [source.label for source in sources]


def _matrices(robots: Sequence[Features], measures: Sequence[str], *, quiet: bool) -> Matrices:
    from tqdm import tqdm

    from morphgen.benchmark.similarity import similarity_matrix

    pairs = len(measures) * len(robots) * (len(robots) + 1) // 2
    hidden = quiet or None
    with tqdm(total=pairs, unit="pair", file=sys.stderr, disable=hidden, leave=False) as bar:

        def show(done: int) -> None:
            bar.update(done)

        return {name: similarity_matrix(robots, name, show) for name in measures}


def _text(names: Sequence[str], measure: str, matrices: Matrices) -> str:
    """What is printed of a measure."""
    from morphgen.benchmark.similarity import get_measure

    about = get_measure(measure)
    better = "larger" if about.larger_is_more_alike else "smaller"
    title = f"{_title(measure)}; {better} is more alike"
    table = _whole if len(names) <= WHOLE else _nearest
    return f"{title}\n{table(names, measure, matrices)}\n{_statistics(measure, matrices)}"


def _whole(names: Sequence[str], measure: str, matrices: Matrices) -> str:
    from tabulate import tabulate

    rows = [
        (i, name, *row) for i, (name, row) in enumerate(zip(names, matrices[measure], strict=True))
    ]
    return tabulate(rows, ("#", "robot", *map(str, range(len(names)))), floatfmt=".3f")


def _nearest(names: Sequence[str], measure: str, matrices: Matrices) -> str:
    import numpy as np
    from tabulate import tabulate

    from morphgen.benchmark.similarity import to_distances

    values = matrices[measure]
    apart = to_distances(values, measure)
    np.fill_diagonal(apart, np.inf)
    others = (values.sum(axis=1) - values.diagonal()) / (len(names) - 1)
    rows = [
        (name, names[near], values[i, near], others[i])
        for i, (name, near) in enumerate(zip(names, apart.argmin(axis=1), strict=True))
    ]
    return tabulate(rows, ("robot", "nearest", measure, "mean of others"), floatfmt=".3f")


def _statistics(measure: str, matrices: Matrices) -> str:
    import numpy as np

    pairs = matrices[measure][np.triu_indices(len(matrices[measure]), 1)]
    low, middle, high = np.percentile(pairs, (0, 50, 100))
    return (
        f"{len(pairs)} pairs: mean {pairs.mean():.3f}, median {middle:.3f}, "
        f"from {low:.3f} to {high:.3f}"
    )


def _write(args: argparse.Namespace, names: Sequence[str], matrices: Matrices) -> list[str]:
    """Write what was asked for; return where."""
    from morphgen.formats.files import write_file

    made = {
        path: content(names, matrices)
        for path, content in ((args.heatmap, _heatmap), (args.map, _map), (args.csv, _csv))
        if path is not None
    }
    for path, data in made.items():
        write_file(path, data)
    return [str(path) for path in made]


def _heatmap(names: Sequence[str], matrices: Matrices) -> bytes:
    from morphgen.benchmark.figures import Panel, heatmap_png
    from morphgen.benchmark.similarity import get_measure

    panels = [
        Panel(_title(name), values, get_measure(name).larger_is_more_alike)
        for name, values in matrices.items()
    ]
    return heatmap_png(names, panels)


def _map(names: Sequence[str], matrices: Matrices) -> bytes:
    from morphgen.benchmark.figures import MapPanel, map_png
    from morphgen.benchmark.similarity import classical_mds, to_distances

    panels = [
        MapPanel(_title(name), classical_mds(to_distances(values, name)))
        for name, values in matrices.items()
    ]
    return map_png(names, panels)


def _title(measure: str) -> str:
    from morphgen.benchmark.similarity import get_measure

    return f"{measure}: {get_measure(measure).meaning}"


def _csv(names: Sequence[str], matrices: Matrices) -> bytes:
    """A line a pair: the two names, and every measure of them."""
    import csv
    import io

    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(("robot", "other", *matrices))
    for i, robot in enumerate(names):
        for j in range(i + 1, len(names)):
            lines.writerow((robot, names[j], *(repr(float(m[i, j])) for m in matrices.values())))
    return text.getvalue().encode()
