"""Edit kinematic trees: cut out subtrees, rename, scale, and group rigidly joined links."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from morphgen.errors import RobotError, nearest
from morphgen.model.geometry import Pose, scale_pose, scale_shape, scale_vector
from morphgen.model.robot import Inertial, Joint, Link, Robot, sorted_pair
from morphgen.model.rotation import Vec3, rotate


def subtree(robot: Robot, root: str, without: Collection[str] = ()) -> Robot:
    """Return a link and all below it, with the joints, home, frames and ignore pairs among them."""
    for name in (root, *without):
        robot.link(name)
    kept = {root}
    joints: list[Joint] = []
    for joint in robot.joints:
        if joint.parent in kept and joint.child not in without:
            kept.add(joint.child)
            joints.append(joint)
    names = {joint.name for joint in joints}
    for joint in joints:
        if joint.mimic is not None and joint.mimic.joint not in names:
            raise RobotError(
                f"robot {robot.name!r}: joint {joint.name!r} mimics {joint.mimic.joint!r}, "
                f"which is not in the part below {root!r}" + nearest(joint.mimic.joint, names)
            )
    home = dict(zip(robot.independent_joints, robot.home, strict=True))
    return replace(
        robot,
        links=tuple(robot.link(name) for name in (root, *(joint.child for joint in joints))),
        joints=tuple(joints),
        home=tuple(home[robot.joint_index[j.name]] for j in joints if j.is_independent),
        frames=tuple(frame for frame in robot.frames if frame.link in kept),
        ignore_pairs=tuple((a, b) for a, b in robot.ignore_pairs if a in kept and b in kept),
    )


def below(parents: Sequence[int], root: int) -> list[int]:
    """Return the indices of a node of a tree and of all below it; parents come before children."""
    nodes = [root]
    for i in range(root + 1, len(parents)):
        if parents[i] in nodes:
            nodes.append(i)
    return nodes


def take_name(name: str, taken: set[str]) -> str:
    """Return a name, with a number from 2 on if it is taken, and add it to the taken names."""
    unique, k = name, 1
    while unique in taken:
        k += 1
        unique = f"{name}_{k}"
    taken.add(unique)
    return unique


def rename(
    robot: Robot, links: Mapping[str, str] | None = None, joints: Mapping[str, str] | None = None
) -> Robot:
    """Return a robot whose links and joints have new names, given by their old ones."""
    new_link = {link.name: link.name for link in robot.links} | dict(links or {})
    new_joint = {joint.name: joint.name for joint in robot.joints} | dict(joints or {})
    return replace(
        robot,
        links=tuple(replace(link, name=new_link[link.name]) for link in robot.links),
        joints=tuple(
            replace(
                joint,
                name=new_joint[joint.name],
                parent=new_link[joint.parent],
                child=new_link[joint.child],
                mimic=joint.mimic and replace(joint.mimic, joint=new_joint[joint.mimic.joint]),
            )
            for joint in robot.joints
        ),
        frames=tuple(replace(frame, link=new_link[frame.link]) for frame in robot.frames),
        ignore_pairs=tuple(
            sorted(
                sorted_pair(new_link.get(a, a), new_link.get(b, b)) for a, b in robot.ignore_pairs
            )
        ),
    )


def scale_links(
    robot: Robot, factors: Mapping[str, float], faces: Mapping[str, Vec3] | None = None
) -> Robot:
    """Scale links about their origins: shapes, mass properties, joints and frames on them.

    At constant density, mass scales with the third power of the factor and inertia with the fifth.
    A link that touches its parent elsewhere than at its origin would separate from it: ``faces``
    has these points [m] by link. A joint moves so that they coincide; along its axis if it can.
    """
    faces = faces or {}
    for name in (*factors, *faces):
        robot.link(name)

    def factor(link: str) -> float:
        return factors.get(link, 1.0)

    return replace(
        robot,
        links=tuple(_scale_link(link, factor(link.name)) for link in robot.links),
        joints=tuple(
            _scale_joint(joint, factor(joint.parent), factor(joint.child), faces.get(joint.child))
            for joint in robot.joints
        ),
        frames=tuple(
            replace(frame, T_link_frame=scale_pose(frame.T_link_frame, factor(frame.link)))
            for frame in robot.frames
        ),
    )


def _scale_joint(joint: Joint, parent: float, child: float, face: Vec3 | None) -> Joint:
    """Scale a joint's pose by its parent's factor and keep the child's contact point in place."""
    pose = scale_pose(joint.T_parent_joint, parent)
    if face is not None and parent != child:
        x, y, z = scale_vector(rotate(pose.quaternion, face), parent - child)
        position = (pose.position[0] + x, pose.position[1] + y, pose.position[2] + z)
        pose = Pose(position, pose.quaternion)
    return replace(joint, T_parent_joint=pose)


def _scale_link(link: Link, factor: float) -> Link:
    if factor == 1.0:
        return link
    inertial = link.inertial
    if inertial is not None:
        xx, xy, xz, yy, yz, zz = (factor**5 * value for value in inertial.inertia)
        com = scale_vector(inertial.com, factor)
        inertial = Inertial(factor**3 * inertial.mass, com, (xx, xy, xz, yy, yz, zz))
    return replace(
        link,
        inertial=inertial,
        visuals=tuple(scale_shape(shape, factor) for shape in link.visuals),
        collisions=tuple(scale_shape(shape, factor) for shape in link.collisions),
    )


@dataclass(frozen=True)
class RigidGroup:
    """Links that fixed joints hold together, so that they move as one rigid body."""

    links: tuple[Link, ...]
    """The links in topological order; a movable joint attaches the first, except for the root."""
    is_root: bool  # whether the group contains the robot's root
    mass: float  # mass of the group [kg]; negative masses count as zero
    mass_beyond: float  # mass of all groups below this one in the tree [kg]


def rigid_groups(robot: Robot) -> tuple[RigidGroup, ...]:
    """Split a robot's links at its movable joints; the root's group comes first."""
    first_link = list(range(len(robot.links)))
    for k, joint in enumerate(robot.joints):
        if not joint.is_movable:
            first_link[k + 1] = first_link[robot.parents[k + 1]]
    masses = [
        link.inertial.mass if link.inertial is not None and link.inertial.mass > 0 else 0.0
        for link in robot.links
    ]
    subtree_masses = list(masses)
    for i in range(len(robot.links) - 1, 0, -1):
        subtree_masses[robot.parents[i]] += subtree_masses[i]
    groups = []
    for first in sorted(set(first_link)):
        members = [i for i, start in enumerate(first_link) if start == first]
        mass = sum(masses[i] for i in members)
        links = tuple(robot.links[i] for i in members)
        groups.append(RigidGroup(links, first == 0, mass, subtree_masses[first] - mass))
    return tuple(groups)
