"""Joint motion without contacts: the law of position control for all environments at once."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from morphgen.errors import SimulationError
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import (
    CONTROL_STEP,
    Contacts,
    Scene,
    Simulation,
    Simulator,
    farthest_targets,
    is_host,
)
from morphgen.typing import Array

UNLIMITED = (-np.inf, np.inf)  # position limits of joints without any [rad or m]
NO_CONTACTS = Contacts(scene=False, self_collision=False)
"""The only contacts that this simulator can be asked for."""


class KinematicSimulation(Simulation):
    """Environments whose joints follow the control law exactly; a ``Simulation``.

    Joints move as those of ``MujocoSimulation`` do in free space: critically damped, with the same
    physics steps, and with the error limited to ``LAG`` times the joint's speed limit. A control
    step is one linear map of error and velocity, ``CONTROL_STEP``. It costs a few tensor operations
    for all environments, on the CPU or a GPU. All are elementwise, so that each environment gives
    the same bits whatever else is in the batch. Tools stay within 1 cm of MuJoCo's for 1 s in free
    space, as long as no motor would be at its effort limit.

    Nothing collides: links pass through each other and through the ground, so that no batch has
    this simulator with blocks or obstacles. Motors have no effort limits, and links no inertia:
    where a real motor would be too weak, as when fast joints turn back at once, MuJoCo's joints lag
    behind these.

    Joints stay within their limits. Targets are clamped to them, and the response of the law to an
    impulse is never negative: a joint that starts at rest never passes the farthest target.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        contacts: Contacts | None = None,
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(scenes, torch.device(device))
        if contacts not in (None, NO_CONTACTS):
            raise SimulationError(
                f"simulator 'kinematic' has no contacts: {contacts}; expected {NO_CONTACTS}"
            )
        robots = {id(scene.robot): scene.robot for scene in scenes}
        row_of_robot = {key: row for row, key in enumerate(robots)}
        rows = np.array([row_of_robot[id(scene.robot)] for scene in scenes])
        table = torch.from_numpy(_joint_table(list(robots.values()))[:, rows]).to(self.device)
        self.q, self._lower, self._upper, self._farthest = table.float().contiguous()
        self._is_joint = self._farthest > 0
        n = len(scenes)
        self.qd = torch.zeros_like(self.q)
        self.object_pose = torch.zeros(n, 7, device=self.device)
        self.object_velocity = torch.zeros(n, 3, device=self.device)
        self._diverged = torch.zeros(n, dtype=torch.bool, device=self.device)
        self._on_host = is_host(self.device)

    def _reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        object_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None,
    ) -> None:
        rows = mask[:, None]
        positions = torch.where(rows, torch.where(self._is_joint, q, 0.0), self.q)
        if self._on_host:
            self._require_finite("reset to q", positions.numpy())
        self.q.copy_(positions)
        self.qd.masked_fill_(rows, 0.0)

    def _step(self, targets: torch.Tensor) -> torch.Tensor:
        """Step: only on a GPU, targets and positions that are not finite diverge."""
        targets = torch.where(self._is_joint, targets, 0.0)
        if self._on_host:
            self._require_finite("targets", targets.numpy())
        error = torch.clamp(targets, self._lower, self._upper) - self.q
        error = torch.clamp(error, -self._farthest, self._farthest)
        (error_to_error, velocity_to_error), (by_error, by_velocity) = CONTROL_STEP.tolist()
        # A clamped error is that of a nearer target, towards which the joint moves in this step.
        self.q += (1 - error_to_error) * error - velocity_to_error * self.qd
        self.qd.mul_(by_velocity).add_(by_error * error)
        if not self._on_host:
            self._diverged = ~(torch.isfinite(self.q) & torch.isfinite(targets)).all(dim=1)
        return self._diverged


def _joint_table(robots: Sequence[Robot]) -> Array:
    """Return constants of the independent joints of R robots, padded with zeros, shape (4, R, J).

    They are home position, lower and upper limit, and the largest error [rad or m].
    """
    table = np.zeros((4, len(robots), max(robot.dof for robot in robots)))
    for row, robot in enumerate(robots):
        joints = [robot.joints[k] for k in robot.independent_joints]
        table[0, row, : robot.dof] = robot.home
        limits = [
            UNLIMITED if joint.is_continuous else joint.limits or UNLIMITED for joint in joints
        ]
        table[1:3, row, : robot.dof] = np.array(limits).reshape(-1, 2).T
        table[3, row, : robot.dof] = farthest_targets(robot, robot.independent_joints)
    return table


SIMULATOR = Simulator(
    "kinematic",
    lambda scenes, contacts, _, device: KinematicSimulation(scenes, contacts, device=device),
    max_envs=65_536,
    devices=("cpu", "cuda"),
    simulates_contacts=False,
    takes_workers=False,
)
