"""A population in viser's scene: one instanced mesh per prototype, moved by one batch of arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import torch
import trimesh
import viser
from numpy.typing import NDArray

from morphgen.model.geometry import Box, Cylinder, Mesh, Sphere
from morphgen.model.kinematics_torch import quaternion_from_matrix
from morphgen.model.mesh import load_mesh
from morphgen.typing import Array
from morphgen.viewer.population import Population, Prototype, shape_poses
from morphgen.viewer.scene.stage import SHARP_ANGLE, Rgb, Triangles, batch_colours, triangles

NODE = "/population"
MAX_FACES = 3000
"""Largest number of faces of a mesh that is drawn as it is [faces]; larger ones are simplified."""
MAX_SHADOWS = 300
"""Largest population that casts shadows [robots]: viser draws shadows up to 20 m from the camera,
which is nearer than larger ones are seen from, and each would be drawn four times."""
_CYLINDER_SECTIONS = 24
_SPHERE_SUBDIVISIONS = 2
_FADED_SHARE = 0.8
"""Share of the background's colour in the robots that are not selected, while others are."""


@dataclass(eq=False)
class PopulationScene:
    """A population in the scene of one browser."""

    client: viser.ClientHandle
    population: Population
    handles: Mapping[Prototype, viser.BatchedMeshHandle]
    positions: Array
    """Positions of the roots on the ground, shape (n, 2) [m]."""
    T_world_shape: NDArray[np.float32]
    """Current pose of every instance, shape (m, 4, 4)."""
    labels: list[viser.LabelHandle] = field(default_factory=list)


def add_population(
    client: viser.ClientHandle, population: Population, positions: Array, q: Array
) -> PopulationScene:
    """Draw a population.

    positions: Positions of their roots on the ground, shape (n, 2) [m].
    q: Independent joint positions, shape (n, J) [rad or m].
    """
    instances = population.instances
    poses = world_poses(population, positions, q)
    wxyzs = quaternions(poses)
    handles = {}
    for number, (prototype, part) in enumerate(instances.prototypes.items()):
        is_mesh = isinstance(prototype, Mesh)
        handles[prototype] = client.scene.add_batched_meshes_simple(
            f"{NODE}/{number}",
            *surface(prototype),
            batched_wxyzs=wxyzs[part],
            batched_positions=poses[part, :3, 3],
            batched_scales=instances.scale[part],
            batched_colors=batch_colours(instances.colour[part]),
            lod="auto" if is_mesh else "off",
            cast_shadow=len(population) <= MAX_SHADOWS,
            side="double" if is_mesh else "front",  # some meshes have their faces inside out
        )
    return PopulationScene(client, population, handles, positions, poses)


def move(scene: PopulationScene, positions: Array, q: Array) -> None:
    """Move all robots; the browser gets all changes in one message.

    positions: Positions of the roots on the ground, shape (n, 2) [m].
    q: Independent joint positions, shape (n, J) [rad or m].
    """
    poses = world_poses(scene.population, positions, q)
    wxyzs, origins = quaternions(poses), poses[:, :3, 3]
    with scene.client.atomic():
        for prototype, part in scene.population.instances.prototypes.items():
            handle = scene.handles[prototype]
            handle.batched_wxyzs, handle.batched_positions = wxyzs[part], origins[part]
    scene.positions, scene.T_world_shape = positions, poses


def fade(scene: PopulationScene, selected: NDArray[np.bool_], background: Rgb) -> None:
    """Show the selected robots in their colours and the others faded; all in theirs without any.

    selected: Mask of the selected robots, shape (n,).
    """
    instances = scene.population.instances
    colours = instances.colour.astype(np.float64)
    if selected.any():
        faded = (1 - _FADED_SHARE) * colours + _FADED_SHARE * np.array(background)
        colours = np.where(selected[instances.robot][:, None], colours, faded)
    with scene.client.atomic():
        for prototype, part in instances.prototypes.items():
            scene.handles[prototype].batched_colors = batch_colours(colours[part])


def world_poses(population: Population, positions: Array, q: Array) -> NDArray[np.float32]:
    """Return the pose of every instance in the world, shape (m, 4, 4); see ``move``."""
    poses = shape_poses(population, q)
    poses[:, :2, 3] += positions[population.instances.robot]
    return poses


def quaternions(poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the rotations of poses (m, 4, 4) as quaternions (w, x, y, z), shape (m, 4)."""
    return np.asarray(quaternion_from_matrix(torch.from_numpy(poses[:, :3, :3])).numpy())


def surface(prototype: Prototype) -> Triangles:
    """Return the surface of a prototype, simplified because it is drawn many times."""
    match prototype:
        case Box():
            return triangles(prototype)
        case Sphere(radius):
            ball = trimesh.creation.icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=radius)
            return _arrays(ball)
        case Cylinder(radius, length):
            tube = trimesh.creation.cylinder(radius, length, sections=_CYLINDER_SECTIONS)
            return _arrays(trimesh.graph.smooth_shade(tube, angle=SHARP_ANGLE))
        case Mesh() as mesh:
            loaded = load_mesh(mesh)
            if len(loaded.faces) <= MAX_FACES:
                return triangles(mesh)
            simple = loaded.simplify_quadric_decimation(face_count=MAX_FACES)
            return _arrays(trimesh.graph.smooth_shade(simple, angle=SHARP_ANGLE))


def _arrays(mesh: trimesh.Trimesh) -> Triangles:
    vertices = np.asarray(mesh.vertices, dtype=np.float32)
    return vertices, np.asarray(mesh.faces, dtype=np.uint32)
