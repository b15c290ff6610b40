"""Generate interpolation splits: test robots have the structure of train robots at other sizes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morphgen.benchmark.generate import (
    RobotStream,
    SplitRequest,
    TestRobotSearch,
    assemble_drawn,
    require_size,
)
from morphgen.benchmark.near_duplicates import NearReason
from morphgen.benchmark.regimes import HULLS, ON_HULL, hull_distance, parameters, structure
from morphgen.benchmark.robot_factory import Candidate, Progress, RobotFactory, make_robots
from morphgen.benchmark.split import Split
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library


def interpolation(
    request: SplitRequest,
    grammar: Grammar,
    library: Library,
    *,
    hull: str = "any",
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Return splits whose test robots have the structure of a train robot.

    Train robots are numbers 0, 1, ... of the grammar with one seed; test robots are sampled with
    another seed.

    Args:
        request: Sizes, tasks and seed.
        grammar: Grammar of all robots.
        library: The library of parts.
        hull: ``inside``, ``outside`` or ``any``: position of the parameters of test robots relative
            to the convex hull of the train robots of their structure. With several sizes it is
            the hull of the smallest split for ``inside``, of the largest one for ``outside``.
        jobs: Number of processes.
        progress: Receives the number of robots that are finished.

    Returns:
        A split for each size.

    Raises:
        BenchmarkError: If ``MAX_DRAWS`` draws give too few test robots.
        SamplingError: If the grammar gives no valid robot.
    """
    require_size(request)
    if hull not in HULLS:
        raise BenchmarkError(f"--hull {hull}: unknown{nearest(hull, HULLS)}")
    train_stream = RobotStream.of(grammar, grammar.name, request)
    test_stream = RobotStream.of(grammar, f"{grammar.name}-test", request)
    factory = RobotFactory(library.folders, with_features=True, max_links=request.max_links)
    recipes = [train_stream.recipe(i) for i in range(request.train[-1])]
    train = make_robots(recipes, factory, jobs=jobs, progress=progress)
    criterion = StructureAndHull(train, request.train[0], hull, library)
    search = TestRobotSearch(request, train, factory, progress)
    if not search.find([test_stream], criterion, NearReason(train)):
        raise BenchmarkError(f"{grammar.name}: {search.failure()}; {criterion.advice()}")
    where = {"inside": "within their hull", "outside": "outside their hull", "any": "besides"}
    return assemble_drawn(
        request,
        "interpolation",
        f"{{n}} robots of {grammar.name}; test: {request.test} {where[hull]}",
        train,
        search.robots,
        {
            "grammar": {grammar.name: grammar.digest},
            "hull": hull,
            "seeds": {stream.prefix: stream.seed for stream in (train_stream, test_stream)},
        },
    )


class StructureAndHull:
    """Reject derivations of another structure, or on the wrong side of the convex hull."""

    def __init__(
        self, train: Sequence[Candidate], smallest: int, hull: str, library: Library
    ) -> None:
        self._hull, self._library = hull, library
        self._structures = {structure(robot.derivation, library) for robot in train[:smallest]}
        self._points: dict[str, list[list[float]]] = {}
        # A point inside the smallest hull is inside all; one outside the largest is outside all.
        for robot in train[:smallest] if hull == "inside" else train:
            points = self._points.setdefault(structure(robot.derivation, library), [])
            points.append(self._point(robot.derivation))

    def __call__(self, derivation: Derivation) -> str:
        """Return the reason why a derivation is rejected; empty if it is accepted."""
        kind = structure(derivation, self._library)
        if kind not in self._structures:
            return "a structure that no train robot has"
        if self._hull == "any":
            return ""
        is_inside = hull_distance(self._point(derivation), self._points[kind]) <= ON_HULL
        if is_inside == (self._hull == "inside"):
            return ""
        return f"parameters {'inside' if is_inside else 'outside'} the hull of the train robots"

    def _point(self, derivation: Derivation) -> list[float]:
        return list(parameters(derivation, self._library).values())

    def advice(self) -> str:
        """Return what to change if a search finds too few robots."""
        if self._hull == "any":
            return "ask for fewer test robots, or more train robots"
        spans = [np.ptp(np.array(points), axis=0) for points in self._points.values()]
        varied = max(int((span > 0).sum()) for span in spans)
        size = min(len(points) for points in self._points.values())
        other = "more" if self._hull == "inside" else "fewer"
        return (
            f"{varied} parameters vary, and the smallest hull is that of {size} robots: ask for "
            f"{other} train robots, or for --hull any"
        )
