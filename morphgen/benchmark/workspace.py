"""Workspaces: the density of a robot's tool positions around its shoulder, and their overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.errors import BenchmarkError, nearest
from morphgen.model.kinematics import (
    forward_kinematics,
    frame_positions,
    joint_axes,
    joint_limits,
    reach,
    with_root_at,
)
from morphgen.model.robot import TOOL, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array

SAMPLES = 65_536
"""Number of random configurations."""
CELLS = 10
"""Number of grid cells between the shoulder and the farthest tool position."""

_PARALLEL = 0.5
"""Sine of the angle below which two axes count as parallel."""
_IMMOBILE = 1e-9
"""Distance from the shoulder below which a tool counts as immobile [m]."""
_SEED = 0


@dataclass(frozen=True, eq=False)
class Workspace:
    """Density of a robot's tool positions over uniformly distributed joint positions."""

    density: Array
    """Share of configurations at each node of a grid on [-1, 1]^3, shape (21, 21, 21)."""
    shoulder: Vec3
    """Centre of the grid in the root frame [m]."""
    reach: float
    """Largest distance of the tool from the shoulder, the unit of the grid [m]."""


def workspace(robot: Robot, samples: int = SAMPLES) -> Workspace:
    """Sample the tool positions of a robot.

    Configurations are drawn uniformly within the limits of the joints that move the tool. The seed
    is fixed and joints are drawn from the base on, so that one arm with different grippers gets the
    same arm configurations. Each sample is distributed over the eight nodes around it by trilinear
    weights.
    """
    points, centre, farthest = _tool_points(robot, samples)
    return Workspace(_density(points / farthest), centre, farthest)


def tool_reach(robot: Robot) -> tuple[Vec3, float]:
    """Return the ``shoulder`` and the ``reach`` of a robot's ``workspace``."""
    _, centre, farthest = _tool_points(robot, SAMPLES)
    return centre, farthest


def _tool_points(robot: Robot, samples: int) -> tuple[Array, Vec3, float]:
    """Return tool positions from the shoulder, (3, n), the shoulder and the largest distance."""
    chain = _tool_chain(robot)
    centre = shoulder(robot)
    centred = with_root_at(robot, centre)
    points = frame_positions(centred, _configurations(centred, chain, samples))
    farthest = max(reach(centred, TOOL), float(np.sqrt((points * points).sum(axis=0).max())))
    if farthest < _IMMOBILE:
        raise BenchmarkError(
            f"robot {robot.name!r}: its tool only turns about its own origin, so it has no "
            "workspace; place the frame 'tool' at the working point"
        )
    return points, centre, farthest


def density_overlap(a: Workspace, b: Workspace) -> float:
    """Return the overlap of two densities, in [0, 1]; 1 for equal robots.

    The sum of the smaller density over all nodes (histogram intersection: Swain and Ballard, Color
    indexing, 1991), which is 1 minus half the L1 distance.
    """
    return float(min(np.minimum(a.density, b.density).sum(), 1.0))


def shoulder(robot: Robot) -> Vec3:
    """Return the point of a robot around which its tool moves, in the root frame [m].

    The root's origin would not do, because a pedestal or a rail would shift the workspace against
    that of the same arm on the floor; nor the origin of the first joint, which may be anywhere on
    its axis. The shoulder is the point on the first rotational axis between root and tool that is
    nearest to the next axis not parallel to it, as in the Denavit-Hartenberg convention. If all
    axes are parallel, it is the point nearest to the tool; without rotational joints, the tool
    itself. Joints are in the middle of their range, which matters for prismatic joints only.
    """
    chain = _tool_chain(robot)
    T_root_link = forward_kinematics(robot, joint_limits(robot).mean(axis=1))
    tool = robot.frame(TOOL)
    T_root_tool = T_root_link[robot.link_index[tool.link]] @ tool.T_link_frame.matrix
    anchors, directions = joint_axes(robot, T_root_link)
    axes = [
        (anchors[k + 1], directions[k + 1])
        for k in chain
        if robot.joints[k].kind in ("revolute", "continuous")
    ]
    if not axes:
        return _vec3(T_root_tool[:3, 3])
    origin, direction = axes[0]
    target, normal = T_root_tool[:3, 3], direction
    for point, axis in axes[1:]:
        if np.linalg.norm(np.cross(direction, axis)) > _PARALLEL:
            # The normal is perpendicular to the other axis, in the plane of both directions.
            target, normal = point, direction - (direction @ axis) * axis
            break
    along = (target - origin) @ normal / (direction @ normal)
    return _vec3(origin + along * direction)


def _tool_chain(robot: Robot) -> tuple[int, ...]:
    """Return the indices of the joints between root and tool, after checking tool and limits."""
    names = [frame.name for frame in robot.frames]
    if TOOL not in names:
        raise BenchmarkError(
            f"robot {robot.name!r} has no frame {TOOL!r}{nearest(TOOL, names)}; name the link at "
            "its working point: morphgen import FILE --tool LINK"
        )
    chain = robot.joint_chain(robot.frame(TOOL).link)
    if not _moving(robot, chain):
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
    return chain


def _moving(robot: Robot, chain: Sequence[int]) -> list[int]:
    """Return the columns of q that move the joints of a chain, nearest to the root first."""
    row = {k: i for i, k in enumerate(robot.movable_joints)}
    gains, _ = robot.mimic_map
    columns = [int(column) for k in chain if k in row for column in gains[row[k]].nonzero()[0]]
    return list(dict.fromkeys(columns))


def _configurations(robot: Robot, chain: tuple[int, ...], samples: int) -> Array:
    """Draw uniform positions of the joints that move the tool, (dof, n); zeros for others."""
    moving = _moving(robot, chain)
    low, high = joint_limits(robot)[moving].T[..., None]
    q = np.zeros((robot.dof, samples))
    q[moving] = low + (high - low) * np.random.default_rng(_SEED).random((len(moving), samples))
    return q


def _density(points: Array) -> Array:
    """Return the density of points (3, n) in [-1, 1]^3 on the grid, with trilinear weights."""
    side = 2 * CELLS + 1
    scaled = (points + 1) * CELLS
    low = np.minimum(scaled.astype(np.int64), side - 2)
    weights = np.stack([1 - (scaled - low), scaled - low])
    total = np.zeros(side**3)
    for corner in np.ndindex(2, 2, 2):
        x, y, z = low + np.array(corner)[:, None]
        weight = weights[corner[0], 0] * weights[corner[1], 1] * weights[corner[2], 2]
        total += np.bincount((x * side + y) * side + z, weight, side**3)
    return np.asarray(total.reshape(side, side, side) / points.shape[1])


def _vec3(values: Array) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)
