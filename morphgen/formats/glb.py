"""Write a robot's visual shapes as one binary glTF file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import trimesh
from trimesh.exchange.gltf import export_glb
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from morphgen.errors import FormatError
from morphgen.model.geometry import Mesh, Rgba, Shape
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import joint_motions, movable_positions
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Robot
from morphgen.model.tree import take_name
from morphgen.typing import Array

GREY: Rgba = (0.7, 0.7, 0.7, 1.0)  # colour of shapes without their own
T_GLTF_ROOT = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of the robot's root in the scene: up is y in glTF and z in a robot; shape (4, 4)."""
_SHARP_ANGLE = np.radians(35.0)
"""Edges between faces that meet at a larger angle are drawn sharp, as in the viewer."""
_MAX_SMOOTHED_FACES = 150_000
"""Largest mesh whose sharp edges are searched; larger ones would take seconds [faces]."""


def glb_bytes(robot: Robot) -> bytes:
    """Return a robot at home as binary glTF; the same robot gives the same bytes.

    Links and frames are nodes of their names, visual shapes are ``LINK_visual_0`` and so on. A node
    whose name is taken gets a number.
    """
    if not any(link.visuals for link in robot.links):
        raise FormatError(f"robot {robot.name!r} has no visual shape, so a GLB would be empty")
    names = set(robot.link_index)
    scene = trimesh.Scene(base_frame=take_name("scene", names))
    for link, parent, T in zip(robot.links, robot.parents, _home_transforms(robot), strict=True):
        above = robot.links[parent].name if parent >= 0 else scene.graph.base_frame
        scene.graph.update(frame_from=above, frame_to=link.name, matrix=T)
        for i, shape in enumerate(link.visuals):
            name = take_name(f"{link.name}_visual_{i}", names)
            scene.add_geometry(
                _mesh(shape),
                node_name=name,
                geom_name=name,
                parent_node_name=link.name,
                transform=shape.T_link_shape.matrix,
            )
    for frame in robot.frames:
        name, matrix = take_name(frame.name, names), frame.T_link_frame.matrix
        scene.graph.update(frame_from=frame.link, frame_to=name, matrix=matrix)
    data: bytes = export_glb(scene, include_normals=True)
    return data


def _home_transforms(robot: Robot) -> Iterator[Array]:
    """Yield the pose of every link at home in its parent's frame, the root's in the scene."""
    yield T_GLTF_ROOT
    movable = [robot.joints[k] for k in robot.movable_joints]
    motions = iter(joint_motions(movable, movable_positions(robot, robot.home)))
    for joint in robot.joints:
        T = joint.T_parent_joint.matrix
        yield T @ next(motions) if joint.is_movable else T


def _mesh(shape: Shape) -> trimesh.Trimesh:
    """Return the surface of a shape in its own frame, with sharp edges and its colour."""
    geometry = shape.geometry
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    if len(mesh.faces) <= _MAX_SMOOTHED_FACES:
        mesh = trimesh.graph.smooth_shade(mesh, angle=_SHARP_ANGLE)
    # A cached mesh is shared, so its colour is not set.
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    rgba = shape.rgba or GREY
    mesh.visual = TextureVisuals(
        material=PBRMaterial(
            baseColorFactor=[round(255 * channel) for channel in rgba],
            metallicFactor=0.0,
            roughnessFactor=0.7,
            alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
            doubleSided=True,  # open meshes are drawn from inside, too
        )
    )
    return mesh
