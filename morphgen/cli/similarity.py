"""``morphgen similarity``: how alike robots are."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    Subparsers,
    add_json,
    add_library,
    add_max_links,
    add_root,
    library_of,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from morphgen.benchmark.similarity import Features
    from morphgen.grammar.library import Library
    from morphgen.model.robot import Robot

    Matrices = dict[str, NDArray[np.float64]]

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
    parser.add_argument(
        "paths",
        nargs="+",
        type=Path,
        metavar="PATH",
        help="bundles' folders, URDFs, xacros, sets of morphgen sample, or folders of bundles",
    )
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
    add_max_links(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compare, print, draw, write."""
    from morphgen.benchmark.similarity import measure_named
    from morphgen.errors import BenchmarkError

    measures = MEASURES[:-1] if args.measure == "all" else (args.measure,)
    _require_writable(args)
    library = library_of(args)
    places = list(dict.fromkeys(p for path in args.paths for p in _places(path)))
    if len(places) < 2:
        raise BenchmarkError(f"{places[0]} is one robot; name others to compare it with")
    robots = _features(places, library, args)
    names = _names(robots, places)
    matrices = _matrices(robots, measures, quiet=args.json)
    written = _write(args, names, matrices)
    if args.json:
        found = {
            name: {
                "larger_is_more_alike": measure_named(name).larger_is_more_alike,
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


def _places(path: Path) -> Iterator[Path]:
    """The robots that a path means: itself, or those of a set or folder."""
    from morphgen.errors import FormatError
    from morphgen.grammar.robot_set import INDEX, SETTINGS, read_index

    if not path.exists():
        raise FormatError(f"{path}: no such file or folder")
    if path.is_file() or _is_robot(path):
        yield path
    elif (path / INDEX).is_file() or (path / SETTINGS).is_file():
        yield from (path / record["name"] for record in read_index(path))
    else:
        found = sorted(folder for folder in path.iterdir() if _is_robot(folder))
        if not found:
            raise FormatError(
                f"{path} holds no robot; name a bundle, a URDF, a set of morphgen sample, or a "
                "folder of bundles"
            )
        yield from found


def _is_robot(folder: Path) -> bool:
    from morphgen.formats.bundle import CARD
    from morphgen.grammar.robot_set import DERIVATION

    return (folder / CARD).is_file() or (folder / DERIVATION).is_file()


def _read(path: Path, library: Library, root: Path | None) -> Robot:
    """A robot; one of a light set from its derivation, because its URDF knows no home."""
    from morphgen.formats.bundle import CARD, read_robot
    from morphgen.formats.data_files import read_text
    from morphgen.grammar.compose import compose
    from morphgen.grammar.derivation import parse_derivation
    from morphgen.grammar.limits import MAX_DERIVATION_TEXT
    from morphgen.grammar.robot_set import DERIVATION

    light = path / DERIVATION
    if not light.is_file() or (path / CARD).is_file():
        return read_robot(path, root=root)
    derivation = parse_derivation(read_text(light, MAX_DERIVATION_TEXT), str(light))
    return compose(derivation, library, path.resolve().name)


def _features(places: Sequence[Path], library: Library, args: argparse.Namespace) -> list[Features]:
    from tqdm import tqdm

    from morphgen.benchmark.similarity import features
    from morphgen.benchmark.token_layout import MAX_LINKS
    from morphgen.errors import BenchmarkError
    from morphgen.fitting.token_shapes import token_shapes

    made = []
    max_links = MAX_LINKS if args.max_links is None else args.max_links
    bar = tqdm(places, unit="robot", file=sys.stderr, disable=args.json or None, leave=False)
    for path in bar:
        robot = _read(path, library, args.root)
        try:
            shapes = token_shapes(robot, library.folders)
            made.append(features(robot, shapes, max_links=max_links))
        except BenchmarkError as error:
            raise BenchmarkError(f"{path}: {error}") from error
    return made


def _names(robots: Sequence[Features], places: Sequence[Path]) -> list[str]:
    """The robots' names; their paths if two have the same."""
    names = [robot.name for robot in robots]
    return names if len(set(names)) == len(names) else [str(path) for path in places]


def _matrices(robots: Sequence[Features], measures: Sequence[str], *, quiet: bool) -> Matrices:
    from tqdm import tqdm

    from morphgen.benchmark.similarity import matrix

    pairs = len(measures) * len(robots) * (len(robots) + 1) // 2
    hidden = quiet or None
    with tqdm(total=pairs, unit="pair", file=sys.stderr, disable=hidden, leave=False) as bar:

        def show(done: int) -> None:
            bar.update(done)

        return {name: matrix(robots, name, show) for name in measures}


def _text(names: Sequence[str], measure: str, matrices: Matrices) -> str:
    """What is printed of a measure."""
    from morphgen.benchmark.similarity import measure_named

    about = measure_named(measure)
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

    from morphgen.benchmark.similarity import distances

    values = matrices[measure]
    apart = distances(values, measure)
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
    from morphgen.formats.files import save

    made = {
        path: content(names, matrices)
        for path, content in ((args.heatmap, _heatmap), (args.map, _map), (args.csv, _csv))
        if path is not None
    }
    for path, data in made.items():
        save(path, data)
    return [str(path) for path in made]


def _heatmap(names: Sequence[str], matrices: Matrices) -> bytes:
    from morphgen.benchmark.figures import Panel, heatmap_png
    from morphgen.benchmark.similarity import measure_named

    panels = [
        Panel(_title(name), values, measure_named(name).larger_is_more_alike)
        for name, values in matrices.items()
    ]
    return heatmap_png(names, panels)


def _map(names: Sequence[str], matrices: Matrices) -> bytes:
    from morphgen.benchmark.figures import MapPanel, map_png
    from morphgen.benchmark.scaling_map import scaling_map
    from morphgen.benchmark.similarity import distances

    panels = [
        MapPanel(_title(name), scaling_map(distances(values, name)))
        for name, values in matrices.items()
    ]
    return map_png(names, panels)


def _title(measure: str) -> str:
    from morphgen.benchmark.similarity import measure_named

    return f"{measure}: {measure_named(measure).meaning}"


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
