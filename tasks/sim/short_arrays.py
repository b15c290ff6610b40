"""Functions on arrays of few numbers, on which most calls of NumPy take longer than their work."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.typing import Array

if TYPE_CHECKING:  # processes of PyBullet need no torch
    import torch


def clamp(values: Array, bound: Array) -> Array:
    """Return values within +-bound: ``np.clip`` at a quarter of its overhead."""
    return np.minimum(np.maximum(values, -bound), bound)


def is_within(values: NDArray[Any], bound: float) -> bool:
    """Return whether all magnitudes are at most a bound; NaN is not."""
    flat = values.ravel()
    # They are if the root of the sum of their squares is, which is fast to test.
    return float(flat.dot(flat)) <= bound**2 or bool(np.abs(flat).max(initial=0.0) <= bound)


def all_finite(values: NDArray[Any]) -> bool:
    """Return whether all values are finite."""
    flat = values.ravel()
    # They are if the sum of their squares is; it may also overflow.
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())


def consecutive(indices: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """Return indices as a slice if they are consecutive: they select the same, in less time."""
    first = int(indices[0]) if len(indices) else 0
    is_slice = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if is_slice else indices


def mask_of(rows: Iterable[int], count: int) -> NDArray[np.bool_]:
    """Return a mask of ``count`` rows that is set in some of them."""
    mask = np.zeros(count, bool)
    mask[list(rows)] = True
    return mask


class TensorView:
    """View of a tensor as an array, which is kept while the same tensor is passed."""

    def __init__(self) -> None:
        self._tensor: torch.Tensor | None = None
        self._view: NDArray[Any] = np.zeros(0)

    def __call__(self, tensor: torch.Tensor) -> NDArray[Any]:
        """Return the view."""
        if tensor is not self._tensor:
            self._tensor, self._view = tensor, tensor.numpy()
        return self._view
