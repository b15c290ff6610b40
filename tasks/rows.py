"""Tensors with a row per environment: functions of rows, and tables that rows are drawn from.

The bits of a row depend on no other row.
``row_norms``, ``choose`` and ``positive_part`` also accept NumPy values of one row without its
axis, so that formulas of tasks serve batches in torch and single environments in NumPy.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.tasks.task import GoalSet


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


class GoalChoices:
    """Indices of the possible goals of every specification and layout."""

    def __init__(self, sets: Sequence[GoalSet], fewest: int, env_spec_index: torch.Tensor) -> None:
        """Gather the tables; ``env_spec_index`` has the set of each environment, (k,), int64."""
        # Row 0 of a set is for environments without obstacles; row l + 1 is for layout l.
        usable = [
            np.vstack([np.ones((1, len(goals.q)), bool), goals.usable.reshape(-1, len(goals.q))])
            for goals in sets
        ]
        num_rows = max(map(len, usable))
        num_goals = max(rows.shape[1] for rows in usable)
        index = np.zeros((len(sets), num_rows, num_goals), np.int32)
        count = np.ones((len(sets), num_rows), np.int64)
        for i, (goals, rows) in enumerate(zip(sets, usable, strict=True)):
            count[i, : len(rows)] = rows.sum(axis=1)
            if (least := int(count[i, : len(rows)].min())) < fewest:
                raise TaskError(f"robot {goals.robot!r}: {least} goals; expected {fewest} or more")
            # The possible ones first, in their order, so that a number below the count is one.
            index[i, : len(rows), : rows.shape[1]] = np.argsort(~rows, axis=1, kind="stable")
        device = env_spec_index.device
        self._index = torch.from_numpy(index).flatten(0, 1).to(device)
        self._count = torch.from_numpy(count).flatten().to(device)
        self._first_row = env_spec_index * num_rows

    def count(self, layout: torch.Tensor | None) -> torch.Tensor:
        """Return the number of possible goals, shape (k,); ``layout`` is as of ``begin``."""
        return self._count[self._row(layout)]

    def goals(self, layout: torch.Tensor | None, numbers: torch.Tensor) -> torch.Tensor:
        """Return goals (k, m) by their numbers among the possible ones, below the count."""
        return self._index[self._row(layout)[:, None], numbers].long()

    def _row(self, layout: torch.Tensor | None) -> torch.Tensor:
        """Return the row of each environment in the tables."""
        return self._first_row if layout is None else self._first_row + 1 + layout
