"""Arrays with a row per environment: functions of rows, and tables that rows are drawn from.

The bits of a row depend on no other row. Batches are tensors of torch, with an axis of rows. A
single environment is one row in NumPy, without that axis: a call takes a tenth of the time, and
operators on numbers less. What a control step computes is written once, for both (``A``), with
operators, functions of ``namespace_of``, and those of this module.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from typing import Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.tasks.task import A, GoalSet

T = TypeVar("T")
_number: Any = np.float32  # a number of one environment, which counts as an array without axes


def namespace_of(values: A) -> Any:  # noqa: ANN401 - a module
    """Return the module of an array, torch or NumPy, for functions that both have."""
    return torch if isinstance(values, torch.Tensor) else np


def numpy_row(tables: T) -> Any:  # noqa: ANN401 - the same type, of NumPy arrays
    """Return a copy of an object whose tensors are NumPy views of their first row, on the CPU."""
    row = copy(tables)
    for name, value in vars(tables).items():
        if isinstance(value, torch.Tensor):
            setattr(row, name, value.numpy()[0, ...])
    return row


def duplicate(values: A) -> A:
    """Return a copy of an array."""
    return values.clone() if isinstance(values, torch.Tensor) else values.copy()


def row_sums(values: A) -> A:
    """Return the sums of rows (n, k), shape (n,).

    They are added in double precision: in single precision the order of a sum, and with it the
    last bit, depends on padding and on the number of rows.
    """
    if isinstance(values, torch.Tensor):
        return values.sum(dim=1, dtype=torch.float64).float()
    total: A = _number(sum(values.tolist()))
    return total


def row_norms(vectors: A) -> A:
    """Return the Euclidean norms of rows (n, 3), shape (n,); see ``row_sums``."""
    if isinstance(vectors, torch.Tensor):
        return vectors.double().square().sum(dim=1).sqrt().float()
    length: A = _number(math.hypot(*vectors.tolist()))
    return length


def rotated(quaternions: A, vectors: A) -> A:
    """Return vectors (n, 3) turned by unit quaternions (n, 4) w, x, y, z."""
    w, ux, uy, uz = (quaternions[..., i] for i in range(4))
    x, y, z = (vectors[..., i] for i in range(3))
    tx, ty, tz = 2 * (uy * z - uz * y), 2 * (uz * x - ux * z), 2 * (ux * y - uy * x)
    turned: A = namespace_of(vectors).stack(
        [
            x + w * tx + uy * tz - uz * ty,
            y + w * ty + uz * tx - ux * tz,
            z + w * tz + ux * ty - uy * tx,
        ],
        -1,
    )
    return turned


def angles_between(rotations: A, others: A) -> A:
    """Return the angles between rotation matrices (n, 3, 3), shape (n,) [rad].

    The Frobenius norm of their difference is sqrt(8) sin(angle / 2), which is well-conditioned at 0
    in double precision: squares of small differences vanish in single precision.
    """
    if isinstance(rotations, torch.Tensor):
        norm = (rotations - others).double().square().sum(dim=(1, 2)).sqrt().float()
        return 2 * torch.asin((norm / 8**0.5).clamp(max=1))
    sine = math.hypot(*(rotations - others).ravel().tolist()) / 8**0.5
    angle: A = _number(2 * math.asin(min(sine, 1.0)))
    return angle


def choose(condition: A, value: float, otherwise: A | float = 0.0) -> A:
    """Return a value in the rows where a condition holds, and other values elsewhere, (n,)."""
    if isinstance(condition, torch.Tensor):
        return torch.where(condition, value, otherwise)
    chosen: A = _number(value if condition else otherwise)
    return chosen


def positive_part(values: A) -> A:
    """Return values (n,), or 0 where they are negative."""
    if isinstance(values, torch.Tensor):
        return torch.clamp(values, min=0)
    positive: A = max(values, _number(0))  # nan stays; a call of NumPy takes ten times as long
    return positive


def clamped(values: A, lower: A, upper: A) -> A:
    """Return values within bounds that have their shape or broadcast to it."""
    if isinstance(values, torch.Tensor):
        return torch.clamp(values, lower, upper)
    within: A = np.minimum(np.maximum(values, lower), upper)  # np.clip takes four times as long
    return within


def is_integral(values: A) -> bool:
    """Return whether an array has integers or flags."""
    if isinstance(values, torch.Tensor):
        return not (values.is_floating_point() or values.is_complex())
    return values.dtype.kind in "iub"


def all_true(flags: A) -> bool:
    """Return whether all flags are set; it waits for a GPU."""
    if isinstance(flags, torch.Tensor):
        return bool(flags.all())
    return False not in flags.tolist()  # NumPy's `all` takes three times as long


def limit_violation(q: A, lower: A, upper: A) -> A:
    """Return the sum over joints of their distance outside of the limits, shape (n,) [rad, m]."""
    return row_sums(abs(q - clamped(q, lower, upper)))


def flat_index(columns: torch.Tensor, width: int) -> torch.Tensor:
    """Return indices in a flattened table (n, width) of columns (n, k) of its rows; see ``at``."""
    rows = torch.arange(len(columns), device=columns.device)
    return rows[:, None] * width + columns


def at(table: A, index: A) -> A:
    """Return the elements of a table at flat indices, in the shape of the indices."""
    elements: A = (table if table.ndim == 1 else table.reshape(-1))[index]
    return elements


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
