"""The law of joint motors in all simulators: lag, speed limits and force limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.robot import Joint, Robot
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP
from morphgen.typing import Array


def constant(value: float) -> Array:
    """Return a number as an array without axes, with which NumPy takes half of the time."""
    return np.array(value, np.float64)


def clamp(values: Array, bound: Array) -> Array:
    """Return values within +-bound: ``np.clip`` at a quarter of its overhead."""
    return np.minimum(np.maximum(values, -bound), bound)


def is_within(values: NDArray[Any], bound: float) -> bool:
    """Return whether all magnitudes are at most a bound; NaN is not."""
    flat = values.ravel()
    # They are if the root of the sum of their squares is, which is fast to test.
    return float(flat.dot(flat)) <= bound**2 or bool(np.abs(flat).max(initial=0.0) <= bound)


LAG = 2 / BANDWIDTH + TIMESTEP * SUBSTEPS
"""Largest delay of a joint behind a target that moves steadily in control steps [s]."""
FASTEST_TURN, FASTEST_SLIDE = 10.0, 1.0
"""Speed of joints without a limit [rad/s, m/s]: the benchmark's largest steps at 50 Hz."""
GAIN = 1 / (1 - 2 * BANDWIDTH * TIMESTEP)
"""Factor of the law's gains in MuJoCo, and so of the force of a held joint in all simulators.

MuJoCo integrates damping implicitly, v' = (v + dt s e) / (1 + dt d) at unit inertia. With
s = ``GAIN`` omega^2 and d = ``GAIN`` 2 omega this is v' = v + dt (omega^2 e - 2 omega v), as in
other simulators.
"""


_KEEP, _PULL = 1 - 2 * BANDWIDTH * TIMESTEP, BANDWIDTH**2 * TIMESTEP
CONTROL_STEP = np.linalg.matrix_power(
    np.array([[1 - TIMESTEP * _PULL, -TIMESTEP * _KEEP], [_PULL, _KEEP]]), SUBSTEPS
)
"""Matrix A of a control step with a constant target: (error, velocity) at the end are A times those
at the beginning, shape (2, 2).

A physics step is v' = v + dt (omega^2 e - 2 omega v), q' = q + dt v', as in MuJoCo. Tools that
follow the exact solution of the differential equation are several times as far from MuJoCo's, which
``tests/tasks/test_kinematic_sim.py`` checks.
"""


def speed_limit(joint: Joint) -> float:
    """Return the largest speed of a joint [rad/s or m/s]."""
    return joint.velocity or (FASTEST_SLIDE if joint.kind == "prismatic" else FASTEST_TURN)


def farthest_targets(robot: Robot, joints: Sequence[int]) -> list[float]:
    """Return the largest distance of some joints from their targets that pulls [rad or m]."""
    return [LAG * speed_limit(robot.joints[k]) for k in joints]
