"""Checks for limitations of single loaders, most of which a bundle works around."""

from __future__ import annotations

from collections.abc import Iterator

from morphgen.checks.shapes import is_scale_valid
from morphgen.model.findings import Finding
from morphgen.model.geometry import Capsule, Mesh
from morphgen.model.robot import Robot
from morphgen.model.tree import rigid_groups

PYBULLET_LINKS = 127
"""Largest number of links below the root in PyBullet 3.2.7, which fails silently on more."""


def check_mimic_loaders(robot: Robot) -> Iterator[Finding]:
    """Report mimic joints, which some URDF loaders do not couple to their leader."""
    followers = [
        robot.joints[k].name for k in robot.movable_joints if robot.joints[k].mimic is not None
    ]
    if followers:
        yield Finding(
            "mimic-ignored-by-loaders",
            "info",
            f"robot {robot.name}",
            f"PyBullet, older MuJoCo and (unless asked) Pinocchio ignore <mimic> of "
            f"{', '.join(followers)}",
            "load robot.xml, where it is an equality, or drive the followers yourself",
        )


def check_capsules(robot: Robot) -> Iterator[Finding]:
    """Report links with capsules, which URDF does not have."""
    for link in robot.links:
        shapes = (*link.visuals, *link.collisions)
        if any(isinstance(shape.geometry, Capsule) for shape in shapes):
            yield Finding(
                "capsule-in-urdf",
                "info",
                f"link {link.name}",
                "URDF has no capsule: robot.urdf holds a cylinder and two spheres instead",
                "load robot.xml, which has the capsule itself",
            )


def check_mesh_scales(robot: Robot) -> Iterator[Finding]:
    """Report meshes that their scale mirrors or stretches."""
    for link in robot.links:
        shapes = (*link.visuals, *link.collisions)
        meshes = (shape.geometry for shape in shapes if isinstance(shape.geometry, Mesh))
        for mesh in dict.fromkeys(meshes):
            if not is_scale_valid(mesh):
                continue
            if mesh.scale[0] * mesh.scale[1] * mesh.scale[2] < 0:
                code, why = "mesh-mirrored", "mirrors it; some loaders turn it inside out"
            elif min(mesh.scale) < max(mesh.scale):
                code, why = "mesh-stretched", "stretches it; some loaders use one factor only"
            else:
                continue
            yield Finding(
                code,
                "info",
                f"link {link.name}",
                f"{mesh.path.name}: scale {mesh.scale} {why}",
                "nothing to do in a bundle, whose meshes have the scale applied",
            )


def check_link_count(robot: Robot) -> Iterator[Finding]:
    """Find robots with more links than PyBullet supports."""
    links = len(robot.links) + len(robot.frames)
    if links - 1 > PYBULLET_LINKS:
        yield Finding(
            "links-too-many",
            "error",
            f"robot {robot.name}",
            f"{links - 1} links below the root; PyBullet holds {PYBULLET_LINKS}",
            "leave out bare frames, or import a part of it with --root-link",
        )


def check_root(robot: Robot) -> Iterator[Finding]:
    """Report a base with shapes but without mass."""
    base = rigid_groups(robot)[0]
    if base.mass == 0 and any(not link.is_empty for link in base.links):
        yield Finding(
            "massless-root",
            "info",
            f"link {robot.root.name}",
            "the base has geometry but no mass: PyBullet never lets a massless base move",
            "give it a mass if the base should ever move freely",
        )
