"""New splits by interpolation: test robots are train robots of other sizes."""

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
from morphgen.benchmark.regimes import HULLS, ON_HULL, hull_distance, parameters, structure
from morphgen.benchmark.robot_factory import Candidate, Progress, RobotFactory, make_robots
from morphgen.benchmark.split import Split
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library


def interpolation(
    order: SplitRequest,
    grammar: Grammar,
    library: Library,
    *,
    hull: str = "any",
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Splits whose test robots have the structure of a train robot.

    Train robots are numbers 0, 1, ... of the grammar and a seed of their own; test robots are those
    of another seed that qualify.

    Args:
        order: Sizes, tasks, seed.
        grammar: Where all robots come from.
        library: Where parts are.
        hull: Whether the parameters of test robots lie ``inside`` the convex hull of those of the
            train robots of their structure, ``outside``, or ``any`` where. Of several sizes,
            inside the smallest one's and outside the largest one's.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Returns:
        A split for every size.

    Raises:
        BenchmarkError: If too few test robots are found in ``MAX_DRAWS`` draws.
        SamplingError: If a robot cannot be drawn.
    """
    require_size(order)
    if hull not in HULLS:
        raise BenchmarkError(f"--hull {hull}: unknown{nearest(hull, HULLS)}")
    trained = RobotStream.of(grammar, grammar.name, order)
    tested = RobotStream.of(grammar, f"{grammar.name}-test", order)
    maker = RobotFactory(library.folders, max_links=order.max_links)
    recipes = [trained.recipe(i) for i in range(order.train[-1])]
    train = make_robots(recipes, maker, jobs=jobs, progress=progress)
    wanted = _Wanted(train, order.train[0], hull, library)
    search = TestRobotSearch(order, train, maker, progress)
    if not search.find([tested], wanted):
        raise BenchmarkError(f"{grammar.name}: {search.failure()}; {wanted.advice()}")
    where = {"inside": "within their hull", "outside": "outside their hull", "any": "besides"}
    return assemble_drawn(
        order,
        "interpolation",
        f"{{n}} robots of {grammar.name}; test: {order.test} {where[hull]}",
        train,
        search.found,
        {
            "grammar": {grammar.name: grammar.digest},
            "hull": hull,
            "seeds": {stream.prefix: stream.seed for stream in (trained, tested)},
        },
    )


class _Wanted:
    """Whether a derivation has the structure of a train robot, and lies where it shall."""

    def __init__(
        self, train: Sequence[Candidate], smallest: int, hull: str, library: Library
    ) -> None:
        self._hull, self._library = hull, library
        self._structures = {structure(body.derivation, library) for body in train[:smallest]}
        self._points: dict[str, list[list[float]]] = {}
        # What is inside the smallest hull is inside all; what is outside the largest likewise.
        for body in train[:smallest] if hull == "inside" else train:
            points = self._points.setdefault(structure(body.derivation, library), [])
            points.append(self._point(body.derivation))

    def __call__(self, derivation: Derivation) -> str:
        """What a derivation has that it shall not; nothing if it is as wanted."""
        own = structure(derivation, self._library)
        if own not in self._structures:
            return "a structure that no train robot has"
        if self._hull == "any":
            return ""
        is_inside = hull_distance(self._point(derivation), self._points[own]) <= ON_HULL
        if is_inside == (self._hull == "inside"):
            return ""
        return f"parameters {'inside' if is_inside else 'outside'} the hull of the train robots"

    def _point(self, derivation: Derivation) -> list[float]:
        return list(parameters(derivation, self._library).values())

    def advice(self) -> str:
        """What to change where too few are found."""
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
