"""Connected components of free configuration space, as far as one or two joints divide it.

Two links that touch in the middle of joints' ranges divide the free configurations into components
that a robot never leaves. Whether two links touch depends on the joints between them. Where these
are one or two joints that move the tool, their plane is tested on a grid and labelled. Components
due to the ground, to obstacles or to links with more joints between them are not found.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

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
from morphgen.model.robot import TOOL, Pair, Robot
from morphgen.typing import Array

CELL = 0.1
"""Width of a grid cell, rad or m."""
FEWEST, MOST = 16, 128
"""Smallest and largest number of cells along a joint."""
SAMPLES = 256
"""Number of random configurations by which links that touch are found."""
OFTEN = 0.02
"""Share of these in which two links must touch for their plane to be tested."""


@dataclass(frozen=True, eq=False)
class JointPlane:
    """Free configurations of one or two joints that fall into several components."""

    pairs: tuple[Pair, ...]
    """Pairs of links that touch between the components."""
    joints: tuple[int, ...]
    """Indices of the independent joints, one or two."""
    lower: Array
    """Lower end of the grid for each of the joints, rad or m."""
    upper: Array
    """Upper end of the grid for each of the joints, rad or m."""
    main: NDArray[np.bool_]
    """Cells of the largest component, an axis for each of the joints."""
    turns: tuple[float, ...]
    """Period of each of the joints, rad; 0 if it has none."""


def cspace_components(robot: Robot) -> tuple[JointPlane, ...]:
    """Find the joint planes in which a robot's free configurations fall into components.

    Args:
        robot: The robot, with a tool.

    Returns:
        A plane for each set of joints; none for most robots.

    Raises:
        MeshError: If a collision mesh cannot be read.
    """
    tested = SelfCollisionChecker(robot, untested_pairs(robot))
    q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
    times = Counter(pair for found in tested.penetrations(q) for pair in found)
    between: dict[tuple[int, ...], list[Pair]] = defaultdict(list)
    for pair in sorted(pair for pair, count in times.items() if count >= OFTEN * SAMPLES):
        between[_between(robot, *pair)].append(pair)
    of_tool = {*driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))}
    candidates = [(k, pairs) for k, pairs in between.items() if 0 < len(k) <= 2 and {*k} <= of_tool]
    planes = [_plane(robot, tested, k, pairs) for k, pairs in candidates]
    return tuple(each for each in planes if each is not None)


def in_other_component(planes: Sequence[JointPlane], q: Array) -> NDArray[np.bool_]:
    """Return in which planes a free configuration is outside of the largest component.

    Args:
        planes: Of the robot.
        q: Joint positions, shape (dof,), rad or m.

    Returns:
        Shape (number of planes,).
    """
    return np.array([_is_outside(each, q) for each in planes], dtype=np.bool_)


def _is_outside(plane: JointPlane, q: Array) -> bool:
    """Return whether it is, however many turns are added to the joints within their bounds."""
    own, count = q[[*plane.joints]], np.array(plane.main.shape)
    for times in product(*((-2, -1, 0, 1, 2) if turn else (0,) for turn in plane.turns)):
        share = (own + np.multiply(times, plane.turns) - plane.lower) / (plane.upper - plane.lower)
        if ((share >= 0) & (share <= 1)).all():
            cell = np.minimum((share * count).astype(int), count - 1)
            if plane.main[tuple(cell.tolist())]:
                return False
    return True


def _between(robot: Robot, a: str, b: str) -> tuple[int, ...]:
    """Return the independent joints that move one of two links relative to the other."""
    return driving_joints(robot, {*robot.joint_chain(a)} ^ {*robot.joint_chain(b)})


def _plane(
    robot: Robot, tested: SelfCollisionChecker, joints: tuple[int, ...], pairs: Sequence[Pair]
) -> JointPlane | None:
    columns = [*joints]
    lower, upper = joint_limits(robot).T[:, columns]
    count = np.clip(np.ceil((upper - lower) / CELL), FEWEST, MOST).astype(int)
    middles = [
        lo + (np.arange(n) + 0.5) / n * (up - lo)
        for lo, up, n in zip(lower, upper, count, strict=True)
    ]
    q = np.tile(robot.home, (int(count.prod()), 1))
    q[:, columns] = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(len(q), -1)
    free = np.array([not found.keys() & {*pairs} for found in tested.penetrations(q)]).reshape(
        count
    )
    continuous = [robot.joints[robot.independent_joints[j]].kind == "continuous" for j in joints]
    components = _components(free, continuous)
    if components.max() < 2:
        return None
    largest = int(np.bincount(components[components > 0]).argmax())
    nearest = ndimage.distance_transform_edt(~free, return_distances=False, return_indices=True)
    turns = np.where(periodic_joints(robot)[columns], 2 * np.pi, 0.0)
    main = components[tuple(nearest)] == largest
    return JointPlane(tuple(pairs), joints, lower, upper, main, tuple(turns.tolist()))


def _components(free: NDArray[np.bool_], continuous: Sequence[bool]) -> NDArray[np.int64]:
    """Label the component of each free cell, from 1; continuous joints wrap around."""
    labels, count = ndimage.label(free, np.ones((3,) * free.ndim))
    same = np.arange(count + 1)
    for axis, goes_on in enumerate(continuous):
        if goes_on:
            first, last = (np.take(labels, i, axis=axis) for i in (0, -1))
            for a, b in zip(np.ravel(first).tolist(), np.ravel(last).tolist(), strict=True):
                if a and b:
                    same[same == same[b]] = same[a]
    return np.asarray(np.unique(same, return_inverse=True)[1][labels], dtype=np.int64)
