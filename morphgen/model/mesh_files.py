"""Open mesh files of strangers: regular files in one folder, bounded in size and expansion."""

from __future__ import annotations

import json
import stat
import struct
from pathlib import Path
from typing import Any

import trimesh
from lxml import etree

MAX_FILE_SIZE = 128 * 2**20
"""Bytes of the largest mesh file, or texture or material beside it, that is read."""
MAX_FACES = 5_000_000
"""Triangles of the largest mesh that is read, every instance counted."""
MAX_PIXELS = 2**26
"""Pixels of the largest texture that is read."""
_MOST_ENTRIES = 20_000_000
"""Entries in all accessors of the largest glTF file that is read."""
_MOST_INSTANCES = 100_000
"""Nodes of the largest COLLADA scene that is read, every instance counted."""


class FolderResolver(trimesh.resolvers.Resolver):
    """The files that a mesh file names: regular ones in its own folder or below, nothing else."""

    def __init__(self, folder: Path) -> None:
        """Read files of a folder only."""
        self._folder = folder.resolve()

    def get(self, name: str) -> bytes:
        """The content of a file.

        Raises:
            ValueError: If it is outside the folder, no regular file or too large.
        """
        path = (self._folder / str(name).strip().replace("\\", "/")).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name!r} is outside the mesh's folder")
        require_readable(path)
        return path.read_bytes()

    def keys(self) -> list[str]:
        """No names: what a mesh file does not name is not looked for."""
        return []

    def namespaced(self, namespace: str) -> FolderResolver:
        """The same files: no reader looks into folders that the mesh file does not name."""
        del namespace
        return self

    def write(self, name: str, data: bytes) -> None:
        """Refuse: reading writes nothing.

        Raises:
            ValueError: Always.
        """
        del data
        raise ValueError(f"{name!r} is not written")


def require_readable(path: Path) -> None:
    """Require a regular file of at most ``MAX_FILE_SIZE`` bytes.

    Raises:
        OSError: If there is none, or it may not be read.
        ValueError: If it is something else, or larger.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise ValueError(f"{path.name!r} is no regular file")
    if status.st_size > MAX_FILE_SIZE:
        raise ValueError(f"{path.name!r} holds {status.st_size} bytes; at most {MAX_FILE_SIZE}")


def require_bounded(path: Path) -> None:
    """Require that what a file declares does not multiply far beyond its size.

    Raises:
        ValueError: If it does, or is broken.
        etree.XMLSyntaxError: If it is no XML, but should be.
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
        raise ValueError("holds no glTF document")
    # An accessor without data is all zeros: it needs no byte in the file for any count.
    count = sum(accessor["count"] for accessor in accessors)
    if count > _MOST_ENTRIES:
        raise ValueError(f"its accessors count {count} entries; at most {_MOST_ENTRIES}")


def without_materials(path: Path) -> bytes:
    """A COLLADA file whose geometries have no materials."""
    root = _collada(path.read_bytes())
    for binding in [*root.iter("{*}bind_material")]:
        parent = binding.getparent()
        if parent is not None:
            parent.remove(binding)
    return etree.tostring(root)


def _collada(data: bytes) -> etree._Element:
    if b"<!DOCTYPE" in data.replace(b"\0", b""):  # in UTF-16, too; else no entity is defined
        raise ValueError("has a DOCTYPE; a mesh needs none, remove it")
    # Arrays of coordinates are longer than the text that libxml2 else allows.
    parser = etree.XMLParser(
        resolve_entities=False, no_network=True, load_dtd=False, huge_tree=True
    )
    return etree.fromstring(data, parser)


def _require_bounded_collada(data: bytes) -> None:
    """Count nodes as a reader does, which copies a node wherever it is instantiated."""
    root = _collada(data)
    nodes = {f"#{node.get('id')}": node for node in root.iter("{*}node")}
    sizes: dict[Any, int] = {}

    def size(node: etree._Element, above: int) -> int:
        if above > 100:
            raise ValueError("its nodes are nested deeper than 100 levels")
        if node not in sizes:
            total = 1
            for child in node.iterchildren("{*}node", "{*}instance_node"):
                target = nodes.get(child.get("url", "")) if child.tag.endswith("e_node") else child
                total += 0 if target is None else size(target, above + 1)
            sizes[node] = total
        return sizes[node]

    total = sum(
        size(node, 0)
        for scene in root.iter("{*}visual_scene")
        for node in scene.iterchildren()
        if isinstance(node.tag, str) and etree.QName(node).localname == "node"
    )
    if total > _MOST_INSTANCES:
        raise ValueError(f"its scene has {total} nodes; at most {_MOST_INSTANCES}")
