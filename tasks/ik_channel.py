"""Configurations that bring tools to their targets, for the observation channel ``ik``."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from morphgen.model.inverse_kinematics_torch import solve_from_starts
from morphgen.tasks.robot_tables import RobotTables
from morphgen.tasks.tool_targets import ToolTargets
from morphgen.typing import Array

FirstFree = Callable[[int, Array, Array], "int | None"]
"""Function that returns the first of the configurations (k, J) that an environment's robot reaches
from another one, (J,), on a straight path without a collision; None if there is none."""
STARTS = 32
"""Number of start configurations of a solution."""
ITERATIONS = 25
"""Iterations of damped least squares."""
SOLVED = 0.005
"""Distance of tool and target that counts as a solution [m]."""
MOVED = 0.01
"""Distance that a target moves before it is solved again [m]."""


class IkSolutions:
    """A configuration for each environment that brings the tool to its first target.

    It is found by damped least squares from the joint targets and from other starts, which are the
    same for all robots as fractions of their joints' ranges. Of several solutions it is the one
    that the robot reaches first on a straight path without a collision; if all paths collide, the
    nearest. A solution is kept until the episode ends or the target moves. The paths are tested on
    the CPU: on a GPU, ``update`` copies tensors from it.
    """

    def __init__(
        self, tables: RobotTables, env_robot_index: torch.Tensor, first_free: FirstFree
    ) -> None:
        """Gather the tables of every environment.

        Args:
            tables: The robots.
            env_robot_index: Robot of each environment, shape (n,), int64.
            first_free: Test of straight paths.
        """
        index, self._first_free = env_robot_index, first_free
        self._tables, self._index = tables, index
        self._lower, self._upper = tables.lower[index], tables.upper[index]
        self._per_step = 1 / tables.max_step[index].clamp(min=1e-6)
        self._moves_tool = tables.moves_tool[index]
        n, J = self._lower.shape
        device = tables.device
        # The first point of the sequence is zero, a corner of the range.
        sobol = torch.quasirandom.SobolEngine(J)  # type: ignore[no-untyped-call]
        sobol.fast_forward(1)  # type: ignore[no-untyped-call]
        self._fractions = sobol.draw(STARTS - 1).to(device)
        self.q = torch.zeros(n, J, device=device)
        """The configurations, shape (n, J) [rad or m]."""
        self.error = torch.zeros(n, device=device)
        """Distance from tool to target there, shape (n,) [m]."""
        self._solved_for = torch.full((n, 3), math.inf, device=device)

    def forget(self, mask: torch.Tensor) -> None:
        """Forget the solutions of environments whose episode begins.

        Args:
            mask: The environments, shape (n,), bool.
        """
        self._solved_for.masked_fill_(mask[:, None], math.inf)

    def update(self, targets: torch.Tensor, goals: ToolTargets, metres_per_radian: float) -> None:
        """Solve where an episode has begun or the tool's target has moved.

        Args:
            targets: Targets of the independent joints, shape (n, J) [rad or m].
            goals: Points and orientations that the tasks want the tool at.
            metres_per_radian: Length by which errors of orientation are multiplied [m/rad].
        """
        points = goals.points[:, 0]
        moved = torch.linalg.vector_norm(points - self._solved_for, dim=1) > MOVED
        exists = goals.exists[:, 0]
        self.q = torch.where(exists[:, None], self.q, targets)
        rows = torch.nonzero(moved & exists)[:, 0]
        if not len(rows):
            return
        self._solved_for[rows] = points[rows]
        if goals.rotations is None or goals.has_rotation is None:
            self._solve(rows, targets, points, None, metres_per_radian)
            return
        posed = goals.has_rotation[rows]
        for some, rotations in ((rows[~posed], None), (rows[posed], goals.rotations)):
            if len(some):
                self._solve(some, targets, points, rotations, metres_per_radian)

    def _solve(
        self,
        rows: torch.Tensor,
        targets: torch.Tensor,
        points: torch.Tensor,
        rotations: torch.Tensor | None,
        metres_per_radian: float,
    ) -> None:
        """Solve for some environments, shape (k,)."""
        now, lower, upper = targets[rows], self._lower[rows], self._upper[rows]
        random = lower + (upper - lower) * self._fractions[:, None]
        starts = torch.cat([now[None], torch.where(self._moves_tool[rows], random, now)])
        q, error = solve_from_starts(
            self._tables.tool_chain,
            self._index[rows],
            starts,
            points[rows],
            None if rotations is None else rotations[rows],
            (lower, upper),
            rotation_weight=metres_per_radian,
            iterations=ITERATIONS,
        )
        q = self._tables.nearest_turns(self._index[rows], q, now)
        distance = torch.linalg.vector_norm(error, dim=2)
        steps = ((q - now) * self._per_step[rows]).abs().amax(dim=2)
        cost = torch.where(distance < SOLVED, steps, 1e6 * (1 + distance))
        order = cost.argsort(dim=0, stable=True).cpu().numpy()
        here, ends = now.double().cpu().numpy(), q.double().cpu().numpy()
        solved = (distance < SOLVED).sum(dim=0).tolist()
        chosen = []
        for i, env in enumerate(rows.tolist()):
            preferred = order[: solved[i], i]
            chosen.append(order[self._first_free(env, here[i], ends[preferred, i]) or 0, i])
        best = torch.tensor(np.array(chosen), device=rows.device)
        column = torch.arange(len(rows), device=rows.device)
        self.q[rows], self.error[rows] = q[best, column], distance[best, column]
