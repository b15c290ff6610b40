"""Kinematics of one robot in NumPy: poses, joint axes, Jacobians and reach, in batches.

``morphgen.model.kinematics_torch`` has the same for many robots in one batch of tensors.
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.model import rotation
from morphgen.model.geometry import Pose
from morphgen.model.robot import Robot
from morphgen.model.rotation import Quat, Vec3
from morphgen.typing import Array


def joint_limits(robot: Robot) -> Array:
    """Lower and upper bound of every independent joint, shape (dof, 2), rad or m.

    Joints without limits get one turn about zero (1 m for prismatic ones).
    """
    return np.array([robot.joints[k].effective_limits for k in robot.independent_joints]).reshape(
        -1, 2
    )


def random_configurations(robot: Robot, n: int, rng: np.random.Generator) -> Array:
    """Configurations drawn uniformly between the bounds, shape (n, dof)."""
    limits = joint_limits(robot)
    return rng.uniform(limits[:, 0], limits[:, 1], size=(n, robot.dof))


def driving_joints(robot: Robot, joints: Collection[int]) -> tuple[int, ...]:
    """Independent joints, 0 to dof - 1, that are among some of all joints, or that these follow."""
    matrix, _ = robot.mimic_map
    rows = [i for i, k in enumerate(robot.movable_joints) if k in joints]
    return tuple(np.flatnonzero((matrix[rows] != 0).any(axis=0)).tolist())


def periodic_joints(robot: Robot) -> NDArray[np.bool_]:
    """Joints that are as they were after a whole turn, shape (dof,): no other joint follows one."""
    followed = (robot.mimic_map[0] != 0).sum(axis=0) > 1
    kinds = np.array([robot.joints[k].kind for k in robot.independent_joints])
    return np.asarray(np.isin(kinds, ("revolute", "continuous")) & ~followed)


def unwrap_joints(robot: Robot, start: ArrayLike, q: ArrayLike) -> Array:
    """The same poses of all links, with joints turned as little as may be.

    Args:
        robot: The body.
        start: From where, shape (dof,), rad or m.
        q: Configurations, shape (..., dof).

    Returns:
        Of the shape of ``q``: joints that may turn more than once around are turned back by whole
        turns to where they are nearest to the start within their bounds.
    """
    start, q = np.asarray(start, dtype=np.float64), np.asarray(q, dtype=np.float64)
    lower, upper = joint_limits(robot).T
    turns = np.round((start - q) / (2 * np.pi)) * periodic_joints(robot)
    least, most = ((bound - q) / (2 * np.pi) for bound in (lower, upper))
    return np.asarray(q + 2 * np.pi * np.clip(turns, np.ceil(least), np.floor(most)))


def movable_positions(robot: Robot, q: ArrayLike) -> Array:
    """Positions of all movable joints, mimic joints following their leaders.

    Args:
        robot: The body.
        q: Independent joint positions, shape (..., dof), rad or m.

    Returns:
        Positions in the order of ``robot.movable_joints``, shape (..., n_movable).

    Raises:
        ValueError: If the last axis of ``q`` is not ``robot.dof`` long.
    """
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (robot.dof,):
        raise ValueError(f"q has shape {q.shape}; {robot.name} needs (..., {robot.dof})")
    matrix, offset = robot.mimic_map
    return np.asarray(q @ matrix.T + offset)


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
    column = {k: i for i, k in enumerate(robot.movable_joints)}
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


def joint_axes(robot: Robot, T_root_link: Array) -> tuple[Array, Array]:
    """Return an anchor and the axis of the joint that moves each link, in the root frame.

    Args:
        robot: The robot.
        T_root_link: Poses of all links, shape (..., n_links, 4, 4).

    Returns:
        Anchors [m] and unit axes, both (..., n_links, 3); zeros where no joint moves the link.
    """
    anchors, axes = np.zeros((2, *T_root_link.shape[:-2], 3))
    for k in robot.movable_joints:
        anchors[..., k + 1, :] = T_root_link[..., k + 1, :3, 3]
        axes[..., k + 1, :] = T_root_link[..., k + 1, :3, :3] @ robot.joints[k].unit_axis
    return anchors, axes


def frame_jacobian(robot: Robot, q: ArrayLike, frame: str = "tool") -> tuple[Array, Array]:
    """Return the pose and the geometric Jacobian of a named frame in the root frame.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 3.1.3: a revolute
    joint with axis z and anchor p contributes (z x (p_frame - p), z), a prismatic one (z, 0).

    Args:
        robot: The robot.
        q: Independent joint positions, shape (..., dof), rad or m.
        frame: Name of the frame.

    Returns:
        ``T_root_frame``, shape (..., 4, 4), and ``J_root_frame``, shape (..., 6, dof): linear
        velocity of the frame's origin, then angular velocity; mimic joints are folded into their
        leaders.

    Raises:
        RobotError: If there is no such frame.
    """
    named = robot.frame(frame)
    T_root_link = forward_kinematics(robot, q)
    T_root_frame = T_root_link[..., robot.link_index[named.link], :, :] @ named.T_link_frame.matrix
    anchors, axes = joint_axes(robot, T_root_link)
    matrix, _ = robot.mimic_map
    row = {k: i for i, k in enumerate(robot.movable_joints)}
    jacobian = np.zeros((*T_root_frame.shape[:-2], 6, robot.dof))
    for k in robot.joint_chain(named.link):
        if k not in row:
            continue
        axis, by_leader = axes[..., k + 1, :], matrix[row[k]]
        if robot.joints[k].kind == "prismatic":
            jacobian[..., :3, :] += axis[..., None] * by_leader
            continue
        arm = T_root_frame[..., :3, 3] - anchors[..., k + 1, :]
        jacobian[..., :3, :] += np.cross(axis, arm)[..., None] * by_leader
        jacobian[..., 3:, :] += axis[..., None] * by_leader
    return np.asarray(T_root_frame), jacobian


def link_jacobians(robot: Robot, T_root_link: Array) -> Array:
    """Return the spatial Jacobian of every link in the root frame.

    Linear velocities are those of the point of a link that is at the root's origin.

    Args:
        robot: The robot.
        T_root_link: Poses of all links, shape (..., n_links, 4, 4).

    Returns:
        ``J_root_link``, shape (..., n_links, 6, n_movable): linear, then angular velocity by
        movable joint, mimic joints as joints of their own.
    """
    anchors, axes = joint_axes(robot, T_root_link)
    jacobians = np.zeros((*T_root_link.shape[:-2], 6, len(robot.movable_joints)))
    column = {k: i for i, k in enumerate(robot.movable_joints)}
    for k, joint in enumerate(robot.joints):
        jacobians[..., k + 1, :, :] = jacobians[..., robot.parents[k + 1], :, :]
        if joint.kind == "prismatic":
            jacobians[..., k + 1, :3, column[k]] = axes[..., k + 1, :]
        elif joint.is_movable:
            turned = -np.cross(axes[..., k + 1, :], anchors[..., k + 1, :])
            jacobians[..., k + 1, :3, column[k]] = turned
            jacobians[..., k + 1, 3:, column[k]] = axes[..., k + 1, :]
    return jacobians


def frame_positions(robot: Robot, q: Array, frame: str = "tool") -> Array:
    """Return positions of a named frame in the root frame, many times as fast as ``frame_pose``.

    Points are carried from the frame to the root, joint by joint, each turned to its own z axis,
    instead of multiplying poses.

    Args:
        robot: The robot.
        q: Independent joint positions, a row per joint, shape (dof, n), rad or m.
        frame: Name of the frame.

    Returns:
        Positions, shape (3, n), metres.

    Raises:
        RobotError: If there is no such frame.
    """
    gains, offsets = robot.mimic_map
    row = {k: i for i, k in enumerate(robot.movable_joints)}
    points = np.zeros((3, q.shape[1]))
    named = robot.frame(frame)
    T_joint_point = named.T_link_frame
    for k in reversed(robot.joint_chain(named.link)):
        joint = robot.joints[k]
        if joint.is_movable:
            gain, position = gains[row[k]], offsets[row[k]]
            for column in gain.nonzero()[0]:
                position = position + gain[column] * q[column]
            T_joint_axis = Pose(quaternion=_turn_from_z(joint.unit_axis))
            points = _carried(T_joint_axis.inverse() @ T_joint_point, points)
            if joint.kind == "prismatic":
                points[2] += position
            else:
                c, s, (x, y) = np.cos(position), np.sin(position), points[:2]
                points[0], points[1] = c * x - s * y, s * x + c * y
            T_joint_point = T_joint_axis
        T_joint_point = joint.T_parent_joint @ T_joint_point
    return _carried(T_joint_point, points)


def _carried(T: Pose, points: Array) -> Array:
    # einsum: a threaded matrix product costs more than it saves here
    return np.asarray(np.einsum("ij,jn->in", T.matrix[:3, :3], points) + T.matrix[:3, 3:])


def _turn_from_z(axis: Vec3) -> Quat:
    """Return a rotation that takes z to a unit axis."""
    x, y, z = axis
    if z < -0.5:  # near the opposite of z: half a turn about x first
        return rotation.multiply((0.0, 1.0, 0.0, 0.0), _turn_from_z((x, -y, -z)))
    return rotation.normalize((1 + z, -y, x, 0.0))


def reach(robot: Robot, frame: str = "tool", samples: int = 256, rounds: int = 6) -> float:
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
    limits = joint_limits(robot)
    q = random_configurations(robot, samples, rng)
    distance = _distance(robot, q, frame)
    keep = np.argsort(-distance, kind="stable")[:8]
    q, distance = q[keep], distance[keep]
    width = limits[:, 1] - limits[:, 0]
    for i in range(rounds):
        step = 0.3 * 0.5**i * width
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
    """Return distances of a frame from the root's origin at (..., dof), shape (...,), metres.

    Not by ``frame_positions``: the last bits of ``reach`` are in stored push sets.
    """
    positions = movable_positions(robot, q)
    named = robot.frame(frame)
    column = {k: i for i, k in enumerate(robot.movable_joints)}
    point = np.broadcast_to(np.array(named.T_link_frame.position), (*q.shape[:-1], 3))
    for k in reversed(robot.joint_chain(named.link)):
        joint = robot.joints[k]
        if joint.is_movable:
            point = _moved(point, joint.kind, joint.unit_axis, positions[..., column[k], None])
        T = joint.T_parent_joint.matrix
        point = point @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.sqrt((point * point).sum(axis=-1)))


def _moved(point: Array, kind: str, axis: tuple[float, float, float], position: Array) -> Array:
    """Points (..., 3) moved by a joint; a turn by Rodrigues' formula."""
    a = np.array(axis)
    if kind == "prismatic":
        return np.asarray(point + position * a)
    c, s = np.cos(position), np.sin(position)
    x, y, z = axis
    cross = point @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
    return np.asarray(point * c + cross * s + (point @ a)[..., None] * (1 - c) * a)


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
