"""A robot with as few bodies as it has rigid parts, for simulators that pay for every link."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from morphgen.checks.self_collision import untested_pairs
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Inertial, Link, Robot, sorted_pair
from morphgen.model.tree import rigid_groups

_Piece = tuple[Pose, Link]


def rigid_bodies(robot: Robot) -> Robot:
    """Join links that fixed joints hold together; all that moves and touches stays the same.

    Joints keep their names, order and home; a body has the name of its first link. Visual shapes
    and frames are dropped. Two links with collision shapes become one body only if they ignore the
    same others; otherwise the fixed joint stays.

    Args:
        robot: The body.

    Returns:
        A robot whose ``ignore_pairs`` also name the pairs that no simulator should test: links of
        one rigid part and neighbours across a movable joint.
    """
    ignored = set(untested_pairs(robot))
    partners = _partners(robot, ignored)
    holder = {robot.root.name: robot.root.name}
    pieces: dict[str, list[_Piece]] = {robot.root.name: [(IDENTITY, robot.root)]}
    T_body_link = {robot.root.name: IDENTITY}
    joints = []
    for joint, link in zip(robot.joints, robot.links[1:], strict=True):
        body = holder[joint.parent]
        T_body_joint = T_body_link[joint.parent] @ joint.T_parent_joint
        others = [piece.name for _, piece in pieces[body] if piece.collisions]
        alike = not link.collisions or all(partners[link.name] == partners[o] for o in others)
        if not joint.is_movable and alike:
            holder[link.name], T_body_link[link.name] = body, T_body_joint
            pieces[body].append((T_body_joint, link))
            continue
        holder[link.name], T_body_link[link.name] = link.name, IDENTITY
        pieces[link.name] = [(IDENTITY, link)]
        joints.append(replace(joint, parent=body, T_parent_joint=T_body_joint))
    pairs = {
        sorted_pair(holder[a], holder[b])
        for a, b in ignored
        if holder[a] != holder[b] and robot.link(a).collisions and robot.link(b).collisions
    }
    links = tuple(_body(name, found) for name, found in pieces.items())
    return Robot(
        robot.name, links, tuple(joints), home=robot.home, ignore_pairs=tuple(sorted(pairs))
    )


def _partners(robot: Robot, ignored: Iterable[tuple[str, str]]) -> dict[str, set[str]]:
    """What every link ignores outside its own rigid part."""
    part = {link.name: i for i, g in enumerate(rigid_groups(robot)) for link in g.links}
    partners: dict[str, set[str]] = {link.name: set() for link in robot.links}
    for a, b in ignored:
        if part[a] != part[b] and robot.link(a).collisions and robot.link(b).collisions:
            partners[a].add(b)
            partners[b].add(a)
    return partners


def _body(name: str, pieces: list[_Piece]) -> Link:
    collisions = tuple(
        replace(shape, T_link_shape=T @ shape.T_link_shape)
        for T, link in pieces
        for shape in link.collisions
    )
    return Link(name, _inertial(pieces), collisions=collisions)


def _inertial(pieces: list[_Piece]) -> Inertial | None:
    """Masses added, inertias about the common centre of mass (parallel axes)."""
    found = [(T.matrix, link.inertial) for T, link in pieces if link.inertial is not None]
    massive = [(T, inertial) for T, inertial in found if inertial.mass > 0]
    if not massive:
        return None
    if len(pieces) == 1:
        return massive[0][1]
    masses = np.array([inertial.mass for _, inertial in massive])
    centres = np.array([T[:3, :3] @ np.array(i.com) + T[:3, 3] for T, i in massive])
    mass = masses.sum()
    com = masses @ centres / mass
    matrix = np.zeros((3, 3))
    for (T, inertial), centre in zip(massive, centres, strict=True):
        d = centre - com
        matrix += T[:3, :3] @ inertial.matrix @ T[:3, :3].T
        matrix += inertial.mass * (d @ d * np.eye(3) - np.outer(d, d))
    x, y, z = com.tolist()
    return Inertial.from_matrix(float(mass), (x, y, z), matrix)
