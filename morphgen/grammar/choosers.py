"""Ways to decide what a grammar leaves open: the first choice, a random one, or a recorded one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from morphgen.errors import GrammarError
from morphgen.formats.rounding import format_number
from morphgen.grammar.values import Distribution, no_draw

Choices = Mapping[str, float]
"""What was decided, by the place in the derivation: index, count or value."""


class Chooser(Protocol):
    """Decides what a grammar leaves open."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """Index of an alternative."""

    def count(self, key: str, low: int, high: int) -> int:
        """Number of repetitions."""

    def value(self, key: str, distribution: Distribution) -> float:
        """Value of a distribution."""


class FirstChooser:
    """Takes the first alternative, the smallest count and the typical value."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """The first with a positive weight."""
        return next(i for i, weight in enumerate(weights) if weight > 0)

    def count(self, key: str, low: int, high: int) -> int:
        """The smallest."""
        return low

    def value(self, key: str, distribution: Distribution) -> float:
        """The typical one."""
        return no_draw(key, distribution)


class RandomChooser:
    """Draws from a generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def alternative(self, key: str, weights: list[float]) -> int:
        """In proportion to the weights."""
        total = np.cumsum(weights)
        drawn = int(np.searchsorted(total, self._rng.random() * total[-1], side="right"))
        return min(drawn, int(np.flatnonzero(weights)[-1]))  # the product may round up to total

    def count(self, key: str, low: int, high: int) -> int:
        """Uniformly."""
        return int(self._rng.integers(low, high + 1))

    def value(self, key: str, distribution: Distribution) -> float:
        """As the distribution says."""
        return distribution.draw(self._rng.random, self._rng.standard_normal)


@dataclass
class RecordedChooser:
    """Takes given choices where they fit, others from another chooser, and notes all."""

    other: Chooser
    given: Choices = field(default_factory=dict)
    choices: dict[str, float] = field(default_factory=dict)

    def alternative(self, key: str, weights: list[float]) -> int:
        """The given index if there is such an alternative."""
        given = self.given.get(key)
        if given is None or given not in range(len(weights)):
            given = self.other.alternative(key, weights)
        return int(self._note(key, given))

    def count(self, key: str, low: int, high: int) -> int:
        """The given count if it is in range."""
        given = self.given.get(key)
        if given is None or given not in range(low, high + 1):
            given = self.other.count(key, low, high)
        return int(self._note(key, given))

    def value(self, key: str, distribution: Distribution) -> float:
        """The given value if the distribution can give it."""
        given = distribution.nearest(self.given[key]) if key in self.given else None
        if given is None:
            given = self.other.value(key, distribution)
        return self._note(key, float(format_number(given)))

    def _note(self, key: str, value: float) -> float:
        if key in self.choices:
            raise GrammarError(f"two choices share the key {key!r}")
        self.choices[key] = value
        return value
