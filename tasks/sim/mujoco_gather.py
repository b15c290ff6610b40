"""Arrays of many environments, copied into one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morphgen.typing import Array


class Gathered:
    """Arrays of one axis, one after the other; the last element is a zero, for padding.

    One call copies them all, where a call for every environment would cost as much as a tenth
    of its physics.
    """

    def __init__(self, arrays: Sequence[Array]) -> None:
        """Copy nothing yet.

        Args:
            arrays: What to copy at every ``read``; kept, not copied, until then.
        """
        self._arrays = [*arrays, np.zeros(1)]
        ends = np.cumsum([len(array) for array in self._arrays])
        self.begin = np.concatenate([[0], ends[:-1]])
        self.flat = np.zeros(ends[-1])

    def read(self) -> None:
        """Bring ``flat`` up to date."""
        np.concatenate(self._arrays, out=self.flat)
