"""Batched forward kinematics in NumPy, and what follows from it."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.model.robot import Robot

Array = NDArray[np.float64]


def bounds(robot: Robot) -> Array:
    """Lower and upper bound of every independent joint, shape (dof, 2), rad or m.

    Joints without limits get one turn about zero (1 m for prismatic ones).
    """
    return np.array([robot.joints[k].bounds for k in robot.independent]).reshape(-1, 2)


def random_configurations(robot: Robot, n: int, rng: np.random.Generator) -> Array:
    """Configurations drawn uniformly between the bounds, shape (n, dof)."""
    limits = bounds(robot)
    return rng.uniform(limits[:, 0], limits[:, 1], size=(n, robot.dof))


def movable_positions(robot: Robot, q: ArrayLike) -> Array:
    """Positions of all movable joints, mimic joints following their leaders.

    Args:
        robot: The body.
        q: Independent joint positions, shape (..., dof), rad or m.

    Returns:
        Positions in the order of ``robot.movable``, shape (..., n_movable).

    Raises:
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (robot.dof,):
        raise ValueError(f"q has shape {q.shape}; {robot.name} needs (..., {robot.dof})")
    matrix, offset = mimic_map(robot)
    return np.asarray(q @ matrix.T + offset)


def mimic_map(robot: Robot) -> tuple[Array, Array]:
    """The affine map from independent to movable positions.

    Returns:
        Matrix (n_movable, dof) and offset (n_movable,); chains of mimic joints are followed.
    """
    column = {robot.joints[k].name: i for i, k in enumerate(robot.independent)}
    matrix = np.zeros((len(robot.movable), robot.dof))
    offset = np.zeros(len(robot.movable))
    for row, k in enumerate(robot.movable):
        joint, gain, shift = robot.joints[k], 1.0, 0.0
        while joint.mimic is not None:
            shift += gain * joint.mimic.offset
            gain *= joint.mimic.multiplier
            joint = robot.joints[robot.joint_index[joint.mimic.joint]]
        if joint.name in column:
            matrix[row, column[joint.name]] = gain
        offset[row] = shift
    return matrix, offset


def forward_kinematics(robot: Robot, q: ArrayLike) -> Array:
    """Pose of every link in the root frame.

    Args:
        robot: The body.
        q: Independent joint positions, shape (..., dof), rad or m.

    Returns:
        ``T_root_link``, shape (..., n_links, 4, 4).

    Raises:
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    positions = movable_positions(robot, q)
    batch = positions.shape[:-1]
    T_root_link = np.empty((*batch, len(robot.links), 4, 4))
    T_root_link[..., 0, :, :] = np.eye(4)
    column = {k: i for i, k in enumerate(robot.movable)}
    for k, joint in enumerate(robot.joints):
        T = T_root_link[..., robot.parents[k + 1], :, :] @ joint.T_parent_joint.matrix
        if joint.is_movable:
            T = T @ _joint_motion(joint.kind, joint.unit_axis, positions[..., column[k]])
        T_root_link[..., k + 1, :, :] = T
    return T_root_link


def frame_pose(robot: Robot, q: ArrayLike, frame: str = "tool") -> Array:
    """Pose of a named frame in the root frame, shape (..., 4, 4).

    Raises:
        RobotError: If the robot has no such frame.
    """
    named = robot.frame(frame)
    T_root_link = forward_kinematics(robot, q)[..., robot.link_index[named.link], :, :]
    return np.asarray(T_root_link @ named.T_link_frame.matrix)


def reach(robot: Robot, frame: str = "tool", samples: int = 512, rounds: int = 24) -> float:
    """Largest distance between a frame and the root's origin, metres.

    Random configurations, the best of which climb by shrinking random steps; the seed is
    fixed, so that the figure is a property of the body. Prismatic bases count.

    Args:
        robot: The body.
        frame: Name of the frame.
        samples: Configurations drawn first.
        rounds: Rounds of climbing.

    Raises:
        RobotError: If the robot has no such frame.
    """
    rng = np.random.default_rng(0)
    limits = bounds(robot)
    q = random_configurations(robot, samples, rng)
    distance = _distance(robot, q, frame)
    keep = np.argsort(-distance, kind="stable")[:8]
    q, distance = q[keep], distance[keep]
    width = limits[:, 1] - limits[:, 0]
    for i in range(rounds):
        step = 0.3 * 0.8**i * width
        trial = q[:, None, :] + rng.uniform(-1, 1, (len(q), 16, robot.dof)) * step
        trial = np.clip(trial, limits[:, 0], limits[:, 1])
        found = _distance(robot, trial, frame)
        best = found.argmax(axis=1)
        rows = np.arange(len(q))
        better = found[rows, best] > distance
        q = np.where(better[:, None], trial[rows, best], q)
        distance = np.where(better, found[rows, best], distance)
    return float(distance.max())


def _distance(robot: Robot, q: Array, frame: str) -> Array:
    return np.asarray(np.linalg.norm(frame_pose(robot, q, frame)[..., :3, 3], axis=-1))


def _joint_motion(kind: str, axis: tuple[float, float, float], position: Array) -> Array:
    """Transform of a joint moved to ``position`` (...,), shape (..., 4, 4)."""
    T = np.zeros((*position.shape, 4, 4))
    if kind == "prismatic":
        T[..., :, :] = np.eye(4)
        T[..., :3, 3] = position[..., None] * np.array(axis)
        return T
    x, y, z = axis
    c, s = np.cos(position), np.sin(position)
    v = 1 - c
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
    T[..., 3, 3] = 1
    return T
