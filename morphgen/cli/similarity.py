"""``morphgen similarity``: distances and similarities between robots."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby

import numpy as np

from morphgen.cli import options as opt
from morphgen.cli.progress import bar, status, track
from morphgen.encoding.similarity import (
    Features,
    features,
    get_measure,
    similarity_matrix,
    to_distances,
)
from morphgen.encoding.tokens import LAYOUT, default_max_links, tokens_npz
from morphgen.encoding.tokens import tokens as encode
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.files import require_writable_file, write_file
from morphgen.grammar.syntax import parse_derivation
from morphgen.model.robot import Robot
from morphgen.progress import part_of
from morphgen.tables import table
from morphgen.typing import Array

MEASURES = ("cosine", "tree", "workspace", "all")


def similarity(args: argparse.Namespace) -> None:
    """Compare the robots, print the result and draw the map."""
    measures = MEASURES[:-1] if args.measure == "all" else (args.measure,)
    if args.map is not None:  # before the long work
        require_writable_file(args.map, "--map", ".png")
    robots, names, groups = _features(args)
    matrices: dict[str, Array] = {}
    pairs = len(measures) * len(names) * (len(names) + 1) // 2
    with bar(args, "comparing", "pair", pairs):
        for name in measures:
            with part_of(pairs, len(matrices) * pairs // len(measures)):
                matrices[name] = similarity_matrix(robots, name)
    files = [] if args.map is None else [str(args.map)]
    if files:
        from morphgen.benchmark.figures import map_png

        with status(args, "drawing"):
            picture = map_png(names, matrices, groups)
        write_file(args.map, picture)
    results = {
        name: {
            "larger_is_more_alike": get_measure(name).larger_is_more_alike,
            "matrix": matrix.tolist(),
        }
        for name, matrix in matrices.items()
    }
    data = {"robots": names, "measures": results, "files": files}

    def text() -> str:
        tables = "\n\n".join(_text(names, *item) for item in matrices.items())
        return "\n".join([tables, *files])

    opt.print_result(args, data, text)


def _features(args: argparse.Namespace) -> tuple[list[Features], list[str], list[str]]:
    """Return the features of the robots, their names (labels where equal) and groups."""
    pairs, library = opt.read_robots(args), opt.library_of(args)
    if len(pairs) < 2:
        raise BenchmarkError(f"{pairs[0][0].label} is one robot; name others to compare it with")
    max_links = default_max_links(len(robot.links) for _, robot in pairs)
    computed = []
    for source, robot in track(pairs, args, "computing features", "robot", len(pairs)):
        try:
            shapes = token_shapes(robot, library.folders)
            computed.append(features(robot, shapes, max_links=max_links))
        except BenchmarkError as error:
            raise BenchmarkError(f"{source.label}: {error}") from error
    names = [robot.name for _, robot in pairs]
    if len(set(names)) < len(names):
        names = [source.label for source, _ in pairs]
    groups = [_group(robot) for _, robot in pairs] if args.map else []
    return computed, names, groups


def _group(robot: Robot) -> str:
    """Return what robots of one colour have in common: parts and DoF."""
    text = robot.provenance.get("derivation")
    parts = [node.part for node in parse_derivation(str(text)).walk()] if text else []
    runs = [(part, len(list(run))) for part, run in groupby(parts) if part not in ("fixed", "none")]
    words = "-".join(f"{part} x{count}" if count > 1 else part for part, count in runs)
    return f"{words or 'imported'}, {robot.dof} DoF"


def _text(names: Sequence[str], measure: str, values: Array) -> str:
    """Return the table of a measure with its title and statistics."""
    better = "larger" if get_measure(measure).larger_is_more_alike else "smaller"
    rows = _nearest_table(names, measure, values)
    pairs = values[np.triu_indices(len(values), 1)]  # the matrix is symmetric: each pair once
    low, median, high = np.percentile(pairs, (0, 50, 100))
    return (
        f"{get_measure(measure).title}; {better} is more alike\n{rows}\n"
        f"{len(pairs)} pairs: mean {pairs.mean():.3f}, median {median:.3f}, "
        f"from {low:.3f} to {high:.3f}"
    )


def _nearest_table(names: Sequence[str], measure: str, values: Array) -> str:
    distance = to_distances(values, measure)
    np.fill_diagonal(distance, np.inf)  # no robot is its own nearest
    means = (values.sum(axis=1) - values.diagonal()) / (len(names) - 1)  # without the robot itself
    rows = [
        (name, names[nearest], values[i, nearest], means[i])
        for i, (name, nearest) in enumerate(zip(names, distance.argmin(axis=1), strict=True))
    ]
    return table(rows, ("robot", "nearest", measure, "mean of others"), formats=".3f")


def tokens(args: argparse.Namespace) -> None:
    """Print the tokens of a robot, or write them."""
    if args.out:
        require_writable_file(args.out, "--out", ".npz")
    _, robot = opt.read_one_robot(args)
    max_links = args.max_links or default_max_links([len(robot.links)])
    with bar(args, "computing tokens", "link"):
        shapes = token_shapes(robot, opt.library_of(args).folders)
    numbers = encode(robot, shapes, max_links=max_links)
    links = [link.name for link in robot.links]
    data = {
        "name": robot.name,
        "links": links,
        "max_links": max_links,
        "shape": list(numbers.shape),
        "layout": [asdict(field) for field in LAYOUT],
        "tokens": numbers.tolist(),
    }
    lines = [f"{robot.name}: tokens {numbers.shape}", "--json has the numbers and their fields"]
    if args.out:
        write_file(args.out, tokens_npz(numbers, links, robot.name, max_links))
        data["file"] = lines[1] = str(args.out)
    opt.print_result(args, data, lambda: "\n".join(lines))
