"""Rows of tensors, one for each environment; their bits depend on no other environment."""

from __future__ import annotations

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
    return vectors.double().square().sum(dim=1).sqrt().float()


def limit_violation(q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """Return how far joints are outside of their limits, all together, shape (n,), rad and m."""
    return row_sums(torch.clamp(torch.maximum(q - upper, lower - q), min=0))


def padded_rows(
    tables: Sequence[NDArray[np.float64]], width: int, device: torch.device
) -> torch.Tensor:
    """Return tables (S_i, w_i) as one tensor, shape (R, largest S, width), padded with zeros."""
    padded = torch.zeros(len(tables), max(map(len, tables)), width)
    for row, table in zip(padded, tables, strict=True):
        row[: table.shape[0], : table.shape[1]] = torch.from_numpy(table)
    return padded.to(device)
