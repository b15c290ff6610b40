"""Mesh files for shapes of an MJCF that have none: vertices in the document, and ellipsoids.

The files are kept in the user's cache under a hash of their content, because a robot names its
meshes by their files.
"""

from __future__ import annotations

import hashlib
import math
import re
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from platformdirs import user_cache_path
from trimesh.exchange.stl import export_stl

from morphgen.errors import FormatError
from morphgen.formats.files import write_cache_file
from morphgen.formats.mjcf_document import MjcfDocument
from morphgen.model.geometry import Mesh
from morphgen.model.mesh_pieces import MAX_COORDINATE
from morphgen.model.rotation import Vec3

ELLIPSOID_SUBDIVISIONS = 2
"""Subdivisions of the icosahedron that stands for an ellipsoid; 2 give 320 triangles, which are
within 1.2% of the radii."""
_CACHE = "mjcf-meshes-1"
"""Folder in the user's cache; the number rises when the same content gives another file."""
_MAX_STEM = 60
"""Longest file name of a kept mesh, without its suffix [characters]."""


def ellipsoid_mesh(radii: Vec3) -> Mesh:
    """Return a convex mesh of the volume of an ellipsoid: a subdivided icosahedron, scaled.

    Args:
        radii: Along x, y and z [m].

    Raises:
        FormatError: If the cache cannot be written.
    """
    return Mesh(_keep("ellipsoid", _unit_sphere()), radii)


def inline_meshes(spec: mujoco.MjSpec, document: MjcfDocument) -> dict[str, Path]:
    """Return files of the meshes whose vertices are in the document, by the asset's name.

    A file has the vertices as written, before MuJoCo's scale and reference pose; without triangles,
    those of their convex hull, as in MuJoCo.

    Args:
        spec: The document. MuJoCo has compiled it, so that vertices are finite, faces name
            vertices, and vertices without faces have a hull.
        document: The document.

    Raises:
        FormatError: If a mesh has no area or too large coordinates, or the cache cannot be written.
    """
    files = {}
    for asset in spec.meshes:
        if asset.name in document.meshes:
            continue
        where = f"mesh {asset.name!r}"
        vertices = np.asarray(asset.uservert, np.float64).reshape(-1, 3)
        faces = np.asarray(asset.userface, np.int64).reshape(-1, 3)
        if np.abs(vertices).max(initial=0.0) > MAX_COORDINATE:
            raise document.error(f"{where}: a vertex is beyond {MAX_COORDINATE:g} m")
        if len(faces):
            triangles = trimesh.Trimesh(vertices, faces, process=False)
        else:
            triangles = trimesh.convex.convex_hull(vertices)
        if not triangles.area > 0:
            raise document.error(f"{where}: no face has an area")
        files[asset.name] = _keep(asset.name, triangles)
    return files


@lru_cache(maxsize=1)
def _unit_sphere() -> trimesh.Trimesh:
    """Return a convex mesh of the volume of a sphere of radius 1 m."""
    sphere: trimesh.Trimesh = trimesh.creation.icosphere(subdivisions=ELLIPSOID_SUBDIVISIONS)
    sphere.apply_scale(float(4 / 3 * math.pi / sphere.volume) ** (1 / 3))
    return sphere


def _keep(name: str, triangles: trimesh.Trimesh) -> Path:
    """Write a mesh into the cache, unless it is there; return its file."""
    content = export_stl(triangles)
    stem = re.sub(r"[^A-Za-z0-9_-]", "_", name)[:_MAX_STEM] or "mesh"
    digest = hashlib.sha256(content).hexdigest()[:32]
    path = user_cache_path("morphgen") / _CACHE / digest / f"{stem}.stl"
    if not path.is_file():
        try:
            write_cache_file(path, content)
        except OSError as error:
            raise FormatError(f"cannot keep mesh {name!r} in {path}: {error.strerror}") from error
    return path
