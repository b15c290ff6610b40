"""Results of slow work that the pages of all browsers share."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar, cast

T = TypeVar("T")

MAX_RESULTS = 24
"""Number of results that are kept; a population of 1,000 robots takes tens of megabytes."""


class SharedResults:
    """The results that were used last, by their keys; safe to use from several threads."""

    def __init__(self, max_results: int = MAX_RESULTS) -> None:
        self._max = max_results
        self._results: OrderedDict[str, object] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: str, make: Callable[[], T]) -> T:
        """Return the result of a key.

        Args:
            key: Names the work and its input.
            make: Computes the result if it is not kept. Two threads may both compute it.
        """
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                return cast(T, self._results[key])
        result = make()
        with self._lock:
            self._results[key] = result
            while len(self._results) > self._max:
                self._results.popitem(last=False)
        return result
