"""Read mesh files from untrusted sources: bounded in size, and within their own folder.

COLLADA files declare two properties of their coordinates, and robot descriptions rely on the first:

* ``<unit meter="...">`` is applied. All seven visuals of the KUKA KR210 are in inches by that
  element, and only with it do they match the same links' collision STLs (mean overlap of the
  bounding boxes 0.98, without it 0.00).
* ``<up_axis>`` is ignored. Every file of rtb-data and example-robot-data that declares ``Y_UP`` and
  can be compared with another mesh of the same part matches it without a rotation: PR2 (14 visuals
  against collision STLs, mean overlap 0.94, rotated to z up 0.41), Kinova (7 against STLs, equal
  bounds), Robotiq 2F-85 (3 against ``Z_UP`` files, equal bounds), Baxter's torso (0.99, rotated
  0.14). None matches better when rotated. RViz, Pinocchio and PyBullet ignore the element too. For
  the same reason, glTF files are not rotated from y up.

trimesh applies neither; it applies the transforms of the scene graph, as does this module.
"""

from __future__ import annotations

import io
import json
import logging
import math
import stat
import struct
from pathlib import Path
from typing import Any

import collada
import numpy as np
import trimesh
from lxml import etree
from numpy.typing import NDArray
from PIL import Image
from trimesh.visual import TextureVisuals

from morphgen.errors import MeshError
from morphgen.model.geometry import MESH_SUFFIXES, Rgba
from morphgen.model.msh_files import read_msh
from morphgen.typing import Array

MAX_FILE_SIZE = 128 * 2**20
"""Size of the largest mesh, texture or material file that is read [bytes]."""
MAX_FACES = 5_000_000
"""Number of triangles of the largest mesh that is read, every instance counted."""
MAX_PIXELS = 2**26
"""Number of pixels of the largest texture that is read."""
MAX_COORDINATE = 1e9
"""Coordinate above which a mesh file counts as broken [m]."""
_MAX_ACCESSOR_ENTRIES = 20_000_000
"""Number of entries in all accessors of the largest glTF file that is read."""
_MAX_NODES = 100_000
"""Number of nodes of the largest COLLADA scene that is read, every instance counted."""
_MAX_DEPTH = 100
"""Largest nesting depth of nodes in a COLLADA scene."""

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
"""Exceptions that the readers raise on malformed files."""

# Without a handler, trimesh's warnings about a file would be printed on the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_mesh_file(path: Path) -> list[tuple[Rgba | None, tuple[Array, NDArray[np.int64]]]]:
    """Return the colour, vertices (n, 3) [m] and faces (m, 3) of every geometry in a mesh file.

    Raises:
        MeshError: If the file is unreadable, too large or not finite.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        valid = ", ".join(MESH_SUFFIXES)
        raise MeshError(f"{path}: cannot read {path.suffix!r} meshes; valid: {valid}")
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
    if path.suffix.lower() == ".msh":
        return trimesh.Scene(trimesh.Trimesh(*read_msh(path.read_bytes()), process=False))
    scene = trimesh.load_scene(path, process=False, resolver=FolderResolver(path.parent))
    if path.suffix.lower() == ".dae" and not scene.geometry:
        # pycollada drops a geometry whose material is broken, such as by an undeclared texture.
        plain = io.BytesIO(without_materials(path))
        scene = trimesh.load_scene(plain, file_type="dae", process=False)
    return scene


def _in_scene(geometry: trimesh.Trimesh, T_scene_node: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return a geometry's vertices in the scene frame [m], and faces oriented outwards."""
    faces = np.asarray(geometry.faces)
    if geometry.vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise ValueError(f"vertices are {geometry.vertices.shape}, faces {faces.shape}")
    if faces.size and faces.min() < 0:
        raise ValueError(f"vertex index {faces.min()}")
    unit = geometry.metadata.get("units", "meters")
    metres_per_unit = float(trimesh.units.unit_conversion(unit, "meters"))
    vertices = trimesh.transform_points(geometry.vertices, T_scene_node) * metres_per_unit
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("a vertex is not finite")
    if np.abs(vertices[faces]).max(initial=0.0) > MAX_COORDINATE:
        raise ValueError(f"a vertex is beyond {MAX_COORDINATE:g} m")
    mirrored = np.linalg.det(T_scene_node[:3, :3]) < 0
    return vertices, faces[:, ::-1] if mirrored else faces


def _colour(geometry: trimesh.Trimesh) -> Rgba | None:
    """Return a geometry's mean colour, rounded to 8 bits; None if it has none."""
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


class FolderResolver(trimesh.resolvers.Resolver):
    """Resolves the file names in a mesh file, within the mesh's own folder only."""

    def __init__(self, folder: Path) -> None:
        """Restrict access to a folder and the folders below it."""
        self._folder = folder.resolve()

    def get(self, name: str) -> bytes:
        """Return the content of a file.

        Raises:
            ValueError: If it is outside the folder, not a regular file or too large.
        """
        path = (self._folder / str(name).strip().replace("\\", "/")).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name!r} is outside the mesh's folder")
        require_readable(path)
        return path.read_bytes()

    def keys(self) -> list[str]:
        """Return no names, so that trimesh reads only the files that the mesh names."""
        return []

    def namespaced(self, namespace: str) -> FolderResolver:
        """Return this resolver, so that trimesh does not search other folders."""
        del namespace
        return self

    def write(self, name: str, data: bytes) -> None:
        """Refuse to write.

        Raises:
            ValueError: Always.
        """
        del data
        raise ValueError(f"{name!r} is not written")


def require_readable(path: Path) -> None:
    """Require a regular file of at most ``MAX_FILE_SIZE`` bytes.

    Raises:
        OSError: If the file is missing or access is denied.
        ValueError: If it is not a regular file, or larger.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path.name!r} is not a regular file")
    if status.st_size > MAX_FILE_SIZE:
        raise ValueError(f"{path.name!r} holds {status.st_size} bytes; at most {MAX_FILE_SIZE}")


def require_bounded(path: Path) -> None:
    """Require that a file's declared content is bounded, however small the file.

    Raises:
        ValueError: If the content is too large or malformed.
        etree.XMLSyntaxError: If a COLLADA file is not XML.
    """
    match path.suffix.lower():
        case ".dae":
            _require_bounded_collada(path.read_bytes())
        case ".glb":
            _require_bounded_gltf(_json_chunk(path.read_bytes()))
        case ".gltf":
            _require_bounded_gltf(path.read_bytes())


def _json_chunk(data: bytes) -> bytes:
    if len(data) < 20 or data[:4] != b"glTF":
        raise ValueError("does not begin as a binary glTF file")
    (length,) = struct.unpack("<I", data[12:16])
    return data[20 : 20 + length]


def _require_bounded_gltf(text: bytes) -> None:
    document = json.loads(text)
    accessors = document.get("accessors", []) if isinstance(document, dict) else None
    if not isinstance(accessors, list):
        raise ValueError("does not contain a glTF document")
    # An accessor without data is all zeros, so any count needs no bytes in the file.
    count = sum(accessor["count"] for accessor in accessors)
    if count > _MAX_ACCESSOR_ENTRIES:
        raise ValueError(f"its accessors count {count} entries; at most {_MAX_ACCESSOR_ENTRIES}")


def without_materials(path: Path) -> bytes:
    """Return the content of a COLLADA file, with the materials of its geometries removed."""
    root = _collada(path.read_bytes())
    for binding in [*root.iter("{*}bind_material")]:
        parent = binding.getparent()
        if parent is not None:
            parent.remove(binding)
    return etree.tostring(root)


def _collada(data: bytes) -> etree._Element:
    # Without a DOCTYPE, also in UTF-16, no entity can be defined.
    if b"<!DOCTYPE" in data.replace(b"\0", b""):
        raise ValueError("has a DOCTYPE; a mesh needs none, remove it")
    # huge_tree, because coordinate arrays exceed libxml2's default limit on text.
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=True
    )
    return etree.fromstring(data, parser)


def _require_bounded_collada(data: bytes) -> None:
    """Bound the number of nodes, counted as by a reader that copies every instance of a node."""
    root = _collada(data)
    nodes = {f"#{node.get('id')}": node for node in root.iter("{*}node")}
    sizes: dict[Any, int] = {}

    def size(node: etree._Element, depth: int) -> int:
        if depth > _MAX_DEPTH:
            raise ValueError(f"its nodes are nested deeper than {_MAX_DEPTH} levels")
        if node not in sizes:
            total = 1
            for child in node.iterchildren("{*}node", "{*}instance_node"):
                target = nodes.get(child.get("url", "")) if child.tag.endswith("e_node") else child
                total += 0 if target is None else size(target, depth + 1)
            sizes[node] = total
        return sizes[node]

    total = sum(
        size(node, 0)
        for scene in root.iter("{*}visual_scene")
        for node in scene.iterchildren()
        if isinstance(node.tag, str) and etree.QName(node).localname == "node"
    )
    if total > _MAX_NODES:
        raise ValueError(f"its scene has {total} nodes; at most {_MAX_NODES}")
