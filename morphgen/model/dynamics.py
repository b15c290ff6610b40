"""Joint-space inertia, and the position-control gains that follow from it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from morphgen.model.kinematics import forward_kinematics, link_jacobians
from morphgen.model.robot import Inertial, Robot
from morphgen.typing import Array

GRAVITY = 9.81  # gravity along -z [m/s^2]
BANDWIDTH = 30.0  # natural frequency of the position control [rad/s]
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
MIN_SLIDING_MASS = 1e-5  # smallest inertia of a prismatic joint [kg]
COUPLED_INERTIA = 0.5
"""Smallest inertia of a leader, relative to that of its followers and itself, and smallest armature
of a follower, relative to the inertia that it carries.

MuJoCo solves constraints as if damping were explicit, and then integrates it implicitly. A motor's
damping over a step, 0.43 of the inertia in the environments, must not throw what it pushes against:
the link between a rod and the motor on it, or a leader that its followers outweigh. With less
inertia there the equality of a mimic joint and the motor work against each other, and the joint
comes off by radians. Rods and gears of real linkages carry that reaction to the frame.
"""


@dataclass(frozen=True)
class Actuation:
    """Position control of one independent joint."""

    joint: str  # name of the joint
    stiffness: float  # proportional gain [N m/rad or N/m]
    damping: float  # derivative gain [N m s/rad or N s/m]
    armature: float  # inertia that the motor adds to the joint [kg m^2 or kg]
    effort: float | None  # effort limit [N m or N]; None if the source names none
    velocity: float | None  # velocity limit [rad/s or m/s]; None if the source names none


def mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Return the joint-space inertia (dof, dof) at q (dof,), mimic joints in their leaders."""
    matrix, _ = robot.mimic_map
    return np.asarray(matrix.T @ movable_mass_matrix(robot, q) @ matrix)


def movable_mass_matrix(robot: Robot, q: ArrayLike) -> Array:
    """Return the joint-space inertia as if mimic joints were free, the sum of J^T I J over links.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 7.1.1. The matrix is
    symmetric, shape (n_movable, n_movable).
    """
    M = np.zeros((len(robot.movable_joints),) * 2)
    for inertial, R, linear, angular in _motions_of_masses(robot, q):
        M += inertial.mass * linear.T @ linear
        M += angular.T @ (R @ inertial.matrix @ R.T) @ angular
    return M


def gravity_load(robot: Robot, q: ArrayLike) -> Array:
    """Return the forces that hold the weight of an upright robot, the sum of J^T m g over links.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 7.1.3. Every movable
    joint has a force, mimic joints their own, shape (n_movable,) [N m or N].
    """
    forces = np.zeros(len(robot.movable_joints))
    for inertial, _, linear, _ in _motions_of_masses(robot, q):
        forces += inertial.mass * GRAVITY * linear[2]
    return forces


def _motions_of_masses(
    robot: Robot, q: ArrayLike
) -> Iterator[tuple[Inertial, Array, Array, Array]]:
    """Yield links with mass: rotation, and Jacobians (3, n_movable) of the centre and rotation."""
    T_root_link = forward_kinematics(robot, np.asarray(q, dtype=np.float64))
    J_root_link = link_jacobians(robot, T_root_link)
    for T, J, link in zip(T_root_link, J_root_link, robot.links, strict=True):
        if link.inertial is not None and link.inertial.mass != 0:
            com = T[:3, 3] + T[:3, :3] @ np.array(link.inertial.com)
            linear = J[:3] + np.cross(J[3:], com, axis=0)
            yield link.inertial, T[:3, :3], linear, J[3:]


def armature(robot: Robot) -> Array:
    """Return the inertia that motors add to joints (n_movable,) [kg m^2 or kg]: ``actuation``."""
    return _inertias(robot)[1]


def actuation(robot: Robot) -> tuple[Actuation, ...]:
    """Return the position-control gains of every independent joint, from the inertia at home.

    A joint with inertia I is critically damped at the frequency omega = ``BANDWIDTH`` by the
    stiffness omega^2 I and the damping 2 omega I. I is raised by an armature, which mimic joints
    that follow share; see ``COUPLED_INERTIA``.
    """
    inertias, armatures = _inertias(robot)
    joints = [robot.joints[k] for k in robot.independent_joints]
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
            joints, inertias.tolist(), armatures[robot.independent_rows].tolist(), strict=True
        )
    )


def _inertias(robot: Robot) -> tuple[Array, Array]:
    """Return the inertias that gains assume, (dof,), and the armatures in them, (n_movable,)."""
    matrix, _ = robot.mimic_map
    of_movable = movable_mass_matrix(robot, robot.home)
    carried = np.diag(of_movable)
    rows = robot.independent_rows
    follows = matrix**2
    follows[rows] = 0
    armatures = COUPLED_INERTIA * carried
    armatures[rows] = 0
    inertia = np.diag(matrix.T @ of_movable @ matrix) + follows.T @ armatures
    prismatic = np.array(
        [robot.joints[k].kind == "prismatic" for k in robot.independent_joints], dtype=bool
    )
    least = np.zeros(robot.dof)
    for kind, floor in ((prismatic, MIN_SLIDING_MASS), (~prismatic, MIN_ROTATIONAL_INERTIA)):
        least[kind] = max(MIN_RELATIVE_INERTIA * inertia[kind].max(initial=0.0), floor)
    of_followers = inertia - carried[rows]  # what a leader carries by its mimic joints
    total = np.maximum(np.maximum(inertia, least), of_followers / (1 - COUPLED_INERTIA))
    added = total - inertia
    ratio = follows.sum(axis=0)
    motor = np.where(ratio > 0, np.clip(COUPLED_INERTIA * total - carried[rows], 0, added), added)
    armatures[rows] = motor
    share = np.divide(added - motor, ratio, out=np.zeros(robot.dof), where=ratio > 0)
    return total, armatures + (follows > 0) @ share
