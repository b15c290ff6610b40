"""Row-wise tensor functions, a row per environment, whose bits depend on no other row.

``row_norms``, ``choose`` and ``positive_part`` also accept NumPy values of one row without its
axis, so that formulas of tasks serve batches in torch and single environments in NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray


def row_sums(values: torch.Tensor) -> torch.Tensor:
    """Return the sums of rows (n, k), shape (n,).

    They are added in double precision: in single precision the order of a sum, and with it the
    last bit, depends on padding and on the number of rows.
    """
    return values.sum(dim=1, dtype=torch.float64).float()


def row_norms(vectors: torch.Tensor) -> torch.Tensor:
    """Return the Euclidean norms of rows (n, 3), shape (n,); see ``row_sums``."""
    if isinstance(vectors, torch.Tensor):
        return vectors.double().square().sum(dim=1).sqrt().float()
    exact = vectors.astype(np.float64)
    return np.float32(math.sqrt(exact.dot(exact)))


def choose(
    condition: torch.Tensor, value: float, otherwise: torch.Tensor | float = 0.0
) -> torch.Tensor:
    """Return a value in the rows where a condition holds, and other values elsewhere, (n,)."""
    if isinstance(condition, torch.Tensor):
        return torch.where(condition, value, otherwise)
    return value if condition else otherwise


def positive_part(values: torch.Tensor) -> torch.Tensor:
    """Return values (n,), or 0 where they are negative."""
    if isinstance(values, torch.Tensor):
        return torch.clamp(values, min=0)
    return np.maximum(values, np.float32(0))


def limit_violation(q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Return the sum over joints of their distance outside of the limits, shape (n,) [rad, m]."""
    return row_sums(torch.clamp(torch.maximum(q - upper, lower - q), min=0))


def padded_rows(
    tables: Sequence[NDArray[np.float64]], width: int, device: torch.device
) -> torch.Tensor:
    """Stack tables (S_i, w_i) into one tensor, shape (R, largest S, width), padded with zeros."""
    padded = torch.zeros(len(tables), max(map(len, tables)), width)
    for row, table in zip(padded, tables, strict=True):
        row[: table.shape[0], : table.shape[1]] = torch.from_numpy(table)
    return padded.to(device)
