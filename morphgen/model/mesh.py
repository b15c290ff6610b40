"""Triangles of mesh files, in metres.

COLLADA says two things about its coordinates, and descriptions of robots rely on one of them:

* ``<unit meter="...">`` is applied. All seven visuals of the KUKA KR210 are in inches by that
  element, and only with it do they meet the same links' collision STLs (mean overlap of the
  bounding boxes 0.98, without it 0.00).
* ``<up_axis>`` is ignored. Every file of rtb-data and example-robot-data that says ``Y_UP`` and can
  be compared with another mesh of the same part fits as it is written: PR2 (14 visuals against
  collision STLs, mean overlap 0.94, turned to z up 0.41), Kinova (7 against STLs, equal bounds),
  Robotiq 2F-85 (3 against ``Z_UP`` files, equal bounds), Baxter's torso (0.99, turned 0.14). None
  fits better turned. RViz, Pinocchio and PyBullet ignore the element too. By the same convention
  the y axis of glTF is not turned up either.

trimesh applies neither; it applies the scene graph's transforms, and so does this module.
"""

from __future__ import annotations

import io
import logging
import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TypeAlias

import collada
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals

from morphgen.errors import MeshError
from morphgen.model.geometry import Mesh, Rgba
from morphgen.model.mesh_files import (
    MAX_FACES,
    MAX_PIXELS,
    FolderResolver,
    require_bounded,
    require_readable,
    without_materials,
)

SUFFIXES = (".dae", ".glb", ".gltf", ".obj", ".ply", ".stl")
"""File formats that can be read, by lower-case suffix."""

_UNREADABLE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    Image.DecompressionBombError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    collada.DaeError,
    struct.error,
    trimesh.exchange.stl.HeaderError,
)
"""What the readers raise on a file that is not what its suffix says."""

_Triangles: TypeAlias = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Vertices (n, 3) and faces (m, 3)."""

MAX_COORDINATE = 1e9
"""Coordinate beyond which a mesh file is taken to be broken, in its own unit or metres."""
FLATNESS_TOLERANCE = 1e-7
"""Thickness below which points are flat, relative to their size."""
MAX_STL_FACES = 200_000
"""Triangles of the largest STL that MuJoCo reads."""

# Without a handler of its own, trimesh's warnings about a file would reach the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class MeshPart:
    """The triangles of a file that share a colour."""

    rgba: Rgba | None
    """Colour, each in [0, 1], the mean of a texture; None if the file names none."""
    faces: int
    """Number of triangles."""


@dataclass(frozen=True)
class _Group:
    part: MeshPart
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]


def load_mesh(mesh: Mesh) -> trimesh.Trimesh:
    """Return the triangles of a mesh in the frame of its URDF ``<mesh>``, metres, scale applied.

    Coincident vertices are merged, triangles without area dropped, and a mirroring scale keeps the
    normals pointing outwards. The result is memoised until the file changes: treat it as read-only.

    Args:
        mesh: The file, its scale and, with ``part``, one entry of `mesh_parts`.

    Raises:
        MeshError: The file is missing, unreadable, empty or not finite, or there is no such part.
    """
    return _scaled(str(mesh.path.absolute()), _stamp(mesh.path), mesh.scale, mesh.part)


def mesh_parts(path: Path) -> tuple[MeshPart, ...]:
    """Return the colour groups of a mesh file, in the order in which the file shows them first.

    Raises:
        MeshError: The file is missing, unreadable, empty or not finite.
    """
    return tuple(group.part for group in _groups(str(path.absolute()), _stamp(path)))


def convex_hull(mesh: Mesh) -> trimesh.Trimesh:
    """Return the convex hull of a mesh, metres; memoised, so treat it as read-only.

    Raises:
        MeshError: As `load_mesh`, or the mesh is flat and encloses nothing.
    """
    return _hull(str(mesh.path.absolute()), _stamp(mesh.path), mesh.scale, mesh.part)


def is_flat(points: NDArray[np.float64]) -> bool:
    """Whether points, shape (n, 3), lie in a plane or are fewer than four."""
    if len(points) < 4:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= FLATNESS_TOLERANCE * spread[0])


@lru_cache(maxsize=512)
def _hull(
    path: str, stamp: tuple[int, int], scale: tuple[float, ...], part: int | None
) -> trimesh.Trimesh:
    vertices = _scaled(path, stamp, scale, part).vertices
    if is_flat(vertices):
        raise MeshError(f"{path}: is flat, so it has no convex hull")
    result: trimesh.Trimesh = trimesh.convex.convex_hull(vertices)
    return result


@lru_cache(maxsize=512)
def _scaled(
    path: str, stamp: tuple[int, int], scale: tuple[float, ...], part: int | None
) -> trimesh.Trimesh:
    if len(scale) != 3 or not all(math.isfinite(s) and s != 0 for s in scale):
        raise MeshError(f"{path}: scale {scale} is not three finite numbers other than zero")
    groups = _groups(path, stamp)
    if part is not None:
        if not 0 <= part < len(groups):
            raise MeshError(f"{path}: no part {part}; valid: 0 to {len(groups) - 1}")
        groups = (groups[part],)
    vertices, faces = _concatenated([(group.vertices, group.faces) for group in groups])
    vertices, faces = _cleaned(vertices * scale, faces[:, ::-1] if math.prod(scale) < 0 else faces)
    if not len(faces):
        raise MeshError(f"{path}: no triangle has an area at scale {scale}")
    return trimesh.Trimesh(vertices, faces, process=False)


@lru_cache(maxsize=128)
def _groups(path: str, stamp: tuple[int, int]) -> tuple[_Group, ...]:
    """The file's triangles by colour, in metres."""
    pieces: dict[Rgba | None, list[_Triangles]] = {}
    for rgba, triangles in _read(Path(path)):
        pieces.setdefault(rgba, []).append(triangles)
    groups = []
    for rgba, parts in pieces.items():
        vertices, faces = _cleaned(*_concatenated(parts))
        if len(faces):
            groups.append(_Group(MeshPart(rgba, len(faces)), vertices, faces))
    if not groups:
        raise MeshError(f"{path}: holds no triangle with an area")
    return tuple(groups)


def _read(path: Path) -> list[tuple[Rgba | None, _Triangles]]:
    if path.suffix.lower() not in SUFFIXES:
        raise MeshError(f"{path}: cannot read {path.suffix!r} meshes; valid: {', '.join(SUFFIXES)}")
    try:
        require_readable(path)
        require_bounded(path)
        scene = _scene(path)
        placed = [scene.graph[node] for node in scene.graph.nodes_geometry]
        faces = sum(len(getattr(scene.geometry[name], "faces", ())) for _, name in placed)
        if faces > MAX_FACES:
            raise ValueError(f"{faces} triangles; at most {MAX_FACES} are read")
        return [
            (_colour(geometry), _in_scene(geometry, T_scene_node))
            for T_scene_node, name in placed
            if isinstance(geometry := scene.geometry[name], trimesh.Trimesh)
        ]
    except _UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: not a readable {path.suffix[1:]} mesh: {reason}") from error


def _scene(path: Path) -> trimesh.Scene:
    scene = trimesh.load_scene(path, process=False, resolver=FolderResolver(path.parent))
    if path.suffix.lower() == ".dae" and not scene.geometry:
        # pycollada drops a geometry with its material, as where a texture's image is not declared.
        plain = io.BytesIO(without_materials(path))
        scene = trimesh.load_scene(plain, file_type="dae", process=False)
    return scene


def _in_scene(geometry: trimesh.Trimesh, T_scene_node: NDArray[np.float64]) -> _Triangles:
    """A geometry's vertices in the scene, metres, and faces that point outwards there."""
    faces = np.asarray(geometry.faces)
    if geometry.vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise ValueError(f"vertices are {geometry.vertices.shape}, faces {faces.shape}")
    if faces.size and faces.min() < 0:
        raise ValueError(f"vertex index {faces.min()}")
    vertices = trimesh.transform_points(geometry.vertices, T_scene_node) * _unit(geometry)
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("a vertex is not finite")
    if np.abs(vertices[faces]).max(initial=0.0) > MAX_COORDINATE:
        raise ValueError(f"a vertex is beyond {MAX_COORDINATE:g} m")
    mirrored = np.linalg.det(T_scene_node[:3, :3]) < 0
    return vertices, faces[:, ::-1] if mirrored else faces


def _unit(geometry: trimesh.Trimesh) -> float:
    """Metres per unit of a geometry's coordinates."""
    unit = geometry.metadata.get("units", "meters")
    return float(trimesh.units.unit_conversion(unit, "meters"))


def _colour(geometry: trimesh.Trimesh) -> Rgba | None:
    """A geometry's one colour, to 8 bits."""
    visual = geometry.visual
    if visual is None or not visual.defined:
        return None
    if isinstance(visual, TextureVisuals):
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if visual.uv is None or image is None:
            rgba = material.main_color
        else:
            if math.prod(image.size) > MAX_PIXELS:
                raise ValueError(f"a texture of {image.size[0]} x {image.size[1]} pixels")
            colours = material.to_color(visual.uv)
            rgba = np.mean(colours, axis=0)
    else:
        rgba = np.mean(visual.vertex_colors, axis=0)
    red, green, blue, alpha = (round(float(channel)) / 255 for channel in rgba)
    return (red, green, blue, alpha)


def _concatenated(parts: list[_Triangles]) -> _Triangles:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    return (
        np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + start for (_, faces), start in zip(parts, starts, strict=True)]),
    )


def _cleaned(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> _Triangles:
    """Merge coincident vertices; drop unused ones and triangles without area."""
    merged = trimesh.Trimesh(vertices, faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    corners = merged.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    merged.update_faces(np.linalg.norm(normals, axis=1) > 0)
    merged.remove_unreferenced_vertices()
    return np.array(merged.vertices), np.array(merged.faces)


def _stamp(path: Path) -> tuple[int, int]:
    """What changes when a file is written anew."""
    try:
        status = path.stat()
    except OSError as error:
        raise MeshError(f"{path}: {(error.strerror or 'cannot be read').lower()}") from error
    return status.st_mtime_ns, status.st_size
