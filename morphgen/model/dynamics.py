"""Joint-space inertia, and the position-control gains that follow from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from morphgen.model.kinematics import forward_kinematics, link_jacobians
from morphgen.model.robot import Robot
from morphgen.typing import Array

GRAVITY = 9.81
"""Gravity along -z [m/s^2]."""
BANDWIDTH = 30.0
"""Natural frequency of the position control [rad/s]."""
MIN_RELATIVE_INERTIA = 0.05
"""Smallest inertia of a joint, relative to the robot's largest among its revolute or its prismatic
joints.

Geared motors add the inertia of their rotor, times the square of the gear ratio, to the joint.
Descriptions hardly ever name it. Without it, gains from the few grams of a wrist would let the
wrist yield to the lightest contact.
"""
MIN_ROTATIONAL_INERTIA = 0.02
"""Smallest inertia of a revolute joint [kg m^2], for robots that are light everywhere.

It stands for the motor of a small hobby arm, without which the friction of a 0.1 kg block would
turn the wrist that pushes it. MuJoCo Menagerie (SO-ARM100, UR10e) has 0.1 in every joint.
"""
MIN_SLIDING_MASS = 1e-5
"""Smallest inertia of a prismatic joint [kg]."""


@dataclass(frozen=True)
class Actuation:
    """Position control of one independent joint."""

    joint: str
    """Name of the joint."""
    stiffness: float
    """Proportional gain [N m/rad or N/m]."""
    damping: float
    """Derivative gain [N m s/rad or N s/m]."""
    armature: float
    """Inertia that the motor adds to the joint [kg m^2 or kg]."""
    effort: float | None
    """Effort limit [N m or N]; None if the source names none."""
    velocity: float | None
    """Velocity limit [rad/s or m/s]; None if the source names none."""


def mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Return the joint-space inertia at one configuration, the sum of J^T I J over all links.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 7.1.1.

    Args:
        robot: The robot, its root fixed in the world.
        q: Independent joint positions, shape (dof,) [rad or m].

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


def gravity_load(robot: Robot, q: ArrayLike) -> Array:
    """Return the forces that hold the weight of an upright robot, the sum of J^T m g over links.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 7.1.3.

    Args:
        robot: The robot, its root fixed in the world.
        q: Independent joint positions, shape (dof,) [rad or m].

    Returns:
        Force of every movable joint, shape (n_movable,) [N m or N]; mimic joints have their own.
    """
    T_root_link = forward_kinematics(robot, np.asarray(q, dtype=np.float64))
    J_root_link = link_jacobians(robot, T_root_link)
    forces = np.zeros(len(robot.movable_joints))
    for T, J, link in zip(T_root_link, J_root_link, robot.links, strict=True):
        if link.inertial is not None:
            com = T[:3, 3] + T[:3, :3] @ np.array(link.inertial.com)
            rise = (J[:3] + np.cross(J[3:], com, axis=0))[2]
            forces += link.inertial.mass * GRAVITY * rise
    return forces


def actuation(robot: Robot) -> tuple[Actuation, ...]:
    """Return the position-control gains of every independent joint, from the inertia at home.

    A joint with inertia I is critically damped at the frequency omega = ``BANDWIDTH`` by the
    stiffness omega^2 I and the damping 2 omega I. I is the joint's diagonal entry of the
    joint-space inertia, raised by an armature to ``MIN_RELATIVE_INERTIA`` and
    ``MIN_ROTATIONAL_INERTIA`` or ``MIN_SLIDING_MASS``.
    """
    inertia = np.diag(mass_matrix(robot, robot.home))
    joints = [robot.joints[k] for k in robot.independent_joints]
    prismatic = np.array([joint.kind == "prismatic" for joint in joints], dtype=bool)
    least = np.zeros(robot.dof)
    for kind, floor in ((prismatic, MIN_SLIDING_MASS), (~prismatic, MIN_ROTATIONAL_INERTIA)):
        least[kind] = max(MIN_RELATIVE_INERTIA * inertia[kind].max(initial=0.0), floor)
    total = np.maximum(inertia, least)
    return tuple(
        Actuation(
            joint.name,
            stiffness=BANDWIDTH**2 * value,
            damping=2 * BANDWIDTH * value,
            armature=added,
            effort=joint.effort,
            velocity=joint.velocity,
        )
        for joint, value, added in zip(
            joints, total.tolist(), (total - inertia).tolist(), strict=True
        )
    )
