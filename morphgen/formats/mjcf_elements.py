"""Elements of MJCF documents: numbers, poses, joints, geoms and mesh assets."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import PurePosixPath

import mujoco
import numpy as np
import trimesh
from lxml import etree

from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.mesh import convex_hull, load_mesh
from morphgen.model.robot import Joint
from morphgen.model.tree import take_name
from morphgen.typing import Array

MeshFile = Callable[[Mesh], str]
"""Function that writes a mesh, or finds it, and returns its path for the document."""
FLAT = 1e-5
"""Extent below which a collision hull counts as flat [m]; MuJoCo refuses flat hulls."""
FLAT_THICKNESS = 1e-4
"""Thickness that a flat collision hull gets [m]."""


class Meshes:
    """Mesh assets of a document, in order of first use.

    With a ``MeshFile`` the document names files (``write``). Without one, the compiled model gets
    the triangles themselves (``add_to``).
    """

    def __init__(self, mesh_file: MeshFile | None) -> None:
        self._mesh_file = mesh_file
        self._names: dict[tuple[Mesh, bool], str] = {}
        self._files: dict[str, str] = {}
        self._vertices: dict[str, Array] = {}

    def name(self, mesh: Mesh, *, collision: bool) -> str:
        """Return the asset name of a mesh, for collision the name of its hull."""
        key = (mesh, collision)
        if key not in self._names:
            self._names[key] = self._add(mesh, collision)
        return self._names[key]

    def write(self, asset: etree._Element) -> None:
        """Add a ``<mesh>`` for every file and every flat hull."""
        for name, file in self._files.items():
            etree.SubElement(asset, "mesh", name=name, file=file, inertia="shell")
        for name, vertices in self._vertices.items():
            vertex = join(vertices.ravel().tolist())
            etree.SubElement(asset, "mesh", name=name, vertex=vertex)

    def add_to(self, spec: mujoco.MjSpec) -> None:
        """Add the triangles of the meshes to a model, if they are not in files."""
        if self._mesh_file is not None:
            return
        for (mesh, collision), name in self._names.items():
            if name in self._vertices:
                continue
            triangles = convex_hull(mesh) if collision else load_mesh(mesh)
            vertices = np.asarray(triangles.vertices, dtype=np.float64)
            missing = max(0, 4 - len(vertices))
            spec.add_mesh(
                name=name,
                uservert=np.concatenate([vertices, vertices[:1].repeat(missing, 0)]).ravel(),
                userface=np.asarray(triangles.faces, dtype=np.int32).ravel(),
                inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
            )

    def _add(self, mesh: Mesh, collision: bool) -> str:
        if collision:
            corners = _thickened(np.asarray(load_mesh(mesh).vertices, dtype=np.float64))
            if corners is not None:
                name = self._free_name(mesh.path.stem + "_flat")
                self._vertices[name] = corners
                return name
        if self._mesh_file is None:
            return self._free_name(mesh.path.stem)
        file = self._mesh_file(mesh)
        for name, known in self._files.items():
            if known == file:
                return name
        name = self._free_name(PurePosixPath(file).stem)
        self._files[name] = file
        return name

    def _free_name(self, stem: str) -> str:
        return take_name(stem, {*self._names.values(), *self._files, *self._vertices})


def geom_attributes(shape: Shape, meshes: Meshes, *, collision: bool) -> dict[str, str]:
    """Return the type, size or mesh, and pose attributes of a shape's ``<geom>``."""
    match shape.geometry:
        case Box(size):
            form = {"type": "box", "size": join(edge / 2 for edge in size)}
        case Sphere(radius):
            form = {"type": "sphere", "size": join([radius])}
        case Cylinder(radius, length):
            form = {"type": "cylinder", "size": join([radius, length / 2])}
        case Capsule(radius, length):
            form = {"type": "capsule", "size": join([radius, length / 2])}
        case Mesh():
            form = {"type": "mesh", "mesh": meshes.name(shape.geometry, collision=collision)}
    return form | pose_attributes(shape.T_link_shape)


def joint_attributes(joint: Joint) -> dict[str, str]:
    """Return the name, type and axis attributes of a movable joint."""
    kind = "slide" if joint.kind == "prismatic" else "hinge"
    return {"name": joint.name, "type": kind, "axis": join(joint.unit_axis)}


def pose_attributes(pose: Pose) -> dict[str, str]:
    """Return the pose attributes of an element; none for the identity."""
    attributes = {}
    position, quaternion = join(pose.position), join(pose.quaternion)
    if position != "0 0 0":
        attributes["pos"] = position
    if quaternion != "1 0 0 0":
        attributes["quat"] = quaternion
    return attributes


def join(values: Iterable[float], zero: float = 1e-12) -> str:
    """Return numbers with 12 significant digits; magnitudes below ``zero`` are zero."""
    return " ".join("0" if abs(value) < zero else f"{value:.12g}" for value in values)


def _thickened(vertices: Array) -> Array | None:
    """Return the corners of a thin solid around flat vertices; None if they are not flat."""
    centred = vertices - vertices.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    if np.ptp(centred @ axes[:, 0]) >= FLAT:
        return None
    shift = axes[:, 0] * FLAT_THICKNESS / 2
    sides = np.concatenate([vertices + shift, vertices - shift])
    return np.asarray(trimesh.convex.convex_hull(sides).vertices, dtype=np.float64)
