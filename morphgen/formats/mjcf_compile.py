"""Compile MJCF documents from untrusted sources by MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np

from morphgen.formats.mjcf_document import GEOM_TYPES, MjcfDocument, listed
from morphgen.formats.mujoco_warnings import MujocoWarnings
from morphgen.formats.structure import MAX_LINKS, MAX_SHAPES
from morphgen.formats.urdf_schema import MAX_NUMBER, MAX_TEXT
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh
from morphgen.model.mesh import load_mesh
from morphgen.model.mesh_pieces import MAX_FACES

_REFUSALS = (ValueError, mujoco.FatalError)
"""Exceptions by which MuJoCo refuses a document."""
MAX_CONVEX_FACES = 50_000
"""Largest number of triangles of a mesh whose inertia is that of its convex hull."""
_FEWEST = 4
"""Smallest number of vertices of a convex hull that MuJoCo accepts."""
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

    Raises:
        MeshError: If a mesh cannot be read.
        FormatError: If MuJoCo refuses the document, or it is too large for a robot.
    """
    with MujocoWarnings() as warnings:
        try:
            spec = mujoco.MjSpec.from_string(document.text)
        except _REFUSALS as error:
            raise document.error(f"not MJCF that MuJoCo reads: {error}") from error
        _require_bounded(spec, document)
        spec.compiler.fusestatic = False
        spec.compiler.discardvisual = False
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
                asset.maxhullvert = _FEWEST  # the hull, which a robot does not have, takes long
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
    for array in _ARRAYS:
        values = getattr(model, array)
        if not (np.abs(values) <= MAX_NUMBER).all():
            worst = values[~(np.abs(values) <= MAX_NUMBER)][0]
            raise document.error(
                f"{array} of the compiled model has the value {worst:g}; expected numbers up to "
                f"{MAX_NUMBER:g}"
            )
    return spec, model, tuple(_warning(text, document) for text in dict.fromkeys(warnings))


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


def _warning(text: str, document: MjcfDocument) -> Finding:
    return Finding(
        "mujoco-warning",
        "warning",
        f"{document.path.name}: document",
        f"MuJoCo warns: {' '.join(text.split())}",
        "change the MJCF as MuJoCo says",
    )
