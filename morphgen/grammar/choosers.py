"""Choosers make the choices that a grammar leaves open: first, random, or recorded ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from morphgen.errors import GrammarError
from morphgen.formats.rounding import format_number
from morphgen.grammar.values import Distribution, typical_value

Choices = Mapping[str, float]
"""Choices of a derivation by their keys: an alternative's index, a count or a value in SI units."""


class Chooser(Protocol):
    """Makes the choices that a grammar leaves open; the key names the choice."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """Return the index of an alternative."""

    def count(self, key: str, low: int, high: int) -> int:
        """Return a number of repetitions from ``low`` to ``high``."""

    def value(self, key: str, distribution: Distribution) -> float:
        """Return a value of a distribution."""


class FirstChooser:
    """Chooses the first alternative, the smallest count and the typical value."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """Return the first index with a positive weight."""
        return next(i for i, weight in enumerate(weights) if weight > 0)

    def count(self, key: str, low: int, high: int) -> int:
        """Return the smallest count."""
        return low

    def value(self, key: str, distribution: Distribution) -> float:
        """Return the typical value."""
        return typical_value(key, distribution)


class RandomChooser:
    """Draws every choice from a random generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def alternative(self, key: str, weights: list[float]) -> int:
        """Draw an index with probabilities proportional to the weights."""
        total = np.cumsum(weights)
        index = int(np.searchsorted(total, self._rng.random() * total[-1], side="right"))
        # The product may round up to the total, which is beyond the last positive weight.
        return min(index, int(np.flatnonzero(weights)[-1]))

    def count(self, key: str, low: int, high: int) -> int:
        """Draw a count uniformly."""
        return int(self._rng.integers(low, high + 1))

    def value(self, key: str, distribution: Distribution) -> float:
        """Draw a value from the distribution."""
        return distribution.draw(self._rng.random, self._rng.standard_normal)


@dataclass
class RecordedChooser:
    """Repeats recorded choices where they are valid, and records all choices made."""

    fallback: Chooser
    """Makes the choices that are not recorded or not valid."""
    recorded: Choices = field(default_factory=dict)
    """Choices to repeat."""
    choices: dict[str, float] = field(default_factory=dict)
    """All choices made so far."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """Return the recorded index if it exists."""
        index = self.recorded.get(key)
        if index is None or index not in range(len(weights)):
            index = self.fallback.alternative(key, weights)
        return int(self._record(key, index))

    def count(self, key: str, low: int, high: int) -> int:
        """Return the recorded count if it is in range."""
        count = self.recorded.get(key)
        if count is None or count not in range(low, high + 1):
            count = self.fallback.count(key, low, high)
        return int(self._record(key, count))

    def value(self, key: str, distribution: Distribution) -> float:
        """Return the recorded value if the distribution contains it."""
        value = distribution.closest(self.recorded[key]) if key in self.recorded else None
        if value is None:
            value = self.fallback.value(key, distribution)
        return self._record(key, float(format_number(value)))

    def _record(self, key: str, value: float) -> float:
        if key in self.choices:
            raise GrammarError(f"two choices share the key {key!r}")
        self.choices[key] = value
        return value
