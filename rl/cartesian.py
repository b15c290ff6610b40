"""Steps of joints that move tools towards poses, for a batch of different bodies at once."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.tasks.bodies import Bodies
from morphgen.tasks.kinematics import quaternions, tool_frames, tool_jacobians

Array = NDArray[np.float64]

DAMPING = 0.02
"""Of positions, in units of joints over metres."""
DAMPING_TURN = 0.1
"""Of rotations, in units of joints over radians."""
LARGEST = 0.3
"""Largest change of a joint in an iteration of ``OneTool.brought``, rad or m."""

_PARTS = (0.25, 0.5, 0.75, 1.0)
"""Of a turn that are tried, if there is not the time for all of it."""


def towards(
    bodies: Bodies,
    body: torch.Tensor,
    q: torch.Tensor,
    position: torch.Tensor,
    rotation: torch.Tensor,
    *,
    hasty: bool = False,
) -> torch.Tensor:
    """Configurations whose tools are nearer to poses, first in position, then in rotation.

    One iteration of damped least squares in two levels (Nakamura 1987): the rotation is corrected
    only by what leaves the position alone. Joints that would leave their limits stand still.

    Args:
        bodies: The robots.
        body: Which robot each row is, shape (n,), int64.
        q: Where joints are, shape (n, J).
        position: Where the tools are to be in their root frames, shape (n, 3), metres.
        rotation: How they are to be turned there, shape (n, 3, 3).
        hasty: Turn only as far as no joint needs more than a control step for it.

    Returns:
        Within limits, shape (n, J).
    """
    T = tool_frames(bodies.chain, body, q)[:, -1]
    J = tool_jacobians(bodies.chain, body, q)
    off = (position - T[:, :3, 3])[..., None]
    turn = rotation_vectors(rotation @ T[:, :3, :3].transpose(1, 2))[..., None]
    lower, upper = bodies.lower[body], bodies.upper[body]
    moves = bodies.moves_tool[body]
    eye = torch.eye(q.shape[1], device=q.device)
    found = q
    for _ in range(2):
        linear, angular = J[:, :3] * moves[:, None], J[:, 3:] * moves[:, None]
        inverse = _damped_inverse(linear, DAMPING)
        step = inverse @ off
        rest = eye - inverse @ linear
        left = angular @ rest
        back = rest @ (_damped_inverse(left, DAMPING_TURN) @ (turn - angular @ step))
        step = step + (_affordable(step, back, bodies.step[body]) if hasty else back)
        found = q + step[..., 0]
        moves = moves & (found >= lower) & (found <= upper)
    return torch.clamp(found, lower, upper)


class OneTool:
    """The same for configurations of one robot, as arrays."""

    def __init__(self, bodies: Bodies, index: int) -> None:
        """Prepare.

        Args:
            bodies: Robots.
            index: Which of them.
        """
        self._bodies, self._index = bodies, index
        self._dof = bodies.robots[index].dof

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Positions (n, 3) and rotations (n, 3, 3) of the tool at configurations (n, dof)."""
        body, rows = self._rows(q)
        T = tool_frames(self._bodies.chain, body, rows)[:, -1].double().cpu().numpy()
        return T[:, :3, 3], T[:, :3, :3]

    def brought(self, q: Array, position: Array, rotation: Array, iterations: int) -> Array:
        """Configurations (n, dof) whose tools are nearer to poses, after some iterations.

        Args:
            q: Where to start, shape (n, dof).
            position: Shape (n, 3), metres.
            rotation: Shape (n, 3, 3).
            iterations: Of ``towards``.
        """
        body, rows = self._rows(q)
        goal, turned = (torch.from_numpy(each).to(rows) for each in (position, rotation))
        for _ in range(iterations):
            change = towards(self._bodies, body, rows, goal, turned) - rows
            rows = rows + change.clamp(-LARGEST, LARGEST)
        return rows[:, : self._dof].double().cpu().numpy()

    def _rows(self, q: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """Which robot, and configurations, as rows of a batch: shape (n,) and (n, J)."""
        device = self._bodies.device
        rows = torch.zeros(len(q), self._bodies.max_joints, device=device)
        rows[:, : self._dof] = torch.from_numpy(q).to(rows)
        return torch.full((len(q),), self._index, device=device), rows


def _affordable(step: torch.Tensor, more: torch.Tensor, most: torch.Tensor) -> torch.Tensor:
    """The largest of some parts of a change that joints can make beside another, all (n, J, 1)."""
    found = torch.zeros_like(more)
    for part in _PARTS:
        within = ((step + part * more)[..., 0].abs() <= most).all(dim=1)
        found = torch.where(within[:, None, None], part * more, found)
    return found


def _damped_inverse(J: torch.Tensor, damping: float) -> torch.Tensor:
    eye = damping**2 * torch.eye(J.shape[1], device=J.device)
    inverse: torch.Tensor = torch.linalg.inv(J @ J.transpose(1, 2) + eye)
    return J.transpose(1, 2) @ inverse


def rotation_vectors(R: torch.Tensor) -> torch.Tensor:
    """Return rotations (n, 3, 3) as rotation vectors, angle times axis, shape (n, 3), rad.

    This is the logarithm of the unit quaternion, which is well-conditioned at 0 and at pi.
    """
    quaternion = quaternions(R)
    w, v = quaternion[:, :1], quaternion[:, 1:]
    sine = torch.linalg.vector_norm(v, dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    # The limit of angle / sine at 0 is 2.
    return v * torch.where(sine > 0, angle / sine.clamp(min=1e-30), 2.0)
