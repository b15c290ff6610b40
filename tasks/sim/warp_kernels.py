"""Kernels of the Warp simulator: control law, resets, and the state that the batch reads."""

from __future__ import annotations

import warp as wp

from morphgen.model.dynamics import BANDWIDTH
from morphgen.tasks.sim.base import GAIN
from morphgen.tasks.sim.mujoco_model import PASSIVE
from morphgen.tasks.sim.mujoco_sim import BY_ERROR, BY_VELOCITY, MAX_SPEED

wp.set_module_options({"enable_backward": False})  # half of the code to compile

_BY_ERROR = wp.constant(float(BY_ERROR))
_BY_VELOCITY = wp.constant(float(BY_VELOCITY))
_PASSIVE_LEAD = wp.constant(PASSIVE * 2.0 / BANDWIDTH)
_PER_ACCELERATION = wp.constant(1.0 / (GAIN * BANDWIDTH**2))
_MAX_SPEED = wp.constant(MAX_SPEED)


@wp.struct
class Joints:
    """Indices in a group of worlds with one structure; R rows of numbers, world w has row w % R."""

    env: wp.array[int]  # environment of each world
    q_at: wp.array[int]  # index in `qpos` of each independent joint
    qd_at: wp.array[int]  # index in `qvel` of each independent joint
    dof_leader: wp.array[int]
    """Independent joint that each degree of freedom follows; -1 for those of the block."""
    dof_gain: wp.array2d[float]
    """Velocity of each degree of freedom per velocity of its leader, (R, nv)."""
    dof_q_at: wp.array[int]  # index in `qpos` of each degree of freedom that has a leader
    dof_offset: wp.array2d[float]
    """Position of each degree of freedom where its leader is at zero, (R, nv) [rad or m]."""
    compliance: wp.array2d[float]  # inverse gain of each actuator, (R, J) [rad/N m or m/N]
    farthest: wp.array2d[float]
    """Largest distance between a target and its joint, (R, J) [rad or m]."""
    block_q_at: int  # first index in `qpos` of the block's pose, or -1
    block_qd_at: int  # first index in `qvel` of its linear velocity
    object_q_at: int  # index in `qpos` of the joint of an articulated object, or -1
    object_is_slide: int  # whether it is prismatic
    object_frame: wp.array2d[float]
    """Pose in the world of the joint's frame at zero: x, y, z, qw, qx, qy, qz, (R, 7)."""
    object_axis: wp.array2d[float]
    """Axis of the joint in the world, then in its own frame; contact point of a hinge, (R, 9)."""
    obstacles: wp.array[int]  # indices in `mocap_pos` of the obstacles


@wp.func
def _law(
    joints: Joints,
    targets: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    world: int,
    joint: int,
) -> wp.vec2:
    """Return the error of an independent joint, and the law's mean acceleration in the step."""
    farthest = joints.farthest[world % joints.farthest.shape[0], joint]
    error = targets[joints.env[world], joint] - qpos[world, joints.q_at[joint]]
    error = wp.clamp(error, -farthest, farthest)
    mean = _BY_ERROR * error + _BY_VELOCITY * qvel[world, joints.qd_at[joint]]
    return wp.vec2(error, mean)


@wp.kernel
def accelerations(
    joints: Joints,
    targets: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    damping: wp.array2d[float],
    acceleration: wp.array2d[float],
    applied: wp.array2d[float],
) -> None:
    """Compute the law's mean acceleration in a control step, and forces that cancel damping.

    Threads: (worlds, nv). See ``PositionControl``.
    """
    world, dof = wp.tid()
    joint = joints.dof_leader[dof]
    value = float(0.0)
    if joint >= 0:
        law = _law(joints, targets, qpos, qvel, world, joint)
        value = joints.dof_gain[world % joints.dof_gain.shape[0], dof] * law[1]
    acceleration[world, dof] = value
    applied[world, dof] = damping[world % damping.shape[0], dof] * qvel[world, dof]


@wp.kernel
def controls(
    joints: Joints,
    targets: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    force: wp.array2d[float],
    bias: wp.array2d[float],
    weight: wp.array2d[float],
    control: wp.array2d[float],
) -> None:
    """Compute the targets of the actuators, with the missing force of inverse dynamics.

    Threads: (worlds, J). See ``PositionControl``.
    """
    world, joint = wp.tid()
    missing = float(0.0)
    for dof in range(joints.dof_leader.shape[0]):
        if joints.dof_leader[dof] == joint:
            gain = joints.dof_gain[world % joints.dof_gain.shape[0], dof]
            missing += gain * (force[world, dof] + bias[world, dof] - weight[world, dof])
    law = _law(joints, targets, qpos, qvel, world, joint)
    control[world, joint] = (
        missing * joints.compliance[world % joints.compliance.shape[0], joint]
        + qpos[world, joints.q_at[joint]]
        + law[0]
        - _PASSIVE_LEAD * qvel[world, joints.qd_at[joint]]
        - _PER_ACCELERATION * law[1]
    )


@wp.func
def _object(joints: Joints, row: int) -> tuple[wp.vec3, wp.quat, wp.vec3, wp.vec3]:
    """Return origin and rotation of an object's joint at zero, and its axis in world and joint."""
    frame, axes = joints.object_frame[row], joints.object_axis[row]
    return (
        wp.vec3(frame[0], frame[1], frame[2]),
        wp.quat(frame[4], frame[5], frame[6], frame[3]),
        wp.vec3(axes[0], axes[1], axes[2]),
        wp.vec3(axes[3], axes[4], axes[5]),
    )


@wp.kernel
def read_state(
    joints: Joints,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    out_q: wp.array2d[float],
    out_qd: wp.array2d[float],
    out_pose: wp.array2d[float],
    out_velocity: wp.array2d[float],
) -> None:
    """Write the state of a group's worlds into the rows of their environments; see ``Simulation``.

    Threads: (worlds,).
    """
    world = wp.tid()
    env = joints.env[world]
    for joint in range(joints.q_at.shape[0]):
        out_q[env, joint] = qpos[world, joints.q_at[joint]]
        out_qd[env, joint] = qvel[world, joints.qd_at[joint]]
    if joints.object_q_at >= 0:
        row = world % joints.object_frame.shape[0]
        position = qpos[world, joints.object_q_at]
        origin, turn, direction, axis = _object(joints, row)
        if joints.object_is_slide == 1:
            origin = origin + position * direction
        else:
            half = wp.sin(position / 2.0)
            moved = wp.quat(half * axis[0], half * axis[1], half * axis[2], wp.cos(position / 2.0))
            turn = turn * moved
            offset = joints.object_axis[row]
            origin += wp.quat_rotate(turn, wp.vec3(offset[6], offset[7], offset[8]))
        side = wp.where(turn[3] < 0.0, -1.0, 1.0)
        out_pose[env, 3] = side * turn[3]
        for k in range(3):
            out_pose[env, k] = origin[k]
            out_pose[env, k + 4] = side * turn[k]
    if joints.block_q_at >= 0:
        sign = wp.where(qpos[world, joints.block_q_at + 3] < 0.0, -1.0, 1.0)  # qw >= 0
        for k in range(3):
            out_pose[env, k] = qpos[world, joints.block_q_at + k]
            out_velocity[env, k] = qvel[world, joints.block_qd_at + k]
        for k in range(3, 7):
            out_pose[env, k] = sign * qpos[world, joints.block_q_at + k]


@wp.kernel
def find_diverged(
    joints: Joints,
    ignored_overflow: int,
    group: int,
    targets: wp.array2d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    overflow: wp.array[int],
    out_diverged: wp.array[wp.uint8],
    counts: wp.array2d[int],
) -> None:
    """Mark the environments of a group that diverged in a step.

    Threads: (worlds,). A world diverged if a target, a position or a velocity is not finite, if a
    velocity is beyond ``MAX_SPEED``, or if its contacts do not fit into the memory.
    """
    world = wp.tid()
    env = joints.env[world]
    bad = int(0)
    for joint in range(joints.q_at.shape[0]):
        if not wp.isfinite(targets[env, joint]):
            bad = 1
    for at in range(qpos.shape[1]):
        if not wp.isfinite(qpos[world, at]):
            bad = 1
    for dof in range(qvel.shape[1]):
        if not wp.abs(qvel[world, dof]) <= _MAX_SPEED:
            bad = 1
    bits = overflow[world] & (~ignored_overflow)
    if bad != 0:
        wp.atomic_add(counts, group, 0, 1)
    if bits != 0:
        wp.atomic_add(counts, group, 1, 1)
    out_diverged[env] = wp.uint8(wp.where(bad != 0 or bits != 0, 1, 0))


@wp.kernel
def reset_worlds(
    joints: Joints,
    mask: wp.array[wp.uint8],
    q: wp.array2d[float],
    object_pose: wp.array2d[float],
    obstacle_poses: wp.array3d[float],
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    warmstart: wp.array2d[float],
    mocap_pos: wp.array2d[wp.vec3],
    mocap_quat: wp.array2d[wp.quat],
    overflow: wp.array[int],
) -> None:
    """Put the worlds of masked environments at rest, and forget their past.

    Threads: (worlds,). Besides state and warm start, a step of MuJoCo Warp reads only what it
    computed itself. Without obstacle poses, (n, 0, 7), obstacles stay where they are.
    """
    world = wp.tid()
    env = joints.env[world]
    if mask[env] == wp.uint8(0):
        return
    for dof in range(qvel.shape[1]):
        qvel[world, dof] = 0.0
        warmstart[world, dof] = 0.0
        leader = joints.dof_leader[dof]
        if leader >= 0:
            gain = joints.dof_gain[world % joints.dof_gain.shape[0], dof]
            offset = joints.dof_offset[world % joints.dof_offset.shape[0], dof]
            qpos[world, joints.dof_q_at[dof]] = gain * q[env, leader] + offset
    overflow[world] = 0
    if joints.block_q_at >= 0:
        for k in range(7):
            qpos[world, joints.block_q_at + k] = object_pose[env, k]
    if joints.object_q_at >= 0:
        origin, turn, direction, axis = _object(joints, world % joints.object_frame.shape[0])
        pose = object_pose[env]
        moved = wp.quat_inverse(turn) * wp.quat(pose[4], pose[5], pose[6], pose[3])
        along = wp.dot(wp.vec3(pose[0], pose[1], pose[2]) - origin, direction)
        angle = 2.0 * wp.atan2(wp.dot(wp.vec3(moved[0], moved[1], moved[2]), axis), moved[3])
        angle = wp.where(angle > wp.pi, angle - 2.0 * wp.pi, angle)
        angle = wp.where(angle < -wp.pi, angle + 2.0 * wp.pi, angle)
        qpos[world, joints.object_q_at] = wp.where(joints.object_is_slide == 1, along, angle)
    if obstacle_poses.shape[1] > 0:
        for k in range(joints.obstacles.shape[0]):
            pose = obstacle_poses[env, k]
            at = joints.obstacles[k]
            mocap_pos[world, at] = wp.vec3(pose[0], pose[1], pose[2])
            # MuJoCo's quaternions are (w, x, y, z), also in arrays of Warp's quat (x, y, z, w).
            mocap_quat[world, at] = wp.quat(pose[3], pose[4], pose[5], pose[6])
