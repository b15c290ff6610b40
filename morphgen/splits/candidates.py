"""Candidates for the members of splits: robots from recipes, checked, hashed and with features."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from morphgen.checks import check
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.similarity import Features, features
from morphgen.encoding.tokens import MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.compose import compose, join
from morphgen.grammar.grammar_file import Grammar, grammar_names
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import sample_robot
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.robot import Robot
from morphgen.splits.split import COMPOSED, Member


@dataclass(frozen=True)
class SampledRecipe:
    """A robot sampled from a grammar: robot ``number`` of ``morphgen sample --seed``."""

    grammar: Grammar
    number: int
    seed: int
    name: str

    @property
    def category(self) -> str:
        """Name of the grammar."""
        return self.grammar.name


@dataclass(frozen=True)
class DerivedRecipe:
    """A robot given by its derivation."""

    derivation: Derivation
    name: str
    category: str = COMPOSED


Recipe = SampledRecipe | DerivedRecipe


def recipe_of(words: Sequence[str], library: Library, name: str = "") -> DerivedRecipe:
    """Return the recipe for the arguments of ``morphgen compose``, which also give a name."""
    derivation, default_name = parse_words(words, library)
    # The category is the grammar that the arguments begin with, if they are no parts.
    is_request = "=" in words[0] or (words[0] in library.paths and words[0] not in grammar_names())
    category = COMPOSED if is_request else words[0].rpartition("/")[2].removesuffix(".grammar")
    return DerivedRecipe(derivation, name or default_name, category)


class UnfitRobotError(BenchmarkError):
    """A robot can be composed, but cannot be a member of a split."""

    def __init__(self, message: str, reason: str) -> None:
        """Create the error from its message and a reason that is the same for similar robots."""
        super().__init__(message, reason)
        self.reason = reason

    def __str__(self) -> str:
        """Return the message."""
        return str(self.args[0])


@dataclass(frozen=True, eq=False)
class Candidate:
    """A robot that may become a member of a split."""

    name: str
    category: str
    derivation: Derivation
    hash: str  # hash of the robot, see `robot_hash`
    features: Features | None = None
    """Features for similarity measures; None if the factory does not compute them."""

    def member(self, task: str, tasks: Sequence[str], obstacles: bool) -> Member:
        """Return the member of a split with these tasks; of several, its name ends in its own."""
        return Member(
            self.name if len(tasks) == 1 else f"{self.name}-{task}",
            self.category,
            str(self.derivation),
            task,
            obstacles,
            self.hash,
        )


@dataclass(frozen=True)
class RobotFactory:
    """Make candidates from recipes; can be pickled and sent to a worker process."""

    library: Library
    with_features: bool = False  # compute the features of each robot
    max_links: int = MAX_LINKS  # largest number of links of a robot

    def __call__(self, recipe: Recipe) -> Candidate:
        """Make a robot."""
        if isinstance(recipe, SampledRecipe):
            sample = sample_robot(
                recipe.grammar, self.library, recipe.number, seed=recipe.seed, name=recipe.name
            )
            return self._candidate(sample.robot, sample.derivation, recipe.category)
        # Joining parts is fast, and the search for contacts of a composed robot is not.
        self._require_links(join(recipe.derivation, self.library, recipe.name))
        robot = compose(recipe.derivation, self.library, recipe.name)
        for finding in check(robot):
            if finding.severity == "error":
                text = f"{recipe.name}: {finding.code} at {finding.where}: {finding.why}"
                raise UnfitRobotError(text, f"an error of morphgen check: {finding.code}")
        return self._candidate(robot, recipe.derivation, recipe.category)

    def _require_links(self, robot: Robot) -> None:
        try:
            require_max_links(len(robot.links), f"robot {robot.name!r}", self.max_links)
        except BenchmarkError as error:
            raise UnfitRobotError(str(error), f"more than {self.max_links} links") from error

    def _candidate(self, robot: Robot, derivation: Derivation, category: str) -> Candidate:
        # The text of a derivation has 12 digits per number. A split stores the text, so the robot
        # must be the one that the text gives.
        written = parse_derivation(str(derivation))
        if written != derivation:
            robot = compose(written, self.library, robot.name)
        self._require_links(robot)
        robot_features = None
        if self.with_features:
            shapes = token_shapes(robot, self.library.folders)
            robot_features = features(robot, shapes, max_links=self.max_links)
        return Candidate(robot.name, category, written, robot_hash(robot), robot_features)


def numbered_name(prefix: str, number: int) -> str:
    """Return the name of a sampled robot, such as ``arm3-000004``."""
    return f"{prefix}-{number:06d}"
