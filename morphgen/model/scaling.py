"""Bodies with some links larger or smaller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from morphgen.model.geometry import Pose, scaled_pose, scaled_shape, scaled_vector
from morphgen.model.robot import Inertial, Joint, Link, Robot
from morphgen.model.rotation import Vec3, rotate


def scaled(
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
            replace(f, T_link_frame=scaled_pose(f.T_link_frame, factors.get(f.link, 1.0)))
            for f in robot.frames
        ),
    )


def _joint(joint: Joint, parent: float, child: float, face: Vec3 | None) -> Joint:
    """The joint on a parent of that factor, with the child's face held to the parent's."""
    pose = scaled_pose(joint.T_parent_joint, parent)
    if face is None or parent == child:
        return replace(joint, T_parent_joint=pose)
    x, y, z = scaled_vector(rotate(pose.quaternion, face), parent - child)
    position = (pose.position[0] + x, pose.position[1] + y, pose.position[2] + z)
    return replace(joint, T_parent_joint=Pose(position, pose.quaternion))


def _link(link: Link, factor: float) -> Link:
    if factor == 1.0:
        return link
    return replace(
        link,
        inertial=link.inertial and _inertial(link.inertial, factor),
        visuals=tuple(scaled_shape(shape, factor) for shape in link.visuals),
        collisions=tuple(scaled_shape(shape, factor) for shape in link.collisions),
    )


def _inertial(body: Inertial, factor: float) -> Inertial:
    xx, xy, xz, yy, yz, zz = (factor**5 * value for value in body.inertia)
    return Inertial(
        factor**3 * body.mass, scaled_vector(body.com, factor), (xx, xy, xz, yy, yz, zz)
    )
