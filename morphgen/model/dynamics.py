"""Joint-space inertia, and the position-control gains that follow from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from morphgen.model.kinematics import forward_kinematics, link_jacobians
from morphgen.model.robot import Robot
from morphgen.typing import Array

BANDWIDTH = 30.0
"""Natural frequency of the position control that the gains give, rad/s."""
MIN_RELATIVE_INERTIA = 0.05
"""Least inertia of a joint, relative to the robot's largest of its kind, turning or sliding.

Geared motors add their rotor's inertia, times the square of the gear ratio, to the joint; a wrist
with the gains of its own few grams would give way to a touch. Descriptions hardly ever name it.
"""
MIN_ROTATIONAL_INERTIA = 0.02
"""Least inertia of a joint that turns, kg m^2.

For bodies that are light everywhere: what the motor of a small hobby arm adds would otherwise be
left out, and the friction of a block of 0.1 kg turn the wrist that pushes it. MuJoCo Menagerie
(SO-ARM100, UR10e) has 0.1 in every joint.
"""
MIN_SLIDING_MASS = 1e-5
"""Least inertia of a joint that slides, kg."""


@dataclass(frozen=True)
class Actuation:
    """Position control of one independent joint."""

    joint: str
    stiffness: float
    """N m/rad or N/m."""
    damping: float
    """N m s/rad or N s/m."""
    armature: float
    """Inertia that the motor adds to the joint, kg m^2 or kg."""
    effort: float | None
    """Largest torque or force, N m or N; None where the source names none."""
    velocity: float | None
    """Largest speed, rad/s or m/s; None where the source names none."""


def mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Joint-space inertia at one configuration, by body Jacobians: sum of J^T I J.

    Args:
        robot: The body, its root held in the world.
        q: Independent joint positions, shape (dof,), rad or m.

    Returns:
        Symmetric matrix, shape (dof, dof); mimic joints are folded into their leaders.
    """
    T_root_link = forward_kinematics(robot, np.asarray(q, dtype=np.float64))
    J_root_link = link_jacobians(robot, T_root_link)
    M = np.zeros((len(robot.movable_joints),) * 2)
    for i, link in enumerate(robot.links):
        if link.inertial is None or link.inertial.mass == 0:
            continue
        R = T_root_link[i, :3, :3]
        com = T_root_link[i, :3, 3] + R @ np.array(link.inertial.com)
        angular = J_root_link[i, 3:]
        linear = J_root_link[i, :3] + np.cross(angular, com, axis=0)
        M += link.inertial.mass * linear.T @ linear
        M += angular.T @ (R @ link.inertial.matrix @ R.T) @ angular
    matrix, _ = robot.mimic_map
    return np.asarray(matrix.T @ M @ matrix)


def actuation(robot: Robot) -> tuple[Actuation, ...]:
    """Gains of every independent joint from the body's inertia at home.

    Stiffness is omega^2 I and damping 2 omega I (critical), with omega = ``BANDWIDTH`` and I
    the joint's diagonal entry of the joint-space inertia at home, with the motor's: see
    ``MIN_RELATIVE_INERTIA`` and ``MIN_ROTATIONAL_INERTIA``.
    """
    inertia = np.diag(mass_matrix(robot, robot.home))
    slides = np.array(
        [robot.joints[k].kind == "prismatic" for k in robot.independent_joints], dtype=bool
    )
    least = np.zeros(robot.dof)
    for kind, floor in ((slides, MIN_SLIDING_MASS), (~slides, MIN_ROTATIONAL_INERTIA)):
        least[kind] = max(MIN_RELATIVE_INERTIA * inertia[kind].max(initial=0.0), floor)
    total = np.maximum(inertia, least)
    return tuple(
        Actuation(
            robot.joints[k].name,
            stiffness=BANDWIDTH**2 * value,
            damping=2 * BANDWIDTH * value,
            armature=added,
            effort=robot.joints[k].effort,
            velocity=robot.joints[k].velocity,
        )
        for k, value, added in zip(
            robot.independent_joints, total.tolist(), (total - inertia).tolist(), strict=True
        )
    )
