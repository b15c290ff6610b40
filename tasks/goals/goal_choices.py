"""The goals that the layouts of the obstacles leave possible, as tensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from morphgen.errors import TaskError
from morphgen.tasks.task import GoalSet


class GoalChoices:
    """Indices of the possible goals of every specification and layout."""

    def __init__(self, sets: Sequence[GoalSet], fewest: int, env_spec_index: torch.Tensor) -> None:
        """Gather the tables.

        env_spec_index: Index in ``sets`` of each environment, shape (k,), int64.
        """
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
            index[i, : len(rows), : rows.shape[1]] = np.argsort(~rows, axis=1, kind="stable")
        device = env_spec_index.device
        self._index = torch.from_numpy(index).flatten(0, 1).to(device)
        self._count = torch.from_numpy(count).flatten().to(device)
        self._first_row = env_spec_index * num_rows

    def count(self, layout: torch.Tensor | None) -> torch.Tensor:
        """Return the number of possible goals, shape (k,), int64.

        layout: Layout of the obstacles in each environment, shape (k,), -1 without obstacles;
            None if no environment has any.
        """
        return self._count[self._row(layout)]

    def goals(self, layout: torch.Tensor | None, numbers: torch.Tensor) -> torch.Tensor:
        """Return goals by their numbers among the possible ones.

        numbers: Numbers below the count, shape (k, m), int64.

        Returns:
            Indices of goals, shape (k, m), int64.
        """
        return self._index[self._row(layout)[:, None], numbers].long()

    def _row(self, layout: torch.Tensor | None) -> torch.Tensor:
        """Return the row of each environment in the tables."""
        return self._first_row if layout is None else self._first_row + 1 + layout
