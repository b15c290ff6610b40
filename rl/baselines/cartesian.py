"""The tool of one robot of a batch: its poses, and configurations that bring it to poses."""

from __future__ import annotations

import torch

from morphgen.model.inverse_kinematics import MAX_STEP
from morphgen.model.inverse_kinematics_torch import pose_ik_step
from morphgen.model.kinematics_torch import frame_pose
from morphgen.tasks.robot_tables import RobotTables
from morphgen.typing import Array


class OneTool:
    """The tool of one robot, at configurations that are NumPy arrays."""

    def __init__(self, robot_tables: RobotTables, index: int) -> None:
        """Prepare.

        Args:
            robot_tables: Robots.
            index: Which of them.
        """
        self._robot_tables, self._index = robot_tables, index
        self._dof = robot_tables.robots[index].dof

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Positions (n, 3) and rotations (n, 3, 3) of the tool at configurations (n, dof)."""
        body, rows = self._rows(q)
        T = frame_pose(self._robot_tables.tool_chain, body, rows).double().cpu().numpy()
        return T[:, :3, 3], T[:, :3, :3]

    def brought(self, q: Array, position: Array, rotation: Array, iterations: int) -> Array:
        """Configurations (n, dof) whose tools are nearer to poses, after some iterations.

        Args:
            q: Where to start, shape (n, dof).
            position: Shape (n, 3), metres.
            rotation: Shape (n, 3, 3).
            iterations: Of ``pose_ik_step``.
        """
        body, rows = self._rows(q)
        goal, turned = (torch.from_numpy(each).to(rows) for each in (position, rotation))
        limits = self._robot_tables.lower[body], self._robot_tables.upper[body]
        for _ in range(iterations):
            target = pose_ik_step(self._robot_tables.tool_chain, body, rows, goal, turned, limits)
            rows = rows + (target - rows).clamp(-MAX_STEP, MAX_STEP)
        return rows[:, : self._dof].double().cpu().numpy()

    def _rows(self, q: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """Which robot, and configurations, as rows of a batch: shape (n,) and (n, J)."""
        device = self._robot_tables.device
        rows = torch.zeros(len(q), self._robot_tables.max_joints, device=device)
        rows[:, : self._dof] = torch.from_numpy(q).to(rows)
        return torch.full((len(q),), self._index, device=device), rows
