"""What joints do by themselves, in every simulator: how far behind, how fast, and how hard."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from morphgen.model.dynamics import BANDWIDTH, actuation, mass_matrix
from morphgen.model.robot import Joint, Robot
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP
from morphgen.typing import Array

LAG = 2 / BANDWIDTH + TIMESTEP * SUBSTEPS
"""Seconds by which a joint is behind a target that moves steadily, at most, in steps."""
FASTEST_TURN, FASTEST_SLIDE = 10.0, 1.0
"""Speed limit of a joint that has none, rad/s and m/s: the benchmark's largest steps at 50 Hz."""
SLACK = 0.2
"""Share of the spring's and the damper's force, added up, that a motor may pull beside their sum:
inertia is another where the robot is not at home, and turning about several axes takes some."""
GAIN = 1 / (1 - 2 * BANDWIDTH * TIMESTEP)
"""What the gains of the law are multiplied by in MuJoCo, and so the force of what is held in all.

MuJoCo integrates damping implicitly, v' = (v + dt s e) / (1 + dt d) at unit inertia. With
s = ``GAIN`` omega^2 and d = ``GAIN`` 2 omega this is v' = v + dt (omega^2 e - 2 omega v), as in
other simulators.
"""


def speed_limit(joint: Joint) -> float:
    """Fastest that a joint may be, rad/s or m/s."""
    return joint.velocity or (FASTEST_SLIDE if joint.kind == "prismatic" else FASTEST_TURN)


class MotorForces:
    """How hard the motors of many robots may pull: an arm gives way to what it presses against.

    A motor that makes for a velocity does so with all its effort, as if it were rigid. The law of
    ``morphgen.model.dynamics`` is a spring and a damper; so a motor may pull as hard as these do
    with the joint-space inertia M at home, the sum over joints k of |M_jk a_k|, where
    a_k = omega^2 e_k - 2 omega v_k is what the law wants, with ``SLACK`` and ``GAIN``. What
    moves freely needs no more.
    """

    def __init__(self, robots: Sequence[Robot], efforts: Sequence[float]) -> None:
        """Prepare.

        Args:
            robots: Their movable joints, one after the other, are the rows of what follows, m.
            efforts: Largest force of every row, N m or N.
        """
        self._efforts = np.array(efforts, dtype=np.float64)
        most = max((robot.dof for robot in robots), default=0)
        self._pull = np.zeros((most, len(self._efforts)))
        """Force of a row for each independent joint's acceleration; padded with zeros."""
        self._row = np.zeros((most, len(self._efforts)), np.intp)
        """Which row that joint is."""
        farthest: list[float] = []
        known: dict[int, Array] = {}
        for robot in robots:
            if id(robot) not in known:
                known[id(robot)] = _inertia(robot)
            start, end = len(farthest), len(farthest) + len(robot.movable_joints)
            self._pull[: robot.dof, start:end] = GAIN * known[id(robot)]
            self._row[: robot.dof, start:end] = [
                [start + robot.movable_joints.index(k)] for k in robot.independent_joints
            ]
            farthest.extend(LAG * speed_limit(robot.joints[k]) for k in robot.movable_joints)
        self._farthest = np.array(farthest)

    def limits(self, errors: Sequence[Array], velocities: Sequence[Array]) -> Array:
        """Largest forces of a control step, shape (m,).

        Args:
            errors: How far rows are from their targets when it begins, and when it ends if nothing
                is in the way, each of shape (m,), rad or m.
            velocities: How fast they are then, likewise.
        """
        springs = [BANDWIDTH**2 * np.clip(e, -self._farthest, self._farthest) for e in errors]
        dampers = [2 * BANDWIDTH * v for v in velocities]
        begin, end = (np.abs(k - d) for k, d in zip(springs, dampers, strict=True))
        wanted = np.maximum(begin, end) + SLACK * (np.abs(springs[0]) + np.abs(dampers[0]))
        force = np.zeros_like(wanted)
        # Joint by joint: a sum over all at once would round differently in another batch.
        for pull, row in zip(self._pull, self._row, strict=True):
            force += pull * wanted[row]
        return np.minimum(force, self._efforts)


def _inertia(robot: Robot) -> Array:
    """Force on movable joints for each independent joint's acceleration, (dof, movable)."""
    motors = np.diag([each.armature for each in actuation(robot)])
    matrix, _ = robot.mimic_map
    inertia = np.abs(mass_matrix(robot, robot.home)) + motors
    return np.asarray(inertia @ np.abs(matrix).T)
