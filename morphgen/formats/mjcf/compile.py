"""Compile an MJCF within limits, and write mesh files for its shapes that have none.

Such shapes are vertices in the document, and ellipsoids. The files are kept in the user's cache
under a hash of their content, because a robot names its meshes by their files.
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
from morphgen.files import write_cache_file
from morphgen.formats.mjcf.document import GEOM_TYPES, MjcfDocument, listed
from morphgen.formats.quiet import MujocoWarnings
from morphgen.formats.urdf.schema import MAX_LINKS, MAX_NUMBER, MAX_SHAPES, MAX_TEXT
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh
from morphgen.model.mesh import load_mesh
from morphgen.model.rotation import Vec3
from morphgen.model.scene_files import MAX_COORDINATE, MAX_FACES

_REFUSALS = (ValueError, mujoco.FatalError)  # exceptions by which MuJoCo refuses a document
MAX_CONVEX_FACES = 50_000
"""Largest number of triangles of a mesh whose inertia is that of its convex hull."""
_FEWEST_HULL_VERTICES = 4  # smallest number of vertices of a convex hull that MuJoCo accepts
_ARRAYS = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    *("jnt_pos", "jnt_axis", "jnt_range", "qpos0", "dof_damping", "dof_frictionloss", "key_qpos"),
    *("geom_pos", "geom_quat", "geom_size", "geom_rgba", "mat_rgba", "site_pos", "site_quat"),
    *("eq_data", "tendon_length0", "wrap_prm"),
    *("jnt_actfrcrange", "actuator_forcerange", "actuator_ctrlrange", "actuator_gainprm"),
    "actuator_gear",
)
"""Arrays of a compiled model that a robot is made of."""


def compile_document(
    document: MjcfDocument,
) -> tuple[mujoco.MjSpec, mujoco.MjModel, tuple[Finding, ...]]:
    """Compile a document, with the triangles of its meshes as morphgen reads them.

    No body is merged with its parent and no geom is dropped, whatever the document says.

    Returns:
        The document's model before and after the compilation, and MuJoCo's warnings.
    """
    with MujocoWarnings() as warnings:
        try:
            spec = mujoco.MjSpec.from_string(document.text)
        except _REFUSALS as error:
            raise document.error(f"not MJCF that MuJoCo reads: {error}") from error
        _require_bounded(spec, document)
        spec.compiler.fusestatic = False  # links on fixed joints stay bodies
        spec.compiler.discardvisual = False  # a robot has its visual shapes
        # The length ranges of muscles, which a robot does not have, take long simulations.
        spec.compiler.LRopt.mode = mujoco.mjtLRMode.mjLRMODE_NONE
        faces_left = MAX_FACES
        for name, file in document.meshes.items():
            triangles = load_mesh(Mesh(file))
            faces_left -= len(triangles.faces)
            if faces_left < 0:
                raise document.error(
                    f"its meshes have more than {MAX_FACES} triangles in all, the most that are "
                    "read"
                )
            asset = spec.mesh(name)
            if asset.inertia != mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX:
                # No robot uses this hull, and a full one takes long.
                asset.maxhullvert = _FEWEST_HULL_VERTICES
            elif len(triangles.faces) > MAX_CONVEX_FACES:
                raise document.error(
                    f"mesh {name!r} has inertia convex and {len(triangles.faces)} triangles; at "
                    f"most {MAX_CONVEX_FACES} are read"
                )
            asset.uservert = np.asarray(triangles.vertices, dtype=np.float64).ravel()
            asset.userface = np.asarray(triangles.faces, dtype=np.int32).ravel()
        try:
            model = spec.compile()
        except _REFUSALS as error:
            raise document.error(f"MuJoCo cannot compile it: {error}") from error
    # MuJoCo compiles NaN and numbers whose products overflow.
    for array in _ARRAYS:
        values = getattr(model, array)
        bad = ~(np.abs(values) <= MAX_NUMBER)  # not `>`, which is False for NaN
        if bad.any():
            worst = values[bad][0]
            raise document.error(
                f"{array} of the compiled model has the value {worst:g}; expected numbers up to "
                f"{MAX_NUMBER:g}"
            )
    where, fix = f"{document.path.name}: document", "change the MJCF as MuJoCo says"
    texts = (f"MuJoCo warns: {' '.join(text.split())}" for text in dict.fromkeys(warnings))
    findings = tuple(Finding("mujoco-warning", "warning", where, text, fix) for text in texts)
    return spec, model, findings


def _require_bounded(spec: mujoco.MjSpec, document: MjcfDocument) -> None:
    for elements, items, bound in (
        ("bodies", spec.bodies, MAX_LINKS),
        ("joints", spec.joints, MAX_LINKS),
        ("sites", spec.sites, MAX_LINKS),
        ("geoms", spec.geoms, MAX_SHAPES),
        ("keyframes", spec.keys, MAX_LINKS),
    ):
        if len(items) > bound:
            raise document.error(f"it has {len(items)} {elements}; at most {bound} are read")
        for item in items:
            if len(item.name) > MAX_TEXT or not item.name.isprintable():
                raise document.error(
                    f"the name {item.name[:40]!r} has characters that cannot be printed, or more "
                    f"than {MAX_TEXT}"
                )
    # The octree of a signed distance field grows without bound.
    fields = [g.name for g in spec.geoms if g.type == mujoco.mjtGeom.mjGEOM_SDF]
    if fields:
        raise document.error(f"geom {listed(fields)}: type sdf; expected {GEOM_TYPES}")
    for asset in (*spec.meshes, *spec.hfields, *spec.textures, *spec.skins):
        if asset.file:
            raise document.error(
                f"asset {asset.name!r} has the file {asset.file!r} by a default; name it in <asset>"
            )


ELLIPSOID_SUBDIVISIONS = 2
"""Subdivisions of the icosahedron that stands for an ellipsoid; 2 give 320 triangles, which are
within 1.2% of the radii."""
_CACHE = "mjcf-meshes-1"
"""Folder in the user's cache; the number rises when the same content gives another file."""
_MAX_STEM = 60  # longest file name of a kept mesh, without its suffix [characters]


def ellipsoid_mesh(radii: Vec3) -> Mesh:
    """Return a convex mesh of the volume of an ellipsoid: a subdivided icosahedron, scaled.

    radii: Along x, y and z [m].
    """
    return Mesh(_keep("ellipsoid", _unit_sphere()), radii)


def inline_meshes(spec: mujoco.MjSpec, document: MjcfDocument) -> dict[str, Path]:
    """Return files of the meshes whose vertices are in the document, by the asset's name.

    A file has the vertices as written, before MuJoCo's scale and reference pose; without triangles,
    those of their convex hull, as in MuJoCo.
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
