"""Self-collision at home."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from morphgen.checks.joints import is_axis_valid
from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.checks.solids import is_sound
from morphgen.model.findings import Finding
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Link, Robot


def check_self_collision(robot: Robot) -> Iterator[Finding]:
    """Find pairs of links that penetrate each other at home.

    Neighbours across a joint and ``robot.ignore_pairs`` are left out, and so are shapes that
    cannot be read. A robot whose joints cannot be placed at home is not tested.
    """
    placeable = all(is_axis_valid(robot.joints[k]) for k in robot.movable_joints)
    if not placeable or not np.isfinite(movable_positions(robot, robot.home)).all():
        return
    touchable = robot.with_links(map(_sound, robot.links))
    tested = SelfCollisionChecker(touchable, untested_pairs(touchable))
    for (a, b), depth in sorted(next(tested.penetrations([robot.home])).items()):
        yield Finding(
            "self-collision",
            "warning",
            f"links {a}, {b}",
            f"at home they penetrate each other by {1000 * depth:.3g} mm",
            "move home, or ignore the pair if the overlap is by design",
        )


def _sound(link: Link) -> Link:
    sound = tuple(shape for shape in link.collisions if is_sound(shape.geometry))
    return replace(link, collisions=sound)
