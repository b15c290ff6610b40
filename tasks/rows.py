"""Row-wise tensor functions, a row per environment, whose bits depend on no other row."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.tasks.task import GoalSet


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
    """Return the sum over joints of their distance outside of the limits, shape (n,) [rad, m]."""
    return row_sums(torch.clamp(torch.maximum(q - upper, lower - q), min=0))


def goal_choices(goals: GoalSet) -> dict[int | None, NDArray[np.int64]]:
    """Return the indices of the goals that each layout of the obstacles leaves possible.

    The key None, for environments without obstacles, has all goals.
    """
    choices: dict[int | None, NDArray[np.int64]] = {None: np.arange(len(goals.q))}
    return choices | {k: np.flatnonzero(row) for k, row in enumerate(goals.usable)}


def padded_rows(
    tables: Sequence[NDArray[np.float64]], width: int, device: torch.device
) -> torch.Tensor:
    """Stack tables (S_i, w_i) into one tensor, shape (R, largest S, width), padded with zeros."""
    padded = torch.zeros(len(tables), max(map(len, tables)), width)
    for row, table in zip(padded, tables, strict=True):
        row[: table.shape[0], : table.shape[1]] = torch.from_numpy(table)
    return padded.to(device)
