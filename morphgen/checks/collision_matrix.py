"""Reasons why collisions of two links need no test, as MoveIt's setup assistant finds them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np

from morphgen.checks.self_collision import ALWAYS_SHARE, SelfCollisionChecker
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Pair, Robot, sorted_pair

Reason = Literal["Adjacent", "Default", "Always", "Never", "User"]
REASONS: tuple[Reason, ...] = ("Adjacent", "Default", "Always", "Never", "User")
"""Reasons in the order in which they apply; a pair gets the first one."""
_ANY_AXIS = (1.0, 0.0, 0.0)
MATRIX_SAMPLES = 10_000
"""Number of sampled configurations, the default of MoveIt's setup assistant."""


@dataclass(frozen=True)
class CollisionMatrix:
    """Pairs of links whose collisions need no test, with reasons and evidence."""

    reasons: dict[Pair, Reason]
    """Reason of every pair that needs no test, the pairs sorted."""
    collisions: dict[Pair, int]
    """Number of sampled configurations in which a pair collides, for pairs that collide in any."""
    num_pairs: int
    """Number of pairs of links with collision shapes."""
    samples: int
    """Number of sampled configurations."""
    seed: int
    """Seed of the configurations."""

    @property
    def counts(self) -> dict[Reason, int]:
        """Number of pairs by reason."""
        count = Counter(self.reasons.values())
        return {reason: count[reason] for reason in REASONS}


def collision_matrix(
    robot: Robot, *, samples: int = MATRIX_SAMPLES, seed: int = 0
) -> CollisionMatrix:
    """Find the pairs of links whose collisions need no test.

    A pair is ``Adjacent`` if a joint links it, also across links without collision shapes;
    ``Default`` if it collides at home; ``Always`` if it collides in at least ``ALWAYS_SHARE`` of
    the sampled configurations; ``Never`` if it collides in none of them; and ``User`` if it is in
    ``robot.ignore_pairs`` for another reason. All other pairs need a test.

    As in all collision checks, meshes count as their convex hulls. Hulls contain their meshes, so
    that a pair whose hulls never collide is safe for planners that test the meshes, too.

    Args:
        robot: The robot.
        samples: Number of configurations, drawn uniformly within the joint limits.
        seed: Seed of the configurations.

    Raises:
        MeshError: If a collision mesh cannot be read.
        RobotError: If MuJoCo refuses the shapes, or contacts exceed its memory.
    """
    loose, columns = _with_loose_joints(robot)
    collidable = [link.name for link in robot.links if link.collisions]
    pairs = sorted({sorted_pair(a, b) for a, b in combinations(collidable, 2)})
    checker = SelfCollisionChecker(loose, ())
    q = np.zeros((samples + 1, loose.dof))
    q[0, columns] = robot.home
    q[1:, columns] = random_configurations(robot, samples, np.random.default_rng(seed))
    penetrations = checker.penetrations(q)
    at_home = next(penetrations)
    collisions = Counter(pair for depths in penetrations for pair in depths)
    adjacent = linked_pairs(robot)
    reasons: dict[Pair, Reason] = dict.fromkeys(robot.ignore_pairs, "User")
    for pair in pairs:
        if pair in adjacent:
            reasons[pair] = "Adjacent"
        elif pair in at_home:
            reasons[pair] = "Default"
        elif collisions[pair] >= ALWAYS_SHARE * samples:
            reasons[pair] = "Always"
        elif not collisions[pair]:
            reasons[pair] = "Never"
    return CollisionMatrix(
        dict(sorted(reasons.items())), dict(sorted(collisions.items())), len(pairs), samples, seed
    )


def linked_pairs(robot: Robot) -> frozenset[Pair]:
    """Return the pairs of a link and its nearest ancestor, of links with collision shapes.

    Unlike ``morphgen.checks.self_collision.adjacent_pairs``, links on fixed joints are not merged:
    only a joint makes two links adjacent, as in MoveIt.
    """
    nearest_collidable: list[int] = []
    """For every link, itself if it has collision shapes, else its nearest ancestor with some."""
    pairs = set()
    for i, (link, parent) in enumerate(zip(robot.links, robot.parents, strict=True)):
        ancestor = nearest_collidable[parent] if parent >= 0 else -1
        nearest_collidable.append(i if link.collisions else ancestor)
        if link.collisions and ancestor >= 0:
            pairs.add(sorted_pair(link.name, robot.links[ancestor].name))
    return frozenset(pairs)


def _with_loose_joints(robot: Robot) -> tuple[Robot, list[int]]:
    """Replace fixed joints by slides, because MuJoCo never tests links on fixed joints.

    Returns:
        The robot with slides, which stay at zero, and the columns of its ``q`` that hold the
        independent joints of the original.
    """
    joints = tuple(
        joint if joint.is_movable else replace(joint, kind="prismatic", axis=_ANY_AXIS, mimic=None)
        for joint in robot.joints
    )
    independent = [k for k, joint in enumerate(joints) if joint.is_independent]
    loose = replace(robot, joints=joints, home=(0.0,) * len(independent))
    return loose, [independent.index(k) for k in robot.independent_joints]
