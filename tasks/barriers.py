"""Links that touch in the middle of joints' ranges, so that a robot stays where it is of two sides.

Whether two links touch is up to the joints between them. Where these are one or two, and move the
tool, all that they can do is looked at on a grid: if what is free falls into parts, a robot never
leaves the one that it is in. What the ground, obstacles or links with more joints between them part
is not found.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from morphgen.checks.self_collision import SelfCollision, ignored_pairs
from morphgen.model.kinematics import bounds, moved_by, random_configurations, whole_turns
from morphgen.model.robot import TOOL, Pair, Robot

Array = NDArray[np.float64]

CELL = 0.1
"""Width of a cell of the grid, rad or m."""
FEWEST, MOST = 16, 128
"""Cells along a joint."""
SAMPLES = 256
"""Random configurations that say which links touch at all."""
OFTEN = 0.02
"""In which part of them they do if they part anything worth it."""


@dataclass(frozen=True, eq=False)
class Barrier:
    """What links part, in the plane of the joints between them."""

    pairs: tuple[Pair, ...]
    """The links."""
    joints: tuple[int, ...]
    """Independent joints between them, one or two."""
    lower: Array
    """Where the grid begins, rad or m, a number for each of the joints."""
    upper: Array
    """Where it ends."""
    main: NDArray[np.bool_]
    """Cells of the largest part, an axis for each of the joints."""
    turns: tuple[float, ...]
    """After how much each of the joints is as it was, rad; 0 if it never is."""


def barriers(robot: Robot) -> tuple[Barrier, ...]:
    """Where a robot's links are in the way of the joints that move its tool.

    Args:
        robot: The body, with a tool.

    Returns:
        One for each set of joints; none for most robots.

    Raises:
        MeshError: If a collision mesh cannot be read.
    """
    tested = SelfCollision(robot, ignored_pairs(robot))
    q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
    times = Counter(pair for found in tested.each(q) for pair in found)
    between: dict[tuple[int, ...], list[Pair]] = defaultdict(list)
    for pair in sorted(pair for pair, count in times.items() if count >= OFTEN * SAMPLES):
        between[_between(robot, *pair)].append(pair)
    of_tool = {*moved_by(robot, robot.joints_to(robot.frame(TOOL).link))}
    planes = [(k, pairs) for k, pairs in between.items() if 0 < len(k) <= 2 and {*k} <= of_tool]
    found = [_barrier(robot, tested, k, pairs) for k, pairs in planes]
    return tuple(each for each in found if each is not None)


def beyond(found: Sequence[Barrier], q: Array) -> NDArray[np.bool_]:
    """Which barriers a free configuration, shape (dof,), is beyond; shape (number of these,)."""
    return np.array([_is_beyond(each, q) for each in found], dtype=np.bool_)


def _is_beyond(barrier: Barrier, q: Array) -> bool:
    """Whether it is, however often the joints are turned around within their bounds."""
    own, count = q[[*barrier.joints]], np.array(barrier.main.shape)
    for times in product(*((-2, -1, 0, 1, 2) if turn else (0,) for turn in barrier.turns)):
        share = (own + np.multiply(times, barrier.turns) - barrier.lower) / (
            barrier.upper - barrier.lower
        )
        if ((share >= 0) & (share <= 1)).all():
            cell = np.minimum((share * count).astype(int), count - 1)
            if barrier.main[tuple(cell.tolist())]:
                return False
    return True


def _between(robot: Robot, a: str, b: str) -> tuple[int, ...]:
    """Independent joints that move one of two links against the other."""
    return moved_by(robot, {*robot.joints_to(a)} ^ {*robot.joints_to(b)})


def _barrier(
    robot: Robot, tested: SelfCollision, joints: tuple[int, ...], pairs: Sequence[Pair]
) -> Barrier | None:
    columns = [*joints]
    lower, upper = bounds(robot).T[:, columns]
    count = np.clip(np.ceil((upper - lower) / CELL), FEWEST, MOST).astype(int)
    middles = [
        lo + (np.arange(n) + 0.5) / n * (up - lo)
        for lo, up, n in zip(lower, upper, count, strict=True)
    ]
    q = np.tile(robot.home, (int(count.prod()), 1))
    q[:, columns] = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(len(q), -1)
    free = np.array([not found.keys() & {*pairs} for found in tested.each(q)]).reshape(count)
    endless = [robot.joints[robot.independent[j]].kind == "continuous" for j in joints]
    parts = _parts(free, endless)
    if parts.max() < 2:
        return None
    largest = int(np.bincount(parts[parts > 0]).argmax())
    nearest = ndimage.distance_transform_edt(~free, return_distances=False, return_indices=True)
    turns = np.where(whole_turns(robot)[columns], 2 * np.pi, 0.0)
    main = parts[tuple(nearest)] == largest
    return Barrier(tuple(pairs), joints, lower, upper, main, tuple(turns.tolist()))


def _parts(free: NDArray[np.bool_], endless: Sequence[bool]) -> NDArray[np.int64]:
    """Number of the part of each free cell, from 1; joints without an end go on at the other."""
    labels, count = ndimage.label(free, np.ones((3,) * free.ndim))
    same = np.arange(count + 1)
    for axis, goes_on in enumerate(endless):
        if goes_on:
            first, last = (np.take(labels, i, axis=axis) for i in (0, -1))
            for a, b in zip(np.ravel(first).tolist(), np.ravel(last).tolist(), strict=True):
                if a and b:
                    same[same == same[b]] = same[a]
    return np.asarray(np.unique(same, return_inverse=True)[1][labels], dtype=np.int64)
