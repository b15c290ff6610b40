"""Robots of a split, each made after a recipe that any process can follow."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.similarity import Features, features
from morphgen.benchmark.split import COMPOSED, Member
from morphgen.benchmark.token_layout import MAX_LINKS, require_max_links
from morphgen.checks import check
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.grammar_file import Grammar, grammar_names
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import sample_robot
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map

Progress = Callable[[int], None]


@dataclass(frozen=True)
class SampledRecipe:
    """A robot drawn from a grammar: what ``morphgen sample`` draws as that number of that seed."""

    grammar: Grammar
    number: int
    seed: int
    name: str


@dataclass(frozen=True)
class ComposedRecipe:
    """A robot given by words of ``morphgen compose``."""

    words: tuple[str, ...]
    name: str = ""
    """By default from its parts."""


Recipe = SampledRecipe | ComposedRecipe


@dataclass(frozen=True, eq=False)
class Candidate:
    """A robot that was made."""

    name: str
    category: str
    derivation: Derivation
    hash: str
    """See ``robot_hash``."""
    features: Features | None = None
    """For comparing, if asked for."""


@dataclass(frozen=True)
class RobotFactory:
    """Makes robots."""

    folders: tuple[Path, ...]
    """Of the library."""
    comparable: bool = False
    """Whether their features are wanted."""
    max_links: int = MAX_LINKS
    """The most links that a robot may have."""

    @cached_property
    def library(self) -> Library:
        """Where parts are."""
        return Library(self.folders)

    def __call__(self, recipe: Recipe) -> Candidate:
        """Make a robot.

        Raises:
            BenchmarkError: If a composed one has an error of ``morphgen check``, or a robot more
                links than ``max_links``.
            SamplingError: If none can be drawn.
            MorphgenError: If the recipe names what does not exist or does not fit.
        """
        if isinstance(recipe, SampledRecipe):
            sample = sample_robot(
                recipe.grammar, self.library, recipe.number, seed=recipe.seed, name=recipe.name
            )
            return self._body(sample.robot, sample.derivation, recipe.grammar.name)
        derivation, name = parse_words(recipe.words, self.library)
        robot = compose(derivation, self.library, recipe.name or name)
        for finding in check(robot):
            if finding.severity == "error":
                raise BenchmarkError(
                    f"{' '.join(recipe.words)}: {finding.code} at {finding.where}: {finding.why}"
                )
        return self._body(robot, derivation, category_of(recipe.words, self.library))

    def _body(self, robot: Robot, derivation: Derivation, category: str) -> Candidate:
        # The text keeps 12 digits of a number; what it says is what counts.
        written = parse_derivation(str(derivation))
        if written != derivation:
            robot = compose(written, self.library, robot.name)
        require_max_links(len(robot.links), f"robot {robot.name!r}", self.max_links)
        found = None
        if self.comparable:
            shapes = token_shapes(robot, self.folders)
            found = features(robot, shapes, max_links=self.max_links)
        return Candidate(robot.name, category, written, robot_hash(robot), found)


def make_robots(
    recipes: Sequence[Recipe],
    maker: RobotFactory,
    *,
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> list[Candidate]:
    """Make robots, in order.

    Args:
        recipes: What to make.
        maker: Makes them.
        jobs: Processes.
        progress: Told how many are done, again and again.
    """
    bodies = []
    for body in parallel_map(maker, recipes, jobs):
        bodies.append(body)
        progress(len(bodies))
    return bodies


def category_of(words: Sequence[str], library: Library) -> str:
    """The grammar that words name first, else ``composed``."""
    is_request = "=" in words[0] or (words[0] in library.paths and words[0] not in grammar_names())
    return COMPOSED if is_request else words[0].rpartition("/")[2].removesuffix(".grammar")


def numbered_name(prefix: str, number: int) -> str:
    """The name of a drawn robot, such as ``arm3-000004``."""
    return f"{prefix}-{number:06d}"


def stream_seed(seed: int, prefix: str) -> int:
    """The seed of all robots of one prefix: by name, so that no robot hangs on what else is drawn.

    Args:
        seed: Of the split.
        prefix: Of the robots' names.
    """
    return int(np.random.SeedSequence([seed, *prefix.encode()]).generate_state(1)[0])


def members(
    bodies: Iterable[Candidate], tasks: Sequence[str], obstacles: bool
) -> tuple[Member, ...]:
    """Every robot at every task; with several tasks the name tells which."""
    return tuple(
        Member(
            body.name if len(tasks) == 1 else f"{body.name}-{task}",
            body.category,
            str(body.derivation),
            task,
            obstacles,
            body.hash,
        )
        for body in bodies
        for task in tasks
    )
