"""Bodies with some links larger or smaller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Inertial, Link, Robot
from morphgen.model.rotation import Vec3


def scaled(robot: Robot, factors: Mapping[str, float]) -> Robot:
    """Scale links in all directions: shapes, the joints and frames on them, and their bodies.

    At equal density, mass goes with the factor's third power and inertia with its fifth.

    Args:
        robot: The body.
        factors: Factor by the name of the link; links not named keep their size.

    Raises:
        RobotError: If a link does not exist.
    """
    for name in factors:
        robot.link(name)
    return replace(
        robot,
        links=tuple(_link(link, factors.get(link.name, 1.0)) for link in robot.links),
        joints=tuple(
            replace(j, T_parent_joint=_pose(j.T_parent_joint, factors.get(j.parent, 1.0)))
            for j in robot.joints
        ),
        frames=tuple(
            replace(f, T_link_frame=_pose(f.T_link_frame, factors.get(f.link, 1.0)))
            for f in robot.frames
        ),
    )


def scaled_shape(shape: Shape, factor: float) -> Shape:
    """A shape larger or smaller in all directions, about the origin of its link."""
    return replace(
        shape,
        geometry=_geometry(shape.geometry, factor),
        T_link_shape=_pose(shape.T_link_shape, factor),
    )


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
    return Inertial(factor**3 * body.mass, _vector(body.com, factor), (xx, xy, xz, yy, yz, zz))


def _geometry(geometry: Geometry, factor: float) -> Geometry:
    match geometry:
        case Box(size):
            return Box(_vector(size, factor))
        case Sphere(radius):
            return Sphere(factor * radius)
        case Cylinder(radius, length):
            return Cylinder(factor * radius, factor * length)
        case Capsule(radius, length):
            return Capsule(factor * radius, factor * length)
        case Mesh():
            return replace(geometry, scale=_vector(geometry.scale, factor))


def _pose(pose: Pose, factor: float) -> Pose:
    return pose if factor == 1.0 else Pose(_vector(pose.position, factor), pose.quaternion)


def _vector(vector: Vec3, factor: float) -> Vec3:
    return (factor * vector[0], factor * vector[1], factor * vector[2])
