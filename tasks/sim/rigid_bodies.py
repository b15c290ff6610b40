"""Robots as simulators need them: rigid links merged, constant ground contacts known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from morphgen.checks.self_collision import untested_pairs
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Inertial, Link, Robot, sorted_pair
from morphgen.model.tree import rename, rigid_groups, take_name

_Piece = tuple[Pose, Link]  # pose of a link in the link that it is merged into, and the link
_UPRIGHT = 1e-6
"""Tolerance of the vertical component of an axis that is horizontal (0) or vertical (1)."""


def merge_rigid_links(robot: Robot) -> Robot:
    """Merge links that fixed joints connect, since simulators take time for every link.

    Motion and contacts stay the same. Joints keep their names, order and home; a merged link has
    the name of its first link, but a root named ``world`` is renamed. Visual shapes and frames are
    dropped. Links with collision shapes are merged only if they ignore the same other links;
    otherwise the fixed joint stays. ``ignore_pairs`` then also contain the pairs that no simulator
    should test: links of one rigid part, and neighbours across a movable joint.
    """
    ignored = {
        (a, b)
        for a, b in untested_pairs(robot)
        if robot.link(a).collisions and robot.link(b).collisions
    }
    part = {link.name: i for i, group in enumerate(rigid_groups(robot)) for link in group.links}
    partners: dict[str, set[str]] = {link.name: set() for link in robot.links}
    for a, b in ignored:
        if part[a] != part[b]:
            partners[a].add(b)
            partners[b].add(a)

    merged_name = {robot.root.name: robot.root.name}
    pieces: dict[str, list[_Piece]] = {robot.root.name: [(IDENTITY, robot.root)]}
    T_merged_link = {robot.root.name: IDENTITY}
    joints = []
    for joint, link in zip(robot.joints, robot.links[1:], strict=True):
        parent = merged_name[joint.parent]
        T_merged_joint = T_merged_link[joint.parent] @ joint.T_parent_joint
        colliding = [piece.name for _, piece in pieces[parent] if piece.collisions]
        # A merged link has one set of ignored pairs, so all of its shapes must have the same.
        same_partners = not link.collisions or all(
            partners[link.name] == partners[name] for name in colliding
        )
        if not joint.is_movable and same_partners:
            merged_name[link.name], T_merged_link[link.name] = parent, T_merged_joint
            pieces[parent].append((T_merged_joint, link))
        else:
            merged_name[link.name], T_merged_link[link.name] = link.name, IDENTITY
            pieces[link.name] = [(IDENTITY, link)]
            joints.append(replace(joint, parent=parent, T_parent_joint=T_merged_joint))
    pairs = {
        sorted_pair(merged_name[a], merged_name[b])
        for a, b in ignored
        if merged_name[a] != merged_name[b]
    }
    links = tuple(
        Link(
            name,
            merged_inertial(parts),
            collisions=tuple(
                replace(shape, T_link_shape=T @ shape.T_link_shape)
                for T, link in parts
                for shape in link.collisions
            ),
        )
        for name, parts in pieces.items()
    )
    merged = Robot(
        robot.name, links, tuple(joints), home=robot.home, ignore_pairs=tuple(sorted(pairs))
    )
    # MuJoCo reserves this name: an MJCF cannot give the link the mass of those welded to it.
    names = {"world": take_name("world", {*merged.link_index})}
    return rename(merged, names) if merged.root.name == "world" else merged


def merged_inertial(pieces: list[_Piece]) -> Inertial | None:
    """Add masses, and inertias about the common centre of mass (parallel axis theorem)."""
    massive = [
        (T.matrix, link.inertial)
        for T, link in pieces
        if link.inertial is not None and link.inertial.mass > 0
    ]
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
        matrix += inertial.mass * (d @ d * np.eye(3) - np.outer(d, d))  # Steiner
    x, y, z = com.tolist()
    return Inertial.from_matrix(float(mass), (x, y, z), matrix)


def ground_contact_links(robot: Robot, T_world_root: Pose) -> frozenset[str]:
    """Return the links that no joint raises, lowers or tilts: their ground contact is constant.

    These are the root, and links that only turn about vertical axes and slide along horizontal
    ones. No force can end such a contact, and simulators handle it badly, so neither tests these
    links against the ground. PyBullet creates one within 2 cm already, and light joints further
    along the arm are then tenths of a radian off, for any number of iterations. MuJoCo (4.0) takes
    an upright cylinder whose axis is a few last bits longer than 1 to be a radius deep in the
    plane.
    """
    T_world_link = T_world_root.matrix @ forward_kinematics(robot, np.array(robot.home))
    level = {robot.root.name}
    for k, joint in enumerate(robot.joints):
        if joint.is_movable:
            vertical = abs(float(T_world_link[k + 1, 2, :3] @ np.array(joint.unit_axis)))
            is_slide = joint.kind == "prismatic"
            stays_level = vertical < _UPRIGHT if is_slide else vertical > 1 - _UPRIGHT
        else:
            stays_level = True
        if stays_level and joint.parent in level:
            level.add(joint.child)
    return frozenset(level)
