"""Rigid groups: links that no movable joint separates."""

from __future__ import annotations

from dataclasses import dataclass

from morphgen.model.robot import Link, Robot


@dataclass(frozen=True)
class RigidGroup:
    """Links that move as one body."""

    links: tuple[Link, ...]
    """In topological order; a movable joint attaches the first, unless the group is the root's."""
    is_root: bool
    mass: float
    """Mass of the group, kg; negative masses count as none."""
    mass_beyond: float
    """Mass of all groups that hang on it, kg."""


def rigid_groups(robot: Robot) -> tuple[RigidGroup, ...]:
    """Split a robot at its movable joints; the root's group comes first."""
    first = list(range(len(robot.links)))
    for k, joint in enumerate(robot.joints):
        if not joint.is_movable:
            first[k + 1] = first[robot.parents[k + 1]]
    own = [_mass(link) for link in robot.links]
    subtree = list(own)
    for i in range(len(robot.links) - 1, 0, -1):
        subtree[robot.parents[i]] += subtree[i]
    groups = []
    for start in sorted(set(first)):
        members = [i for i, group in enumerate(first) if group == start]
        mass = sum(own[i] for i in members)
        groups.append(
            RigidGroup(
                tuple(robot.links[i] for i in members), start == 0, mass, subtree[start] - mass
            )
        )
    return tuple(groups)


def _mass(link: Link) -> float:
    return link.inertial.mass if link.inertial is not None and link.inertial.mass > 0 else 0.0
