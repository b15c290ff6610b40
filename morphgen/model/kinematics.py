"""Kinematics of one robot in NumPy: poses, Jacobians, reach, and inverse kinematics, in batches.

``morphgen.model.kinematics_torch`` has the same for many robots in one batch of tensors. Joint
positions ``q`` are those of the independent joints, shape (..., dof) [rad or m]; poses are
homogeneous matrices.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.model import rotation
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import TOOL, Joint, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array


def joint_limits(robot: Robot) -> Array:
    """Return limits (dof, 2) of independent joints [rad or m]; (-pi, pi) or (-1, 1) if none."""
    joints = [robot.joints[k] for k in robot.independent_joints]
    return np.array([joint.effective_limits for joint in joints]).reshape(-1, 2)


def random_configurations(robot: Robot, n: int, rng: np.random.Generator) -> Array:
    """Draw configurations uniformly within the joint limits, shape (n, dof)."""
    limits = joint_limits(robot)
    return rng.uniform(limits[:, 0], limits[:, 1], size=(n, robot.dof))


def driving_joints(robot: Robot, joints: Iterable[int]) -> tuple[int, ...]:
    """Return the columns of ``q``, 0 to dof - 1, that move given joints, in their order."""
    matrix, _ = robot.mimic_map
    rows = (robot.movable_rows[k] for k in joints if k in robot.movable_rows)
    return tuple(dict.fromkeys(j for row in rows for j in np.flatnonzero(matrix[row]).tolist()))


def periodic_joints(robot: Robot) -> NDArray[np.bool_]:
    """Return which joints (dof,) turn by 2 pi without moving a link: without mimic joints."""
    has_followers = (robot.mimic_map[0] != 0).sum(axis=0) > 1
    kinds = np.array([robot.joints[k].kind for k in robot.independent_joints])
    return np.asarray(np.isin(kinds, ("revolute", "continuous")) & ~has_followers)


def unwrap_joints(robot: Robot, q_reference: ArrayLike, q: ArrayLike) -> Array:
    """Shift periodic joints of q (..., dof) by whole turns to nearest a reference (dof,).

    All links keep their poses, and joints within their limits stay so; one beyond them stays if no
    turn leads within.
    """
    q_reference, q = np.asarray(q_reference, dtype=np.float64), np.asarray(q, dtype=np.float64)
    lower, upper = joint_limits(robot).T
    turns = np.round((q_reference - q) / (2 * np.pi))
    least, most = np.ceil((lower - q) / (2 * np.pi)), np.floor((upper - q) / (2 * np.pi))
    may_turn = periodic_joints(robot) & (least <= most)
    return np.asarray(q + 2 * np.pi * np.where(may_turn, np.clip(turns, least, most), 0.0))


def movable_positions(robot: Robot, q: ArrayLike) -> Array:
    """Return positions of ``robot.movable_joints`` (..., n_movable), mimic joints following."""
    q = np.asarray(q, dtype=np.float64)
    if q.shape[-1:] != (robot.dof,):
        raise ValueError(f"q has shape {q.shape}; {robot.name} needs (..., {robot.dof})")
    matrix, offset = robot.mimic_map
    return np.asarray(q @ matrix.T + offset)


def forward_kinematics(robot: Robot, q: ArrayLike) -> Array:
    """Return ``T_root_link``, the pose of every link in the root frame, (..., n_links, 4, 4)."""
    positions = movable_positions(robot, q)
    motions = joint_motions([robot.joints[k] for k in robot.movable_joints], positions)
    T_root_link = np.empty((*positions.shape[:-1], len(robot.links), 4, 4))
    T_root_link[..., 0, :, :] = np.eye(4)
    column = robot.movable_rows
    for k, joint in enumerate(robot.joints):
        T = T_root_link[..., robot.parents[k + 1], :, :] @ joint.T_parent_joint.matrix
        T_root_link[..., k + 1, :, :] = T @ motions[..., column[k], :, :] if k in column else T
    return T_root_link


def frame_pose(robot: Robot, q: ArrayLike, frame: str = TOOL) -> Array:
    """Return ``T_root_frame``, the pose of a named frame in the root frame, shape (..., 4, 4)."""
    target = robot.frame(frame)
    T_root_link = forward_kinematics(robot, q)[..., robot.link_index[target.link], :, :]
    return np.asarray(T_root_link @ target.T_link_frame.matrix)


def joint_axes(robot: Robot, T_root_link: Array) -> tuple[Array, Array]:
    """Return a point [m] and the direction of each link's joint axis in the root frame.

    Both have shape (..., n_links, 3), with zeros for the root and for links on fixed joints.
    """
    anchors, axes = np.zeros((2, *T_root_link.shape[:-2], 3))
    for k in robot.movable_joints:
        anchors[..., k + 1, :] = T_root_link[..., k + 1, :3, 3]
        axes[..., k + 1, :] = T_root_link[..., k + 1, :3, :3] @ robot.joints[k].unit_axis
    return anchors, axes


def frame_jacobian(robot: Robot, q: ArrayLike, frame: str = TOOL) -> tuple[Array, Array]:
    """Return pose (..., 4, 4) and geometric Jacobian (..., 6, dof) of a frame in the root frame.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 3.1.3: a revolute
    joint with axis z and anchor p contributes (z x (p_frame - p), z), a prismatic one (z, 0). Rows
    are linear, then angular velocity; mimic joints are folded into their leaders.
    """
    positions = movable_positions(robot, q)
    movable, T_last_frame = moving_chain(robot, frame)
    chain = [robot.joints[k] for k, _ in movable]
    rows = [robot.movable_rows[k] for k, _ in movable]
    if not chain:
        return (
            np.broadcast_to(T_last_frame, (*positions.shape[:-1], 4, 4)).copy(),
            np.zeros((*positions.shape[:-1], 6, robot.dof)),
        )
    slides, axes = _slides_and_axes(chain)
    T_joints = np.array([T for _, T in movable]) @ joint_motions(chain, positions[..., rows])
    for i in range(1, len(chain)):
        T_joints[..., i, :, :] = T_joints[..., i - 1, :, :] @ T_joints[..., i, :, :]
    T_root_frame = T_joints[..., -1, :, :] @ T_last_frame
    angular = (T_joints[..., :3, :3] @ axes[..., None])[..., 0]
    linear = _cross(angular, T_root_frame[..., None, :3, 3] - T_joints[..., :3, 3])
    linear, angular = (
        np.where(slides[:, None], x, y) for x, y in ((angular, linear), (0, angular))
    )
    gains = robot.mimic_map[0][rows]
    jacobian = np.concatenate([linear, angular], axis=-1).swapaxes(-1, -2) @ gains
    return T_root_frame, jacobian


def moving_chain(robot: Robot, frame: str) -> tuple[list[tuple[int, Array]], Array]:
    """Return joints that move a frame with transforms from the one before, and the last."""
    target, T = robot.frame(frame), np.eye(4)
    movable: list[tuple[int, Array]] = []
    for k in robot.joint_chain(target.link):
        T = T @ robot.joints[k].T_parent_joint.matrix
        if robot.joints[k].is_movable:
            movable.append((k, T))
            T = np.eye(4)
    return movable, T @ target.T_link_frame.matrix


def _cross(a: Array, b: Array) -> Array:
    """Return the cross products of vectors (..., 3); ``np.cross`` takes several times as long."""
    ax, ay, az, bx, by, bz = (v[..., i] for v in (a, b) for i in range(3))
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def link_jacobians(robot: Robot, T_root_link: Array) -> Array:
    """Return the spatial Jacobian of every link in the root frame, (..., n_links, 6, n_movable).

    Its linear velocity is that of the link's point that coincides with the root's origin
    (Featherstone, Rigid Body Dynamics Algorithms, 2008, section 2.2). Mimic joints have columns of
    their own.
    """
    anchors, axes = joint_axes(robot, T_root_link)
    jacobians = np.zeros((*T_root_link.shape[:-2], 6, len(robot.movable_joints)))
    column = robot.movable_rows
    for k, joint in enumerate(robot.joints):
        jacobians[..., k + 1, :, :] = jacobians[..., robot.parents[k + 1], :, :]
        if joint.kind == "prismatic":
            jacobians[..., k + 1, :3, column[k]] = axes[..., k + 1, :]
        elif joint.is_movable:
            linear = -np.cross(axes[..., k + 1, :], anchors[..., k + 1, :])
            jacobians[..., k + 1, :3, column[k]] = linear
            jacobians[..., k + 1, 3:, column[k]] = axes[..., k + 1, :]
    return jacobians


def reach_from_root(robot: Robot, frame: str = TOOL, samples: int = 256, rounds: int = 6) -> float:
    """Return the largest distance between a frame and the root's origin [m], by random search.

    The seed is fixed, so that it is a property of the robot. The travel of a prismatic base counts.
    """
    rng = np.random.default_rng(0)
    lower, upper = joint_limits(robot).T
    q = random_configurations(robot, samples, rng)
    distance = _distance(robot, q, frame)
    # Several, as the farthest may climb to a local maximum.
    best = np.argsort(-distance, kind="stable")[:8]
    q, distance = q[best], distance[best]
    rows = np.arange(len(q))
    for i in range(rounds):
        max_step = 0.3 * 0.5**i * (upper - lower)
        candidates = q[:, None, :] + rng.uniform(-1, 1, (len(q), 16, robot.dof)) * max_step
        candidates = np.clip(candidates, lower, upper)
        distances = _distance(robot, candidates, frame)
        best = distances.argmax(axis=1)
        improved = distances[rows, best] > distance
        q = np.where(improved[:, None], candidates[rows, best], q)
        distance = np.where(improved, distances[rows, best], distance)
    return float(distance.max())


def reach(robot: Robot) -> float:
    """Return the largest distance of the tool from the first joint that moves it [m].

    Data sheets of arms have this number: it does not depend on the base under the arm.
    """
    T_root_joint = IDENTITY
    for k in robot.joint_chain(robot.frame(TOOL).link):
        T_root_joint = T_root_joint @ robot.joints[k].T_parent_joint
        if robot.joints[k].is_movable:
            return reach_from_root(with_root_at(robot, T_root_joint.position))
    return reach_from_root(robot)


def with_root_at(robot: Robot, point: Vec3) -> Robot:
    """Return the robot with its root frame's origin at a point, its shapes where they are."""
    T_point_root = Pose(point).inverse()
    return replace(
        robot,
        joints=tuple(
            replace(joint, T_parent_joint=T_point_root @ joint.T_parent_joint)
            if joint.parent == robot.root.name
            else joint
            for joint in robot.joints
        ),
    )


def _distance(robot: Robot, q: Array, frame: str) -> Array:
    """Return distances of a frame from the root's origin at q (..., dof), shape (...) [m].

    ``FramePosition`` would be faster, but differs in the last bits, and these are in the edges of
    the blocks of shipped push sets. Rotations use Rodrigues' formula.
    """
    positions = movable_positions(robot, q)
    target, column = robot.frame(frame), robot.movable_rows
    point = np.broadcast_to(np.array(target.T_link_frame.position), (*q.shape[:-1], 3))
    for k in reversed(robot.joint_chain(target.link)):
        joint, T = robot.joints[k], robot.joints[k].T_parent_joint.matrix
        if joint.is_movable:
            position, axis = positions[..., column[k], None], np.array(joint.unit_axis)
            if joint.kind == "prismatic":
                point = point + position * axis
            else:
                (x, y, z), c = axis, np.cos(position)
                cross = point @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
                along = (point @ axis)[..., None] * (1 - c) * axis
                point = point * c + cross * np.sin(position) + along
        point = point @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.sqrt((point * point).sum(axis=-1)))


def _slides_and_axes(joints: Sequence[Joint]) -> tuple[NDArray[np.bool_], Array]:
    """Return which joints are prismatic, shape (k,), and their unit axes, shape (k, 3)."""
    slides = np.array([joint.kind == "prismatic" for joint in joints], dtype=np.bool_)
    return slides, np.array([joint.unit_axis for joint in joints]).reshape(-1, 3)


def joint_motions(joints: Sequence[Joint], positions: Array) -> Array:
    """Return transforms (..., k, 4, 4) of k movable joints at positions (..., k) [rad or m]."""
    slides, axes = _slides_and_axes(joints)
    T = np.zeros((*positions.shape, 4, 4))
    x, y, z = axes.T
    angles = np.where(slides, 0.0, positions)
    c, s = np.cos(angles), np.sin(angles)
    v = 1 - c
    T[..., 0, 0], T[..., 0, 1], T[..., 0, 2] = c + x * x * v, x * y * v - z * s, x * z * v + y * s
    T[..., 1, 0], T[..., 1, 1], T[..., 1, 2] = y * x * v + z * s, c + y * y * v, y * z * v - x * s
    T[..., 2, 0], T[..., 2, 1], T[..., 2, 2] = z * x * v - y * s, z * y * v + x * s, c + z * z * v
    T[..., :3, 3] = np.where(slides, positions, 0.0)[..., None] * axes
    T[..., 3, 3] = 1
    return T


class FramePosition:
    """Position of a named frame, without the rotations that ``frame_pose`` computes.

    The frame's point moves from joint to joint, each with its axis along z. Its components are
    numbers or arrays: at one configuration, a call of NumPy takes longer than what it does.
    """

    def __init__(self, robot: Robot, frame: str = TOOL) -> None:
        """Compile the joints from the frame to the root."""
        gains, offsets = robot.mimic_map
        row, target = robot.movable_rows, robot.frame(frame)
        T_joint_next = target.T_link_frame
        motions: list[tuple[int | None, float, float, bool]] = []
        transforms: list[tuple[float, ...]] = []
        for k in reversed(robot.joint_chain(target.link)):
            joint = robot.joints[k]
            if joint.is_movable:
                gain = gains[row[k]]
                leader = int(np.abs(gain).argmax()) if gain.any() else None
                factor = 0.0 if leader is None else float(gain[leader])
                T_joint_axis = Pose(quaternion=rotation.from_z(joint.unit_axis))
                transforms.append(_rows(T_joint_axis.inverse() @ T_joint_next))
                slides = joint.kind == "prismatic"
                motions.append((leader, factor, float(offsets[row[k]]), slides))
                T_joint_next = T_joint_axis
            T_joint_next = joint.T_parent_joint @ T_joint_next
        transforms.append(_rows(T_joint_next))
        self._point = transforms[0][3::4]  # in the axes of the last joint, or of the root
        self._joints = list(zip(motions, transforms[1:], strict=True))

    def __call__(self, q: Sequence[Any] | Array) -> tuple[Any, Any, Any]:
        """Return x, y and z in the root frame [m] at independent joint positions.

        q: A number for each independent joint, or an array (dof, n), which gives arrays (n,).
        """
        cos, sin = (np.cos, np.sin) if isinstance(q, np.ndarray) else (math.cos, math.sin)
        x: Any
        x, y, z = self._point
        for (leader, gain, offset, slides), T in self._joints:
            position = offset if leader is None else gain * q[leader] + offset
            if slides:
                z = z + position
            else:
                c, s = cos(position), sin(position)
                x, y = c * x - s * y, s * x + c * y
            xx, xy, xz, tx, yx, yy, yz, ty, zx, zy, zz, tz = T
            x, y, z = (
                xx * x + xy * y + xz * z + tx,
                yx * x + yy * y + yz * z + ty,
                zx * x + zy * y + zz * z + tz,
            )
        return x, y, z


def _rows(T: Pose) -> tuple[float, ...]:
    return tuple(T.matrix[:3].ravel().tolist())


def frame_positions(robot: Robot, q: Array, frame: str = TOOL) -> Array:
    """Return positions of a named frame in the root frame, (3, n) [m], at ``q`` (dof, n)."""
    points = np.empty((3, q.shape[1]))
    points[0], points[1], points[2] = FramePosition(robot, frame)(q)
    return points


DAMPING = 0.02
"""Damping of position tasks [m/rad or 1]; in ``solve_pose_ik`` it is relative to the largest
singular value of the Jacobian."""
MAX_STEP = 0.3  # largest change of a joint position in one iteration [rad or m]
POSITION_ITERATIONS = 25  # number of iterations of ``solve_position_ik``
POSE_ITERATIONS = 24
"""Maximum number of iterations of ``solve_pose_ik``, which runs while the user drags a gizmo."""
POSE_TOLERANCE = 1e-5  # weighted pose error at which solve_pose_ik stops [m]


def dls_step(J: Array, error: Array, damping: float) -> Array:
    """Return the damped least-squares step, J^T (J J^T + damping^2 I)^-1 error.

    Wampler, Manipulator inverse kinematic solutions based on vector formulations and damped
    least-squares methods, 1986. Jacobians J (..., m, dof), errors (..., m); steps (..., dof).
    """
    J_T = J.swapaxes(-1, -2)
    regularized = J @ J_T + damping**2 * np.eye(J.shape[-2])
    return np.asarray((J_T @ np.linalg.solve(regularized, error[..., None]))[..., 0])


def solve_position_ik(
    robot: Robot, q: Array, positions: Array, *, tolerance: float = 0.0
) -> tuple[Array, Array]:
    """Move tools from q (n, dof) to positions (n, 3) in the root frame by damped least squares.

    Return configurations within the joint limits and the remaining errors (n, 3) [m]. A tool within
    ``tolerance`` [m] has arrived.
    """
    low, high = joint_limits(robot).T
    q = np.clip(q, low, high)
    rows = np.arange(len(q))
    for _ in range(POSITION_ITERATIONS):
        T_root_tool, J_root_tool = frame_jacobian(robot, q[rows])
        error = positions[rows] - T_root_tool[:, :3, 3]
        if tolerance:
            away = np.linalg.norm(error, axis=1) > tolerance
            rows, error, J_root_tool = rows[away], error[away], J_root_tool[away]
            if not len(rows):
                break
        step = dls_step(J_root_tool[:, :3], error, DAMPING)
        q[rows] = np.clip(q[rows] + np.clip(step, -MAX_STEP, MAX_STEP), low, high)
    return q, positions - frame_pose(robot, q)[:, :3, 3]


def solve_pose_ik(
    robot: Robot, T_root_goal: Array, q: ArrayLike, *, rotation_weight: float = 0.2
) -> Array:
    """Move the tool to a pose, or as near as possible, by damped least squares within joint limits.

    Joints at a limit that a step would move beyond it are excluded from the step. The weight of the
    rotation error is in m/rad; 0 leaves the orientation free.
    """
    from scipy.spatial.transform import Rotation  # here, because it takes time to load

    low, high = joint_limits(robot).T
    current = best = np.clip(np.asarray(q, dtype=np.float64), low, high)
    least = np.inf
    weights = np.repeat([1.0, rotation_weight], 3)
    for _ in range(POSE_ITERATIONS):
        T_root_tool, J = frame_jacobian(robot, current)
        R_error = T_root_goal[:3, :3] @ T_root_tool[:3, :3].T
        position_error = T_root_goal[:3, 3] - T_root_tool[:3, 3]
        rotation_error = Rotation.from_matrix(R_error).as_rotvec()
        error = np.concatenate([position_error, rotation_error]) * weights
        norm = float(np.linalg.norm(error))
        if norm < least:
            best, least = current, norm
        if norm < POSE_TOLERANCE:
            break
        direction = J.T @ error
        blocked = ((current <= low) & (direction < 0)) | ((current >= high) & (direction > 0))
        weighted = np.where(blocked, 0.0, J * weights[:, None])
        damping = DAMPING * max(float(np.linalg.norm(weighted, 2)), 1e-9)
        step = dls_step(weighted, error, damping)
        # Scale all joints equally, so that the tool keeps its direction of motion.
        scale = min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-9))
        current = np.clip(current + step * scale, low, high)
    return best
