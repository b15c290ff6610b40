"""Connected components of free configuration space that one or two joints divide.

Two links that touch in the middle of joints' ranges divide the free configurations into components
that no path leaves. Whether two links touch depends on the joints between them. If these are one or
two joints that move the tool, a grid over their plane is tested and labelled. Components due to the
ground, to obstacles or to links with more joints between them are not detected.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.model.kinematics import (
    driving_joints,
    joint_limits,
    periodic_joints,
    random_configurations,
)
from morphgen.model.robot import TOOL, Pair, Robot, sorted_pair
from morphgen.typing import Array

CELL = 0.1
"""Width of a grid cell [rad or m]."""
FEWEST, MOST = 16, 128
"""Smallest and largest number of cells along a joint."""
SAMPLES = 256
"""Number of random configurations that reveal which links touch."""
OFTEN = 0.02
"""Fraction of these in which two links must touch for their plane to be tested."""


@dataclass(frozen=True, eq=False)
class JointPlane:
    """Plane of one or two joints in which free configurations form several components."""

    pairs: tuple[Pair, ...]
    """Pairs of links that touch between the components."""
    joints: tuple[int, ...]
    """Indices of the independent joints, one or two."""
    lower: Array
    """Lower end of the grid for each joint [rad or m]."""
    upper: Array
    """Upper end of the grid for each joint [rad or m]."""
    main: NDArray[np.bool_]
    """Cells of the largest component, an axis for each joint."""
    turns: tuple[float, ...]
    """Period of each joint [rad]; 0 if it does not wrap."""


def cspace_components(robot: Robot) -> tuple[JointPlane, ...]:
    """Find the joint planes in which a robot's free configurations form several components.

    Args:
        robot: The robot, with a tool.

    Returns:
        A plane for each set of joints; none for most robots.

    Raises:
        MeshError: If a collision mesh cannot be read.
    """
    checker = SelfCollisionChecker(robot, untested_pairs(robot))
    q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
    counts = Counter(pair for contacts in checker.penetrations(q) for pair in contacts)
    pairs_of: dict[tuple[int, ...], list[Pair]] = defaultdict(list)
    for a, b in sorted(pair for pair, count in counts.items() if count >= OFTEN * SAMPLES):
        chains = {*robot.joint_chain(a)} ^ {*robot.joint_chain(b)}
        pairs_of[driving_joints(robot, chains)].append((a, b))
    tool_joints = {*driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))}
    planes = [
        _joint_plane(robot, joints, pairs)
        for joints, pairs in pairs_of.items()
        if 0 < len(joints) <= 2 and {*joints} <= tool_joints
    ]
    return tuple(plane for plane in planes if plane is not None)


def in_other_component(planes: Sequence[JointPlane], q: Array) -> NDArray[np.bool_]:
    """Return in which planes a free configuration is outside of the largest component.

    Args:
        planes: Joint planes of the robot.
        q: Joint positions, shape (dof,) [rad or m].

    Returns:
        Shape (number of planes,).
    """
    return np.array([_is_outside(plane, q) for plane in planes], dtype=np.bool_)


def _is_outside(plane: JointPlane, q: Array) -> bool:
    """Return whether no equivalent of q within the limits, up to full turns, is in ``main``."""
    position, count = q[[*plane.joints]], np.array(plane.main.shape)
    for times in product(*((-2, -1, 0, 1, 2) if turn else (0,) for turn in plane.turns)):
        fraction = (position + np.multiply(times, plane.turns) - plane.lower) / (
            plane.upper - plane.lower
        )
        if ((fraction >= 0) & (fraction <= 1)).all():
            cell = np.minimum((fraction * count).astype(int), count - 1)
            if plane.main[tuple(cell.tolist())]:
                return False
    return True


def _joint_plane(robot: Robot, joints: tuple[int, ...], pairs: Sequence[Pair]) -> JointPlane | None:
    """Return the plane of one or two joints; None if its free cells form one component."""
    columns = [*joints]
    lower, upper = joint_limits(robot).T[:, columns]
    count = np.clip(np.ceil((upper - lower) / CELL), FEWEST, MOST).astype(int)
    cell_centres = [
        lo + (np.arange(n) + 0.5) / n * (up - lo)
        for lo, up, n in zip(lower, upper, count, strict=True)
    ]
    q = np.tile(robot.home, (int(count.prod()), 1))
    q[:, columns] = np.stack(np.meshgrid(*cell_centres, indexing="ij"), axis=-1).reshape(len(q), -1)
    names = [link.name for link in robot.links]
    others = {sorted_pair(a, b) for a, b in combinations(names, 2)} - {*pairs}
    free = SelfCollisionChecker(robot, sorted(others)).free(q).reshape(count)
    continuous = [robot.joints[robot.independent_joints[j]].kind == "continuous" for j in joints]
    components = _components(free, continuous)
    if components.max() < 2:
        return None
    largest = int(np.bincount(components[components > 0]).argmax())
    nearest = ndimage.distance_transform_edt(~free, return_distances=False, return_indices=True)
    periods = np.where(periodic_joints(robot)[columns], 2 * np.pi, 0.0)
    main = components[tuple(nearest)] == largest
    return JointPlane(tuple(pairs), joints, lower, upper, main, tuple(periods.tolist()))


def _components(free: NDArray[np.bool_], continuous: Sequence[bool]) -> NDArray[np.int64]:
    """Label the component of each free cell, from 1; continuous joints wrap around."""
    labels, count = ndimage.label(free, np.ones((3,) * free.ndim))
    merged_label = np.arange(count + 1)
    for axis, wraps in enumerate(continuous):
        if wraps:
            first, last = (np.take(labels, i, axis=axis) for i in (0, -1))
            for a, b in zip(np.ravel(first).tolist(), np.ravel(last).tolist(), strict=True):
                if a and b:
                    merged_label[merged_label == merged_label[b]] = merged_label[a]
    return np.asarray(np.unique(merged_label, return_inverse=True)[1][labels], dtype=np.int64)
