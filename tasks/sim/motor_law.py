"""The law of joint motors in all simulators: lag, speed limits and force limits."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.model.dynamics import BANDWIDTH, actuation, movable_mass_matrix
from morphgen.model.robot import Joint, Robot
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP
from morphgen.typing import Array

if TYPE_CHECKING:
    import torch


def clamp(values: Array, bound: Array) -> Array:
    """Return values within +-bound: ``np.clip`` at a quarter of its overhead."""
    return np.minimum(np.maximum(values, -bound), bound)


def is_within(values: NDArray[Any], bound: float) -> bool:
    """Return whether all magnitudes are at most a bound; NaN is not."""
    flat = values.ravel()
    # They are if the root of the sum of their squares is, which is fast to test.
    return float(flat.dot(flat)) <= bound**2 or bool(np.abs(flat).max(initial=0.0) <= bound)


def all_finite(values: NDArray[Any]) -> bool:
    """Return whether all values are finite."""
    flat = values.ravel()
    # They are if the sum of their squares is; it may also overflow.
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())


def consecutive(indices: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """Return indices as a slice if they are consecutive: they select the same, in less time."""
    first = int(indices[0]) if len(indices) else 0
    is_slice = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if is_slice else indices


def mask_of(rows: Iterable[int], count: int) -> NDArray[np.bool_]:
    """Return a mask of ``count`` rows that is set in some of them."""
    mask = np.zeros(count, bool)
    mask[list(rows)] = True
    return mask


class TensorView:
    """View of a tensor as an array, kept while the same is passed: to make one takes 1 to 3 us."""

    def __init__(self) -> None:
        self._tensor: torch.Tensor | None = None
        self._view: NDArray[Any] = np.zeros(0)

    def __call__(self, tensor: torch.Tensor) -> NDArray[Any]:
        """Return the view."""
        if tensor is not self._tensor:
            self._tensor, self._view = tensor, tensor.numpy()
        return self._view


LAG = 2 / BANDWIDTH + TIMESTEP * SUBSTEPS
"""Largest delay of a joint behind a target that moves steadily in control steps [s]."""
FASTEST_TURN, FASTEST_SLIDE = 10.0, 1.0
"""Speed of joints without a limit [rad/s, m/s]: the benchmark's largest steps at 50 Hz."""
SLACK = 0.2
"""Additional motor force, as a fraction of the spring's plus the damper's force: the inertia
differs away from home, and rotation about several axes takes some force."""
GAIN = 1 / (1 - 2 * BANDWIDTH * TIMESTEP)
"""Factor of the law's gains in MuJoCo, and so of the force of a held joint in all simulators.

MuJoCo integrates damping implicitly, v' = (v + dt s e) / (1 + dt d) at unit inertia. With
s = ``GAIN`` omega^2 and d = ``GAIN`` 2 omega this is v' = v + dt (omega^2 e - 2 omega v), as in
other simulators.
"""


def _control_step_matrix() -> Array:
    """Return ``CONTROL_STEP``: the matrix of a physics step to the power of ``SUBSTEPS``."""
    keep, pull = 1 - 2 * BANDWIDTH * TIMESTEP, BANDWIDTH**2 * TIMESTEP
    step = np.array([[1 - TIMESTEP * pull, -TIMESTEP * keep], [pull, keep]])
    return np.linalg.matrix_power(step, SUBSTEPS)


CONTROL_STEP = _control_step_matrix()
"""Matrix A of a control step with a constant target: (error, velocity) at the end are A times those
at the beginning, shape (2, 2).

A physics step is v' = v + dt (omega^2 e - 2 omega v), q' = q + dt v', as in MuJoCo. Tools that
follow the exact solution of the differential equation are several times as far from MuJoCo's, which
``tests/tasks/test_kinematic_sim.py`` checks.
"""


def speed_limit(joint: Joint) -> float:
    """Return the largest speed of a joint [rad/s or m/s]."""
    return joint.velocity or (FASTEST_SLIDE if joint.kind == "prismatic" else FASTEST_TURN)


def limited_speeds(robot: Robot) -> list[float]:
    """Return the speed limits of the movable joints, infinite without one [rad/s or m/s].

    A mimic joint has that of its leader: its own would part them.
    """
    matrix, _ = robot.mimic_map
    leaders = [robot.joints[k].velocity or np.inf for k in robot.independent_joints]
    return [
        max((abs(gain) * v for gain, v in zip(row, leaders, strict=True) if gain), default=0.0)
        for row in matrix.tolist()
    ]


def farthest_targets(robot: Robot, joints: Sequence[int]) -> list[float]:
    """Return the largest distance of some joints from their targets that pulls [rad or m]."""
    return [LAG * speed_limit(robot.joints[k]) for k in joints]


class MotorForces:
    """Force limits of the motors of many robots, so that arms yield under contact.

    A velocity motor pulls with all its effort, as if it were rigid. The law of
    ``morphgen.model.dynamics`` is a spring and a damper; so a motor j may pull as hard as these do
    with the joint-space inertia M at home: the sum over joints k of |M_jk a_k| with the law's
    acceleration a_k = omega^2 e_k - 2 omega v_k, plus ``SLACK``, times ``GAIN``. Free motion needs
    no more. A mimic joint also needs the force that keeps it with its leader while others swing it
    around: up to sqrt(M_jj M_kk) v_k^2.
    """

    def __init__(self, robots: Sequence[Robot], efforts: Sequence[float]) -> None:
        """Compute the inertia of each robot; efforts are the largest force of each row [N m, N]."""
        self._efforts = np.array(efforts, dtype=np.float64)
        max_dof = max((robot.dof for robot in robots), default=0)
        self._pull = np.zeros((max_dof, len(self._efforts)))
        """Force of each row per acceleration of each independent joint; padded with zeros."""
        self._row = np.zeros((max_dof, len(self._efforts)), np.intp)
        """Row of that independent joint."""
        self._swing = np.zeros_like(self._pull)
        """Force of each row of a mimic joint per squared velocity of each independent joint."""
        farthest: list[float] = []
        inertias: dict[int, tuple[Array, Array]] = {}
        for robot in robots:
            if id(robot) not in inertias:
                inertias[id(robot)] = _inertia(robot)
            start, end = len(farthest), len(farthest) + len(robot.movable_joints)
            inertia, swing = inertias[id(robot)]
            self._pull[: robot.dof, start:end] = GAIN * inertia
            self._swing[: robot.dof, start:end] = GAIN * swing
            self._row[: robot.dof, start:end] = [[start + row] for row in robot.independent_rows]
            farthest.extend(farthest_targets(robot, robot.movable_joints))
        self._farthest = np.array(farthest)
        self._has_mimic_joints = bool(self._swing.any())

    def limits(self, errors: Sequence[Array], velocities: Sequence[Array]) -> Array:
        """Return the largest forces in a control step, shape (m,) [N m or N].

        Errors [rad or m] and velocities are those at the beginning, and at the end without
        contacts, shape (m,) each.
        """
        springs = [BANDWIDTH**2 * clamp(e, self._farthest) for e in errors]
        dampers = [2 * BANDWIDTH * v for v in velocities]
        begin, end = (np.abs(k - d) for k, d in zip(springs, dampers, strict=True))
        accelerations = np.maximum(begin, end) + SLACK * (np.abs(springs[0]) + np.abs(dampers[0]))
        forces = self._pull * accelerations[self._row]
        if self._has_mimic_joints:
            fastest = np.maximum(np.abs(velocities[0]), np.abs(velocities[1]))
            forces += self._swing * (fastest**2)[self._row]
        # Along the first axis NumPy adds one row after the other, so that padding changes no bit.
        return np.minimum(np.add.reduce(forces, axis=0), self._efforts)


def _inertia(robot: Robot) -> tuple[Array, Array]:
    """Return forces on movable joints per acceleration of independent joints, (dof, movable).

    The second array is that per squared velocity of independent joints, which is zero for joints
    that are no mimic joints.

    Each joint of a mimic group has a motor of its own: it carries what accelerates its own link,
    while the inertia of the group is that of all, in which two fingers that move apart cancel. In
    the group it also carries what others do to a part of it, such as the reaction of a motor on
    the rod of a parallelogram: up to sqrt(M_jj M_kk), which bounds M_jk away from home.
    """
    matrix, _ = robot.mimic_map
    gains = np.abs(matrix)
    armatures = np.diag([motor.armature for motor in actuation(robot)])
    of_movable = movable_mass_matrix(robot, robot.home)
    inertia = np.abs(matrix.T @ of_movable @ matrix) + armatures
    bound = np.sqrt(np.outer(np.diag(inertia), np.diag(of_movable)))
    of_group = np.maximum(np.abs(of_movable @ matrix).T, bound * (gains.T > 0))
    is_grouped = (gains > 0) @ ((gains > 0).sum(axis=0) > 1)
    alone = inertia @ gains.T
    is_mimic = [robot.joints[k].mimic is not None for k in robot.movable_joints]
    return np.where(is_grouped, np.maximum(alone, of_group), alone), np.where(is_mimic, bound, 0.0)
