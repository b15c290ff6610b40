"""Surgery on kinematic trees."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from morphgen.errors import RobotError, nearest
from morphgen.model.geometry import Pose, scale_pose, scale_shape, scale_vector
from morphgen.model.robot import Inertial, Joint, Link, Mimic, Robot
from morphgen.model.rotation import Vec3, rotate


def subtree(robot: Robot, root: str, without: Collection[str] = ()) -> Robot:
    """The part of a robot below a link.

    Args:
        robot: The whole.
        root: Link where the part begins.
        without: Links that are left out with all below them.

    Returns:
        The links below ``root`` and the joints, home, frames and ignore pairs among them.

    Raises:
        RobotError: If a link does not exist, or a kept joint mimics one that is not kept.
    """
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
    rest = {
        robot.joints[k].name: q for k, q in zip(robot.independent_joints, robot.home, strict=True)
    }
    return replace(
        robot,
        links=tuple(robot.link(name) for name in (root, *(joint.child for joint in joints))),
        joints=tuple(joints),
        home=tuple(rest[joint.name] for joint in joints if joint.is_independent),
        frames=tuple(frame for frame in robot.frames if frame.link in kept),
        ignore_pairs=tuple((a, b) for a, b in robot.ignore_pairs if a in kept and b in kept),
    )


def rename(
    robot: Robot, links: Mapping[str, str] | None = None, joints: Mapping[str, str] | None = None
) -> Robot:
    """A robot whose links and joints of the given names have new ones."""
    link_names, joint_names = links or {}, joints or {}

    def link(name: str) -> str:
        return link_names.get(name, name)

    def joint(name: str) -> str:
        return joint_names.get(name, name)

    def mimic(old: Mimic | None) -> Mimic | None:
        return None if old is None else replace(old, joint=joint(old.joint))

    return replace(
        robot,
        links=tuple(replace(old, name=link(old.name)) for old in robot.links),
        joints=tuple(
            replace(
                old,
                name=joint(old.name),
                parent=link(old.parent),
                child=link(old.child),
                mimic=mimic(old.mimic),
            )
            for old in robot.joints
        ),
        frames=tuple(replace(old, link=link(old.link)) for old in robot.frames),
        ignore_pairs=tuple(
            sorted((min(p), max(p)) for a, b in robot.ignore_pairs for p in [(link(a), link(b))])
        ),
    )


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


def scale_links(
    robot: Robot, factors: Mapping[str, float], faces: Mapping[str, Vec3] | None = None
) -> Robot:
    """Scale links in all directions: shapes, the joints and frames on them, and their bodies.

    At equal density, mass goes with the factor's third power and inertia with its fifth.

    A link is scaled about the origin of its frame. A link that meets its parent elsewhere, such as
    at the foot of a tube below the joint's frame, would so leave its parent or sink into it. Its
    *face*, the point where the two meet, prevents that: the joint moves so that the face of the
    scaled link lies where the scaled parent has it. With a face on the joint's axis this only
    slides the joint's frame along the axis, which changes no motion.

    Args:
        robot: The body.
        factors: Factor by the name of the link; links not named keep their size.
        faces: Where a link meets its parent before scaling, in the link's frame, metres, by the
            name of the link; the origin for links not named.

    Raises:
        RobotError: If a link does not exist.
    """
    faces = faces or {}
    for name in (*factors, *faces):
        robot.link(name)
    return replace(
        robot,
        links=tuple(_link(link, factors.get(link.name, 1.0)) for link in robot.links),
        joints=tuple(
            _joint(j, factors.get(j.parent, 1.0), factors.get(j.child, 1.0), faces.get(j.child))
            for j in robot.joints
        ),
        frames=tuple(
            replace(f, T_link_frame=scale_pose(f.T_link_frame, factors.get(f.link, 1.0)))
            for f in robot.frames
        ),
    )


def _joint(joint: Joint, parent: float, child: float, face: Vec3 | None) -> Joint:
    """The joint on a parent of that factor, with the child's face held to the parent's."""
    pose = scale_pose(joint.T_parent_joint, parent)
    if face is None or parent == child:
        return replace(joint, T_parent_joint=pose)
    x, y, z = scale_vector(rotate(pose.quaternion, face), parent - child)
    position = (pose.position[0] + x, pose.position[1] + y, pose.position[2] + z)
    return replace(joint, T_parent_joint=Pose(position, pose.quaternion))


def _link(link: Link, factor: float) -> Link:
    if factor == 1.0:
        return link
    return replace(
        link,
        inertial=link.inertial and _inertial(link.inertial, factor),
        visuals=tuple(scale_shape(shape, factor) for shape in link.visuals),
        collisions=tuple(scale_shape(shape, factor) for shape in link.collisions),
    )


def _inertial(body: Inertial, factor: float) -> Inertial:
    xx, xy, xz, yy, yz, zz = (factor**5 * value for value in body.inertia)
    return Inertial(factor**3 * body.mass, scale_vector(body.com, factor), (xx, xy, xz, yy, yz, zz))
