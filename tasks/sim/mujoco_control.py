"""The law of position control in MuJoCo: its actuators, and the torques they lack."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from morphgen.model.dynamics import BANDWIDTH
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP
from morphgen.tasks.sim.motor_law import GAIN, LAG, speed_limit
from morphgen.tasks.sim.mujoco_gather import Gathered
from morphgen.tasks.sim.mujoco_model import PASSIVE, World
from morphgen.typing import Array


def _mean_acceleration() -> tuple[float, float]:
    """Mean over a control step, per unit of error and of velocity at its begin."""
    keep, pull = 1 - 2 * BANDWIDTH * TIMESTEP, BANDWIDTH**2 * TIMESTEP
    step = np.array([[1 - TIMESTEP * pull, -TIMESTEP * keep], [pull, keep]])
    _, (by_error, by_velocity) = np.linalg.matrix_power(step, SUBSTEPS).tolist()
    period = TIMESTEP * SUBSTEPS
    return by_error / period, (by_velocity - 1) / period


BY_ERROR, BY_VELOCITY = _mean_acceleration()


class PositionControl:
    """Controls that make every joint follow the law of ``morphgen.model.dynamics``.

    An actuator with the gains of the joint's own inertia at home follows the law at home, and
    as long as nothing else moves. What is missing, M(q) a - I a + c(q, v), with a the law's
    acceleration, M the joint-space inertia, I what the gains assume and c Coriolis forces, is
    added through the targets (inverse dynamics control; Siciliano et al. 2009, 8.5.2). It is
    reckoned once a control step, with the mean of a over it; the actuator does the rest in
    every physics step. The actuator's effort limits the sum.

    A joint's speed limit v keeps its target within ``LAG`` v of where it is. A target that does not
    move faster is never farther away; one that is, because something holds the joint, pulls no
    harder for it.

    Where a tool goes does then not depend on the simulator: with the gains alone, arms leave
    the path of the law by centimetres within a second.

    MuJoCo forgets the implicit damping of an actuator that is at its limit of effort. Light
    links at the end of a long chain, on which a strong motor acts, then explode at 5 ms. So
    ``PASSIVE`` of the damping belongs to the joints, where no limit touches it, and a torque makes
    up for it at the velocity with which the control step began.
    """

    def __init__(self, worlds: Sequence[World], data: Sequence[mujoco.MjData], joints: int) -> None:
        """Prepare.

        Args:
            worlds: Model of every environment, n of them.
            data: Its data.
            joints: J, the width of targets.
        """
        self._shape = (len(worlds), joints)
        self._bias = Gathered([one.qfrc_bias for one in data])
        self._weight = Gathered([one.qfrc_gravcomp for one in data])
        self._applied = np.zeros(len(self._bias.flat))
        self._acceleration = np.zeros(len(self._bias.flat))
        self._force = np.zeros(len(self._bias.flat))
        self._products: list[tuple[mujoco.MjModel, mujoco.MjData, Array, Array]] = []
        self._compliance = np.zeros(self._shape)
        self._farthest = np.zeros(self._shape)
        self._damping = Gathered([world.model.dof_damping for world in worlds])
        self._damping.read()
        slots, leaders, gains = [], [], []
        for i, (world, one) in enumerate(zip(worlds, data, strict=True)):
            begin, end = self._bias.begin[i : i + 2].tolist()
            force, acceleration = self._force[begin:end], self._acceleration[begin:end]
            self._products.append((world.model, one, force, acceleration))
            self._compliance[i, : world.robot.dof] = 1 / world.model.actuator_gainprm[:, 0]
            self._farthest[i, : world.robot.dof] = [
                LAG * speed_limit(world.robot.joints[k]) for k in world.robot.independent_joints
            ]
            matrix, _ = world.robot.mimic_map
            rows, columns = np.nonzero(matrix)
            slots.append(begin + world.movable_qd_at[rows])
            leaders.append(i * joints + columns)
            gains.append(matrix[rows, columns])
        self._slots, self._leaders = np.concatenate(slots), np.concatenate(leaders)
        self._gains = np.concatenate(gains)

    def applied_to(self, env: int) -> Array:
        """Forces on the degrees of freedom of an environment, beside its actuators'; a view."""
        begin, end = self._bias.begin[env : env + 2].tolist()
        return self._applied[begin:end]

    def controls(self, targets: Array, q: Array, qd: Array, velocities: Array, out: Array) -> None:
        """Reckon the controls of all actuators; the data must be where the last step left them.

        Args:
            targets: Of the independent joints, shape (n, J), zero where there is none.
            q: Their positions, likewise.
            qd: Their velocities, likewise.
            velocities: All of ``qvel`` of all environments, one after the other, and a zero.
            out: Gets the controls, likewise.
        """
        error = np.clip(targets - q, -self._farthest, self._farthest)
        wanted = BY_ERROR * error + BY_VELOCITY * qd
        self._acceleration[self._slots] = self._gains * wanted.ravel()[self._leaders]
        for model, data, force, acceleration in self._products:
            mujoco.mj_mulM(model, data, force, acceleration)
        self._bias.read()
        self._weight.read()
        force = self._force + self._bias.flat - self._weight.flat
        of_leaders = np.bincount(
            self._leaders, self._gains * force[self._slots], minlength=wanted.size
        )
        np.multiply(of_leaders.reshape(self._shape), self._compliance, out=out)
        out += q + error - PASSIVE * 2 / BANDWIDTH * qd - wanted / (GAIN * BANDWIDTH**2)
        np.multiply(self._damping.flat, velocities, out=self._applied)

    def forget(self) -> None:
        """Let go of the environments' data."""
        self._products = []
        self._bias, self._weight = Gathered(()), Gathered(())
