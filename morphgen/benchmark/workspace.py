"""Where a body's tool can go, as a density about its shoulder, and how much two of them share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from morphgen.errors import BenchmarkError, nearest
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    forward_kinematics,
    frame_positions,
    joint_axes,
    joint_limits,
    reach,
)
from morphgen.model.robot import TOOL, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array

SAMPLES = 65_536
CELLS = 10
"""Cells from the shoulder to the farthest point."""

_PARALLEL = 0.5
"""Axes whose angle has a smaller sine do not cross anywhere that means much."""
_STILL = 1e-9
"""A tool that never comes farther from its shoulder does not move, metres."""
_SEED = 0


@dataclass(frozen=True, eq=False)
class Workspace:
    """Where the tool of a robot is when its joints are anywhere within their limits."""

    density: Array
    """Share of configurations by cell: nodes of a cubic grid on [-1, 1]^3, shape (21, 21, 21)."""
    shoulder: Vec3
    """Where the grid is centred, in the root frame, metres."""
    reach: float
    """Largest distance of the tool from the shoulder, metres; 1 in the grid."""


def workspace(robot: Robot, samples: int = SAMPLES) -> Workspace:
    """Sample where the tool can go.

    Configurations are drawn uniformly within the limits of the joints that move the tool, always
    with the same seed and from the base on, so that the same arm with another hand is drawn in the
    same poses. Each sample is shared between the eight nodes around it by its distance from them.

    Args:
        robot: The body.
        samples: How many configurations.

    Raises:
        BenchmarkError: If it has no frame ``tool``, or one that no joint moves, or a joint
            without a range.
    """
    path = _tool_path(robot)
    centre = shoulder(robot)
    x, y, z = centre
    to_shoulder = Pose((-x, -y, -z))
    root = robot.root.name
    about = replace(
        robot,
        joints=tuple(
            replace(joint, T_parent_joint=to_shoulder @ joint.T_parent_joint)
            if joint.parent == root
            else joint
            for joint in robot.joints
        ),
    )
    points = frame_positions(about, _configurations(about, path, samples))
    farthest = max(reach(about, TOOL), float(np.sqrt((points * points).sum(axis=0).max())))
    if farthest < _STILL:
        raise BenchmarkError(
            f"robot {robot.name!r}: its tool only turns about its own origin, so it has no "
            "workspace; place the frame 'tool' at the working point"
        )
    return Workspace(_density(points / farthest), centre, farthest)


def density_overlap(a: Workspace, b: Workspace) -> float:
    """Share of configurations whose tools are in the same place, in [0, 1].

    The sum over all cells of the smaller density (histogram intersection: Swain and Ballard, Color
    indexing, 1991); 1 minus half the L1 distance of the two. The same body has 1.
    """
    return float(min(np.minimum(a.density, b.density).sum(), 1.0))


def shoulder(robot: Robot) -> Vec3:
    """The point of a body about which its tool goes round, in the root frame, metres.

    Not the root's origin, because a pedestal or a rail would move the whole workspace away from
    that of the same arm on the floor. Nor the origin of the first joint, which may lie anywhere
    along its axis. It is the point of the first turning axis on the way from the root to the tool
    that is nearest to the next axis across it, as in Denavit and Hartenberg's convention; where
    all axes are parallel, nearest to the tool; and the tool where nothing turns. Joints are in the
    middle of their range, which hardly matters but for slides.

    Raises:
        BenchmarkError: If there is no frame ``tool``, or one that no joint moves, or a joint
            without a range.
    """
    path = _tool_path(robot)
    T_root_link = forward_kinematics(robot, joint_limits(robot).mean(axis=1))
    tool = robot.frame(TOOL)
    T_root_tool = T_root_link[robot.link_index[tool.link]] @ tool.T_link_frame.matrix
    anchors, directions = joint_axes(robot, T_root_link)
    axes = [
        (anchors[k + 1], directions[k + 1])
        for k in path
        if robot.joints[k].kind in ("revolute", "continuous")
    ]
    if not axes:
        return _vec3(T_root_tool[:3, 3])
    origin, direction = axes[0]
    towards, across = T_root_tool[:3, 3], direction
    for point, axis in axes[1:]:
        if np.linalg.norm(np.cross(direction, axis)) > _PARALLEL:
            # Perpendicular to the other axis, in the plane of both.
            towards, across = point, direction - (direction @ axis) * axis
            break
    along = (towards - origin) @ across / (direction @ across)
    return _vec3(origin + along * direction)


def _tool_path(robot: Robot) -> tuple[int, ...]:
    names = [frame.name for frame in robot.frames]
    if TOOL not in names:
        raise BenchmarkError(
            f"robot {robot.name!r} has no frame {TOOL!r}{nearest(TOOL, names)}; name the link at "
            "its working point: morphgen import FILE --tool LINK"
        )
    path = robot.joint_chain(robot.frame(TOOL).link)
    if not _moving(robot, path):
        raise BenchmarkError(
            f"robot {robot.name!r}: no joint moves its tool, which is on link "
            f"{robot.frame(TOOL).link!r}; place the frame on a link that moves"
        )
    for k in robot.independent_joints:
        low, high = robot.joints[k].effective_limits
        if not 0 <= high - low < np.inf:
            raise BenchmarkError(
                f"robot {robot.name!r}: joint {robot.joints[k].name!r}: limits ({low:g}, {high:g}) "
                "are no range to draw from; morphgen check says how to mend them"
            )
    return path


def _moving(robot: Robot, path: Sequence[int]) -> list[int]:
    """Positions in q of the joints that move the tool, the nearest to the root first."""
    row = {k: i for i, k in enumerate(robot.movable_joints)}
    gains, _ = robot.mimic_map
    found = [int(column) for k in path if k in row for column in gains[row[k]].nonzero()[0]]
    return list(dict.fromkeys(found))


def _configurations(robot: Robot, path: tuple[int, ...], samples: int) -> Array:
    """Uniform draws for the joints that move the tool, any for the others, shape (dof, n)."""
    moving = _moving(robot, path)
    low, high = joint_limits(robot)[moving].T[..., None]
    q = np.zeros((robot.dof, samples))
    q[moving] = low + (high - low) * np.random.default_rng(_SEED).random((len(moving), samples))
    return q


def _density(points: Array) -> Array:
    """Points (3, n) of [-1, 1]^3, each shared between the nodes around it; sums to 1."""
    side = 2 * CELLS + 1
    scaled = (points + 1) * CELLS
    low = np.minimum(scaled.astype(np.int64), side - 2)
    share = np.stack([1 - (scaled - low), scaled - low])
    total = np.zeros(side**3)
    for far in np.ndindex(2, 2, 2):
        x, y, z = low + np.array(far)[:, None]
        weight = share[far[0], 0] * share[far[1], 1] * share[far[2], 2]
        total += np.bincount((x * side + y) * side + z, weight, side**3)
    return np.asarray(total.reshape(side, side, side) / points.shape[1])


def _vec3(values: Array) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)
