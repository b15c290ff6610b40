"""Position control in MuJoCo: the targets of actuators, and torques that they cannot exert."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from morphgen.model.dynamics import BANDWIDTH
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.sim.motor_law import CONTROL_STEP, GAIN, farthest_targets
from morphgen.tasks.sim.mujoco_model import PASSIVE, World
from morphgen.tasks.sim.mujoco_state import GatheredArrays
from morphgen.tasks.sim.short_arrays import clamp
from morphgen.typing import Array

BY_ERROR = CONTROL_STEP[1, 0] / CONTROL_PERIOD
BY_VELOCITY = (CONTROL_STEP[1, 1] - 1) / CONTROL_PERIOD
"""Mean acceleration in a control step per unit of initial error and initial velocity."""


class PositionControl:
    """Controls that make every joint follow the law of ``morphgen.model.dynamics``.

    An actuator whose gains assume the joint's own inertia at home follows the law at home, as long
    as nothing else moves. The missing force M(q) a - I a + c(q, v), with the law's acceleration a,
    the joint-space inertia M, the inertia I that the gains assume and Coriolis forces c, is added
    through the targets (inverse dynamics control; Siciliano et al. 2009, 8.5.2). It is computed
    once per control step, with the mean of a over the step; the actuator does the rest in every
    physics step. The actuator's effort limits the sum. With the gains alone, arms would leave the
    path of the law by centimetres within a second.

    A joint's speed limit v keeps its target within ``LAG`` v of its position. A target that moves
    no faster is never farther away; one that is, because something holds the joint, does not pull
    harder.

    MuJoCo drops the implicit damping of an actuator at its effort limit. Light links at the end of
    a long chain with a strong motor then diverge at a time step of 5 ms. So the fraction
    ``PASSIVE`` of the damping belongs to the joints, which have no limit, and a torque compensates
    it at the velocity with which the control step began.
    """

    def __init__(self, worlds: Sequence[World], data: Sequence[mujoco.MjData], joints: int) -> None:
        """Prepare.

        Args:
            worlds: Model of each environment, n of them.
            data: Data of each environment.
            joints: Number of independent joints with padding, J.
        """
        self._shape = (len(worlds), joints)
        bias = [env_data.qfrc_bias for env_data in data]
        weight = [env_data.qfrc_gravcomp for env_data in data]
        self._data_forces = GatheredArrays([*bias, np.zeros(1), *weight])  # one call reads both
        self._bias, self._weight = np.split(self._data_forces.flat, 2)
        self._applied, self._acceleration, self._force = np.zeros((3, len(self._bias)))
        self._products: list[tuple[mujoco.MjModel, mujoco.MjData, Array, Array]] = []
        self._compliance = np.zeros(self._shape)
        self._farthest = np.zeros(self._shape)
        self._damping = GatheredArrays([world.model.dof_damping for world in worlds])
        self._damping.read()
        slots, leaders, gains = [], [], []
        for i, (world, env_data) in enumerate(zip(worlds, data, strict=True)):
            begin, end = self._data_forces.begin[i : i + 2].tolist()
            force, acceleration = self._force[begin:end], self._acceleration[begin:end]
            self._products.append((world.model, env_data, force, acceleration))
            self._compliance[i, : world.robot.dof] = 1 / world.model.actuator_gainprm[:, 0]
            robot = world.robot
            self._farthest[i, : robot.dof] = farthest_targets(robot, robot.independent_joints)
            matrix, _ = world.robot.mimic_map
            rows, columns = np.nonzero(matrix)
            slots.append(begin + world.movable_qd_at[rows])
            leaders.append(i * joints + columns)
            gains.append(matrix[rows, columns])
        self._slots, self._leaders = np.concatenate(slots), np.concatenate(leaders)
        self._gains = np.concatenate(gains)

    def applied_to(self, env: int) -> Array:
        """Return the extra forces on an environment's degrees of freedom, shape (nv,); a view."""
        begin, end = self._data_forces.begin[env : env + 2].tolist()
        return self._applied[begin:end]

    def controls(self, targets: Array, q: Array, qd: Array, velocities: Array, out: Array) -> None:
        """Compute the controls of all actuators from the data as the last step left them.

        Args:
            targets: Targets of the independent joints, shape (n, J); padding is zero.
            q: Positions of the independent joints, shape (n, J).
            qd: Velocities of the independent joints, shape (n, J).
            velocities: ``qvel`` of all environments, concatenated, and a zero.
            out: Receives the controls, shape (n, J).
        """
        error = clamp(targets - q, self._farthest)
        mean_acceleration = BY_ERROR * error + BY_VELOCITY * qd
        self._acceleration[self._slots] = self._gains * mean_acceleration.ravel()[self._leaders]
        for model, data, force, acceleration in self._products:
            mujoco.mj_mulM(model, data, force, acceleration)
        self._data_forces.read()
        force = self._force + self._bias - self._weight
        leader_forces = np.bincount(
            self._leaders, self._gains * force[self._slots], minlength=mean_acceleration.size
        )
        np.multiply(leader_forces.reshape(self._shape), self._compliance, out=out)
        out += q + error - PASSIVE * 2 / BANDWIDTH * qd - mean_acceleration / (GAIN * BANDWIDTH**2)
        np.multiply(self._damping.flat, velocities, out=self._applied)

    def release(self) -> None:
        """Release the environments' data."""
        self._products = []
        self._data_forces = GatheredArrays(())
