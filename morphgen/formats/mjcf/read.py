"""Read a robot from an MJCF, as MuJoCo compiles it, within limits.

Shapes without a mesh file, such as ellipsoids, get one in the user's cache under a hash of its
content, because a robot names its meshes by their files.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import trimesh
from platformdirs import user_cache_path
from trimesh.exchange.stl import export_stl

from morphgen.errors import FormatError, nearest
from morphgen.files import write_cache_file
from morphgen.formats.mjcf.document import GEOM_TYPES, MjcfDocument, listed, read_document
from morphgen.formats.quiet import MujocoWarnings
from morphgen.formats.resolve import PackageFinder, default_finder
from morphgen.formats.urdf.read import require_description_file
from morphgen.formats.urdf.schema import MAX_LINKS, MAX_NUMBER, MAX_SHAPES, MAX_TEXT
from morphgen.formats.urdf.write import BOUND_MASS
from morphgen.formats.xml import found
from morphgen.model import rotation
from morphgen.model.findings import Finding
from morphgen.model.geometry import (
    IDENTITY,
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Rgba,
    Shape,
    Sphere,
)
from morphgen.model.mesh import load_mesh
from morphgen.model.mesh_files import MAX_COORDINATE, MAX_FACES
from morphgen.model.robot import (
    TOOL,
    Frame,
    Inertial,
    Joint,
    JointKind,
    Link,
    Mimic,
    Robot,
    sorted_pair,
)
from morphgen.model.rotation import Vec3
from morphgen.model.tree import below, take_name
from morphgen.typing import Array

_REFUSALS = (ValueError, mujoco.FatalError)  # exceptions by which MuJoCo refuses a document
MAX_CONVEX_FACES = 50_000
"""Largest number of triangles of a mesh whose inertia is that of its convex hull."""
_FEWEST_HULL_VERTICES = 4  # smallest number of vertices of a convex hull that MuJoCo accepts
_ARRAYS = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia"),
    *("jnt_pos", "jnt_axis", "jnt_range", "qpos0", "dof_damping", "dof_frictionloss", "key_qpos"),
    *("geom_pos", "geom_quat", "geom_size", "geom_rgba", "mat_rgba", "site_pos", "site_quat"),
    "eq_data",
    *("jnt_actfrcrange", "actuator_forcerange", "actuator_ctrlrange", "actuator_gainprm"),
    "actuator_gear",
)
"""Arrays of a compiled model that a robot is made of."""


def compile_document(
    document: MjcfDocument,
) -> tuple[mujoco.MjSpec, mujoco.MjModel, tuple[Finding, ...]]:
    """Compile a document; return its model before and after that, and MuJoCo's warnings.

    No body is merged with its parent and no geom is dropped, whatever the document says.
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
    where = f"{document.path.name}: document"
    texts = (" ".join(text.split()) for text in dict.fromkeys(warnings))
    findings = tuple(found("mujoco-warning", where, text=text) for text in texts)
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
    """Return a convex mesh of an ellipsoid's volume, a scaled icosphere; radii (3,) [m]."""
    return Mesh(_keep("ellipsoid", _unit_sphere()), radii)


def inline_meshes(spec: mujoco.MjSpec, document: MjcfDocument) -> dict[str, Path]:
    """Return files of the meshes whose vertices are in the document, by the asset's name.

    They are as written, before scale and pose; without triangles, those of their convex hull.
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


WORLD = 0  # index of the world body
_JOINT, _GEOM, _EQ, _OBJ = mujoco.mjtJoint, mujoco.mjtGeom, mujoco.mjtEq, mujoco.mjtObj
_WRAP, _TRN = mujoco.mjtWrap, mujoco.mjtTrn
_REFUSED_JOINTS = {
    _JOINT.mjJNT_BALL: ("type ball; expected hinge or slide, such as three hinges at one place"),
    _JOINT.mjJNT_FREE: (
        "type free, which only the root of a robot may have; name it by --root-link BODY of "
        "morphgen import"
    ),
}
_FLOOR_GEOMS = (_GEOM.mjGEOM_PLANE, _GEOM.mjGEOM_HFIELD)  # a floor where the world has them
_WRAPPED = {
    _WRAP.mjWRAP_JOINT: _OBJ.mjOBJ_JOINT,
    _WRAP.mjWRAP_SITE: _OBJ.mjOBJ_SITE,
    _WRAP.mjWRAP_SPHERE: _OBJ.mjOBJ_GEOM,
    _WRAP.mjWRAP_CYLINDER: _OBJ.mjOBJ_GEOM,
}
_CONSTRAINED = {_EQ.mjEQ_JOINT: _OBJ.mjOBJ_JOINT, _EQ.mjEQ_TENDON: _OBJ.mjOBJ_TENDON}
_JOINT_TRANSMISSIONS = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)
_LAST_DRAWN_GROUP = 2  # last geom group that MuJoCo's viewers show
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # colour of a geom that names none
_TOOL_WORDS = ("tool", "tcp", "attachment", "pinch", "grip", "grasp", "ee", "eef", "end_effector")
"""Words in the name of a site that make it the tool, the most specific first."""
_HOME = "home"  # name of the keyframe that is the home configuration
_TOLERANCE = 1e-9  # excess over a limit at which a home position is still within it [rad or m]


def read_mjcf(
    path: Path, finder: PackageFinder | None = None, *, root_body: str | None = None
) -> Robot:
    """Read an MJCF by the rules of docs/importing.md; MuJoCo resolves defaults, angles, inertias.

    Links without mass, named ``BODY_JOINT``, separate several joints of a body. A link's frame is
    its body's; if the body's last hinge has a ``pos``, the frame is there, as URDF requires. Masses
    up to that of ``mjcf_text`` for links without mass count as none.
    """
    require_description_file(path)
    document = read_document(path, finder or default_finder())
    spec, model, warnings = compile_document(document)
    document = replace(document, meshes={**document.meshes, **inline_meshes(spec, document)})
    findings = [*document.findings, *warnings]
    root = _robot_root(model, document, root_body, findings)
    return _Reader(spec, model, document, root, findings).robot()


def _robot_root(
    model: mujoco.MjModel, document: MjcfDocument, root_body: str | None, findings: list[Finding]
) -> int:
    """Return the body at the root of the robot; add a finding about shapes that are left out.

    That is ``root_body``, else the one body in the world if it is welded to the world's origin or
    has a free joint, and the world has no shapes but planes; else the world itself.
    """
    if root_body is not None:
        names = [model.body(body).name for body in range(model.nbody)]
        if root_body not in names:
            hint = nearest(root_body, names)
            raise document.error(f"no body {root_body!r} for root link{hint}")
        return names.index(root_body)
    top = [body for body in range(1, model.nbody) if model.body_parentid[body] == WORLD]
    if not top:
        raise document.error("it has no bodies; expected at least one in <worldbody>")
    if len(top) > 1:
        parents = model.body_parentid.tolist()
        still = [body for body in top if not model.body_jntnum[below(parents, body)].any()]
        apart = still or [body for body in top if _is_free(model, body)]
        if apart:
            word = "is free" if _is_free(model, apart[0]) else "has no joints"
            raise document.error(
                f"the world holds the bodies {listed(_body_label(model, body) for body in top)}, "
                f"of which {_body_label(model, apart[0])!r} {word}; name the robot's by "
                "--root-link BODY of morphgen import"
            )
        return WORLD
    shapes = [g for g in _geoms(model, WORLD) if _GEOM(model.geom_type[g]) not in _FLOOR_GEOMS]
    body = top[0]
    if _is_free(model, body):
        if shapes:
            where = f"{document.path.name}: worldbody"
            findings.append(found("world-shapes", where, count=len(shapes)))
        return body
    is_welded = (
        model.body_jntnum[body] == 0
        and not shapes
        and not model.body_pos[body].any()
        and np.array_equal(model.body_quat[body], (1, 0, 0, 0))
    )
    return body if is_welded else WORLD


def _joint_label(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or for one without a name its body's."""
    return model.joint(joint).name or f"(of {_body_label(model, int(model.jnt_bodyid[joint]))})"


def _body_label(model: mujoco.MjModel, body: int) -> str:
    """Return a body's name, or for one without a name its number."""
    return model.body(body).name or f"(body {body})"


def _geoms(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_geomadr[body])
    return range(first, first + int(model.body_geomnum[body]))


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    joint = model.body_jntadr[body]
    return bool(joint >= 0 and model.jnt_type[joint] == _JOINT.mjJNT_FREE)


def _pose(position: Array, quaternion: Array) -> Pose:
    """Return a pose from MuJoCo's position (3,) [m] and quaternion (4,), (w, x, y, z)."""
    return Pose(rotation.vec3(position), rotation.unit_quaternion(quaternion))


class _Reader:
    """The bodies of a compiled model that are the robot, as links and joints.

    Attributes:
        bodies: Indices of the bodies, root first, parents before children.
        joints: Indices of the joints between these bodies.
        link: Name of the link of every body.
        T_link_body: Pose of every body's frame in its link's frame.
        steps: Joints that attach every body's link to that of its parent, with links in between.
    """

    def __init__(
        self,
        spec: mujoco.MjSpec,
        model: mujoco.MjModel,
        document: MjcfDocument,
        root: int,
        findings: list[Finding],
    ) -> None:
        self._spec, self._model, self._document = spec, model, document
        self._findings = findings
        self._ellipsoids: list[str] = []
        self._paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
        self.bodies = below(model.body_parentid.tolist(), root)
        inside = {*self.bodies} - {root}
        self.joints = [j for j in range(model.njnt) if int(model.jnt_bodyid[j]) in inside]
        for kind, why in _REFUSED_JOINTS.items():
            if refused := [joint for joint in self.joints if model.jnt_type[joint] == kind]:
                labels = listed(_joint_label(model, joint) for joint in refused)
                raise document.error(f"joint {labels}: {why}")
        self._couplings = _Couplings(model, self.joints, self.bodies, document, findings)
        self._efforts = _efforts(model)
        self._link_names = {model.body(body).name for body in self.bodies}
        self._joint_names = {model.joint(joint).name for joint in self.joints}
        self.link = {
            body: model.body(body).name or take_name(f"body_{body}", self._link_names)
            for body in self.bodies
        }
        self._names = {
            joint: model.joint(joint).name
            or take_name(f"{self.link[int(model.jnt_bodyid[joint])]}_joint", self._joint_names)
            for joint in self.joints
        }
        self.T_link_body: dict[int, Pose] = {root: IDENTITY}
        self.steps: dict[int, list[Joint]] = {root: []}
        for body in self.bodies[1:]:
            self._attach(body)

    def robot(self) -> Robot:
        """Return the robot."""
        links, ignored = [], []
        for body in self.bodies:
            links += [Link(joint.child) for joint in self.steps[body][:-1]]
            links.append(self._link(body))
        for signature in self._model.exclude_signature.tolist():
            a, b = signature >> 16, signature & 0xFFFF  # MuJoCo packs the two bodies
            if a in self.link and b in self.link:
                ignored.append(sorted_pair(self.link[a], self.link[b]))
        joints = tuple(joint for body in self.bodies for joint in self.steps[body])
        home = self._home(joints)
        if self._ellipsoids:
            where = f"{self._document.path.name}: geom {listed(self._ellipsoids)}"
            self._findings.append(found("ellipsoid-mesh", where))
        return Robot(
            self._document.name,
            tuple(links),
            joints,
            self._frames(joints),
            home,
            tuple(sorted(set(ignored))),
            source_findings=tuple(self._findings),
        )

    def _attach(self, body: int) -> None:
        model = self._model
        parent = int(model.body_parentid[body])
        link, name = self.link[parent], self.link[body]
        T = self.T_link_body[parent] @ _pose(model.body_pos[body], model.body_quat[body])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        self.steps[body] = []
        for joint in range(first, first + count):
            is_last = joint == first + count - 1
            own = self._names[joint]
            child = name if is_last else take_name(f"{name}_{own}", self._link_names)
            step, T = self._joint(joint, link, child, T)
            self.steps[body].append(step)
            link = child
        if count == 0:
            own = take_name(f"{name}_joint", self._joint_names)
            self.steps[body].append(Joint(own, "fixed", link, name, T))
            T = IDENTITY
        self.T_link_body[body] = T

    def _joint(
        self, joint: int, parent: str, child: str, T_parent_body: Pose
    ) -> tuple[Joint, Pose]:
        """Return a joint, and the pose of its body's frame in the frame of its child link."""
        model, name = self._model, self._names[joint]
        is_slide = model.jnt_type[joint] == _JOINT.mjJNT_SLIDE
        axis = rotation.vec3(model.jnt_axis[joint])
        # The link of a hinge is at its anchor; a slide moves every point alike.
        anchor = (0.0, 0.0, 0.0) if is_slide else rotation.vec3(model.jnt_pos[joint])
        # The body is written at the joint's ref, and a URDF's at position zero.
        back = _displacement(is_slide, axis, -_ref(model, joint))
        T_parent_joint = T_parent_body @ Pose(anchor) @ back
        T_child_body = Pose((-anchor[0], -anchor[1], -anchor[2])) if any(anchor) else IDENTITY
        lower, upper = model.jnt_range[joint].tolist()
        is_limited = bool(model.jnt_limited[joint])
        kind: JointKind = "prismatic" if is_slide else "revolute" if is_limited else "continuous"
        dof = int(model.jnt_dofadr[joint])
        mimic = None
        if joint in self._couplings.mimics:
            leader, multiplier, offset = self._couplings.mimics[joint]
            mimic = Mimic(self._names[leader], multiplier, offset)
        read = Joint(
            name,
            kind,
            parent,
            child,
            T_parent_joint,
            axis,
            (lower, upper) if is_limited else None,
            self._efforts.get(joint),
            damping=float(model.dof_damping[dof]),
            friction=float(model.dof_frictionloss[dof]),
            mimic=mimic,
        )
        return read, T_child_body

    def _link(self, body: int) -> Link:
        """Return the link of a body, with its shapes and mass properties in the link's frame."""
        model, T_link_body = self._model, self.T_link_body[body]
        visuals, collisions = self._shapes(body)
        inertial = None
        # Rounding may have passed the bound that mjcf_text writes for links without mass.
        if body != WORLD and model.body_mass[body] > BOUND_MASS * (1 + 1e-9):
            T = T_link_body @ _pose(model.body_ipos[body], model.body_iquat[body])
            R = T.matrix[:3, :3]
            matrix = R @ np.diag(model.body_inertia[body]) @ R.T
            inertial = Inertial.from_matrix(float(model.body_mass[body]), T.position, matrix)
        return Link(self.link[body], inertial, visuals, collisions)

    def _shapes(self, body: int) -> tuple[tuple[Shape, ...], tuple[Shape, ...]]:
        """Return the visual and the collision shapes of a body, in the frame of its link.

        See docs/importing.md. Planes and height fields of the world are its floor and left out, as
        are geoms that neither touch nor are drawn.
        """
        model, T_link_body = self._model, self.T_link_body[body]
        is_moved = not T_link_body.is_identity
        visuals: list[Shape] = []
        collisions: list[Shape] = []
        drawn: list[Shape] = []
        refused: dict[str, list[str]] = {}
        for geom in _geoms(model, body):
            has_contacts = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
            touches = has_contacts or geom in self._paired
            rgba = _rgba(model, geom)
            is_drawn = model.geom_group[geom] <= _LAST_DRAWN_GROUP and (rgba is None or rgba[3] > 0)
            kind = _GEOM(model.geom_type[geom])
            is_floor = body == WORLD and kind in _FLOOR_GEOMS
            if is_floor or not (touches or is_drawn):
                continue
            geometry, T_body_shape = self._geometry(geom)
            name = model.geom(geom).name or f"(of {_body_label(model, body)})"
            if kind == _GEOM.mjGEOM_ELLIPSOID and isinstance(geometry, Mesh):
                self._ellipsoids.append(name)
            if geometry is None:
                refused.setdefault(kind.name.removeprefix("mjGEOM_").lower(), []).append(name)
                continue
            shape = Shape(geometry, T_link_body @ T_body_shape if is_moved else T_body_shape)
            if touches:
                collisions.append(shape)
            if is_drawn:
                (drawn if touches else visuals).append(replace(shape, rgba=rgba))
        for form, names in refused.items():
            raise self._document.error(f"geom {listed(names)}: type {form}; expected {GEOM_TYPES}")
        return tuple(visuals or drawn), tuple(collisions)

    def _geometry(self, geom: int) -> tuple[Geometry | None, Pose]:
        """Return a geom's geometry and its pose in the body's frame; None without a counterpart."""
        model = self._model
        a, b, c = model.geom_size[geom].tolist()
        T_body_geom = _pose(model.geom_pos[geom], model.geom_quat[geom])
        match _GEOM(model.geom_type[geom]):
            case _GEOM.mjGEOM_BOX:
                return Box((2 * a, 2 * b, 2 * c)), T_body_geom
            case _GEOM.mjGEOM_SPHERE:
                return Sphere(a), T_body_geom
            case _GEOM.mjGEOM_CYLINDER:
                return Cylinder(a, 2 * b), T_body_geom
            case _GEOM.mjGEOM_CAPSULE:
                return Capsule(a, 2 * b), T_body_geom
            case _GEOM.mjGEOM_ELLIPSOID:
                return Sphere(a) if a == b == c else ellipsoid_mesh((a, b, c)), T_body_geom
            case _GEOM.mjGEOM_MESH:
                # MuJoCo moves meshes to their centre of mass and principal axes: undo that.
                k = model.geom_dataid[geom]
                T_mesh_geom = _pose(model.mesh_pos[k], model.mesh_quat[k])
                mesh, T_mesh_file = self._mesh(self._spec.mesh(model.mesh(k).name))
                return mesh, T_body_geom @ T_mesh_geom.inverse() @ T_mesh_file
        return None, T_body_geom

    def _mesh(self, asset: mujoco.MjsMesh) -> tuple[Mesh, Pose]:
        """Return a mesh asset as its file with a scale, and the pose of that in the asset's frame.

        MuJoCo maps a vertex v of the file to S R^T (v - p), with the position p and rotation R of
        ``refpos`` and ``refquat`` and the scale S.
        """
        x, y, z = (float(value) for value in asset.scale)
        T_ref_file = _pose(asset.refpos, asset.refquat).inverse()
        if T_ref_file.quaternion != rotation.IDENTITY and not x == y == z:
            raise self._document.error(
                f"mesh {asset.name!r} is turned by refquat and has the uneven scale {x:g} {y:g} "
                f"{z:g}; turn the vertices in its file"
            )
        px, py, pz = T_ref_file.position
        T_asset_file = Pose((x * px, y * py, z * pz), T_ref_file.quaternion)
        return Mesh(self._document.meshes[asset.name], (x, y, z)), T_asset_file

    def _frames(self, joints: Sequence[Joint]) -> tuple[Frame, ...]:
        """Return a frame for every site with a name, and the frame ``tool``; see docs/importing.md.

        A URDF has a link and a joint for a frame; a site whose name they would take from another
        link or joint gets ``_site`` appended.
        """
        model = self._model
        taken = {*self.link.values(), *(end for j in joints for end in (j.parent, j.child))}
        joint_names = {joint.name for joint in joints}
        sites = [
            (model.site(site).name, int(model.site_bodyid[site]), site)
            for site in range(model.nsite)
            if model.site(site).name and int(model.site_bodyid[site]) in self.link
        ]
        names = {*taken, *(name for name, _, _ in sites)}
        frames = []
        for name, body, site in sites:
            T_body_site = _pose(model.site_pos[site], model.site_quat[site])
            is_taken = name in taken or f"{name}_joint" in joint_names
            own = take_name(f"{name}_site", names) if is_taken else name
            frames.append(Frame(own, self.link[body], self.T_link_body[body] @ T_body_site))
        if TOOL in taken or any(frame.name == TOOL for frame in frames):
            return tuple(frames)
        tools = (frame for word in _TOOL_WORDS for frame in frames if _has_word(frame.name, word))
        more = [Frame(TOOL, tool.link, tool.T_link_frame) for tool in tools][:1]
        return (*frames, *more)

    def _home(self, joints: Sequence[Joint]) -> tuple[float, ...]:
        """Return the home configuration; add a finding about a keyframe that is out of limits."""
        model = self._model
        keys = [model.key(k).name for k in range(model.nkey)]
        key = keys.index(_HOME) if _HOME in keys else 0
        independent = [joint for joint in joints if joint.is_independent]
        indices = {name: joint for joint, name in self._names.items()}
        address = [int(model.jnt_qposadr[indices[joint.name]]) for joint in independent]
        outside = []
        if keys:
            home = tuple(model.key_qpos[key, address].tolist())
            pairs = zip(independent, home, strict=True)
            outside = [joint.name for joint, q in pairs if not _is_within(joint, q)]
            if not outside:
                return home
        refs = zip(independent, model.qpos0[address].tolist(), strict=True)
        home = tuple(q if _is_within(j, q) else sum(j.effective_limits) / 2 for j, q in refs)
        if outside:
            where = f"{self._document.path.name}: key {keys[key]!r}"
            self._findings.append(found("keyframe-outside-limits", where, joint=outside[0]))
        return home


def _is_within(joint: Joint, position: float) -> bool:
    lower, upper = joint.limits or (-math.inf, math.inf)
    return lower - _TOLERANCE <= position <= upper + _TOLERANCE


def _displacement(is_slide: bool, axis: Vec3, motion: float) -> Pose:
    """Return the displacement of a joint that moves by an angle [rad] or a length [m]."""
    if motion == 0.0:
        return IDENTITY
    x, y, z = axis
    if is_slide:
        return Pose((motion * x, motion * y, motion * z))
    sine = math.sin(motion / 2)
    return _pose(np.zeros(3), np.array([math.cos(motion / 2), sine * x, sine * y, sine * z]))


def _rgba(model: mujoco.MjModel, geom: int) -> Rgba | None:
    """Return the colour of a geom or its material; None if the file names none."""
    values = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    if np.allclose(values, _DEFAULT_RGBA):
        if material < 0:
            return None
        values = model.mat_rgba[material]
    # MuJoCo stores colours with single precision.
    red, green, blue, alpha = (round(min(max(float(v), 0.0), 1.0), 6) for v in values)
    return (red, green, blue, alpha)


def _has_word(name: str, word: str) -> bool:
    """Return whether a name has a word: ``grip`` in ``left_gripper``, ``ee`` only on its own."""
    ending = "" if len(word) > 3 else r"(?![a-z])"
    return re.search(rf"(?<![a-z]){word}{ending}", name.lower()) is not None


class _Couplings:
    """Requirements of equality constraints on joints: docs/importing.md says which are read.

    Attributes:
        mimics: Leader, multiplier and offset [rad or m] of each coupled joint.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        joints: Collection[int],
        bodies: Collection[int],
        document: MjcfDocument,
        findings: list[Finding],
    ) -> None:
        self.mimics: dict[int, tuple[int, float, float]] = {}
        self._model, self._document, self._findings = model, document, findings
        self._joints, self._bodies = set(joints), set(bodies)
        for k in range(model.neq):
            if model.eq_active0[k] and any(map(self._is_on_robot, self._ends(k))):
                self._add(k)
        for tendon in range(model.ntendon):
            if self._is_on_robot((_OBJ.mjOBJ_TENDON, tendon)):
                self._require_actuation_only(tendon)

    def _ends(self, equality: int) -> list[tuple[int, int]]:
        """Return the type and the index of the one or two objects at the ends of a constraint."""
        model = self._model
        kind = _CONSTRAINED.get(_EQ(model.eq_type[equality]), model.eq_objtype[equality])
        ends = (model.eq_obj1id[equality], model.eq_obj2id[equality])
        return [(kind, int(k)) for k in ends if k >= 0]

    def _bodies_of(self, kind: int, k: int) -> set[int]:
        """Return the bodies that an object of MuJoCo is of; none for joints of other robots."""
        model = self._model
        match _OBJ(kind):
            case _OBJ.mjOBJ_JOINT:
                return {int(model.jnt_bodyid[k])} if k in self._joints else set()
            case _OBJ.mjOBJ_SITE:
                return {int(model.site_bodyid[k])}
            case _OBJ.mjOBJ_GEOM:
                return {int(model.geom_bodyid[k])}
            case _OBJ.mjOBJ_TENDON:
                wraps = [(_WRAPPED.get(_WRAP(model.wrap_type[w])), w) for w in self._wraps(k)]
                items = [(kind, int(model.wrap_objid[w])) for kind, w in wraps if kind is not None]
                return {body for item in items for body in self._bodies_of(*item)}
        return {k}

    def _is_on_robot(self, item: tuple[int, int]) -> bool:
        return not self._bodies.isdisjoint(self._bodies_of(*item))

    def _add(self, k: int) -> None:
        """Add a constraint to the mimics, or a finding about it."""
        model, ends = self._model, self._ends(k)
        kind = _EQ(model.eq_type[k])
        names = (mujoco.mj_id2name(model, int(object_type), end) or "" for object_type, end in ends)
        name = model.equality(k).name or " - ".join(names)
        if kind == _EQ.mjEQ_JOINT:
            self._add_joint_equality(k, name)
        elif kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD) and any(
            body not in self._bodies and model.body_mocapid[body] >= 0
            for end in ends
            for body in self._bodies_of(*end)
        ):
            where = f"{self._document.path.name}: equality {name!r}"
            self._findings.append(found("mocap-constraint", where))
        else:
            word = kind.name.removeprefix("mjEQ_").lower()
            raise self._document.error(
                f"equality {name!r}: a {word} constraint has no counterpart; expected joint "
                "constraints of degree 1"
            )

    def _add_joint_equality(self, k: int, name: str) -> None:
        """Add q1 - ref1 = a0 + a1 (q2 - ref2)."""
        model = self._model
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        a0, a1, *higher = (float(value) for value in model.eq_data[k, :5])
        if leader < 0:
            raise self._document.error(
                f"equality {name!r} holds a joint in place; expected joint2, or no joint"
            )
        if any(higher):
            degree = max(power for power, value in enumerate(higher, start=2) if value)
            raise self._document.error(
                f"equality {name!r}: its polycoef has degree {degree}; expected degree 1, as of a "
                "mimic joint"
            )
        self._claim(follower, name, leader)
        offset = _ref(model, follower) + a0 - a1 * _ref(model, leader)
        self.mimics[follower] = (leader, a1, offset)

    def _claim(self, joint: int, name: str, leader: int) -> None:
        """Require that the joints are of the robot, and that no other constraint determines one."""
        ends = (joint, leader)
        if outside := [_joint_label(self._model, j) for j in ends if j not in self._joints]:
            raise self._document.error(
                f"equality {name!r}: joint {listed(outside)} is not of the robot"
            )
        if joint in self.mimics:
            raise self._document.error(
                f"equality {name!r}: another one couples joint "
                f"{self._model.joint(joint).name!r}, too; expected one"
            )

    def _leader(self, joint: int) -> int:
        """Return the joint at the end of a chain of mimics, or the joint that closes a circle."""
        seen = {joint}
        while joint in self.mimics:
            joint = self.mimics[joint][0]
            if joint in seen:
                break
            seen.add(joint)
        return joint

    def _require_actuation_only(self, tendon: int) -> None:
        model = self._model
        name, wraps = model.tendon(tendon).name, self._wraps(tendon)
        if any(model.wrap_type[w] != _WRAP.mjWRAP_JOINT for w in wraps):
            raise self._document.error(
                f"tendon {name!r} is spatial, which has no counterpart; remove it and what uses it"
            )
        joints = [int(model.wrap_objid[w]) for w in wraps]
        if len({self._leader(joint) for joint in joints}) > 1:
            raise self._document.error(
                f"tendon {name!r} couples the joints "
                f"{listed(model.joint(joint).name for joint in joints)}, which has no counterpart; "
                "couple them by <equality><joint>, or remove the tendon and what uses it"
            )

    def _wraps(self, tendon: int) -> range:
        first = int(self._model.tendon_adr[tendon])
        return range(first, first + int(self._model.tendon_num[tendon]))


def _ref(model: mujoco.MjModel, joint: int) -> float:
    return float(model.qpos0[model.jnt_qposadr[joint]])


def _efforts(model: mujoco.MjModel) -> dict[int, float]:
    """Return the effort limits by joint [N m or N], where every actuator has one."""
    efforts: dict[int, float] = {}
    unlimited = set()
    for k in range(len(model.actuator_trntype)):
        if _TRN(model.actuator_trntype[k]) not in _JOINT_TRANSMISSIONS:
            continue
        joint = int(model.actuator_trnid[k, 0])
        force = _largest_force(model, k)
        if force is None:
            unlimited.add(joint)
        else:
            gear = abs(float(model.actuator_gear[k, 0]))
            efforts[joint] = efforts.get(joint, 0.0) + force * gear
    for joint in unlimited:
        efforts.pop(joint, None)
    for joint in range(model.njnt):
        if model.jnt_actfrclimited[joint]:
            efforts[joint] = float(abs(model.jnt_actfrcrange[joint]).max())
    return efforts


def _largest_force(model: mujoco.MjModel, actuator: int) -> float | None:
    if model.actuator_forcelimited[actuator]:
        return float(abs(model.actuator_forcerange[actuator]).max())
    is_motor = (
        model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_FIXED
        and model.actuator_biastype[actuator] == mujoco.mjtBias.mjBIAS_NONE
        and model.actuator_dyntype[actuator] == mujoco.mjtDyn.mjDYN_NONE
    )
    # From MuJoCo 4 on, an actuator may have several controls; a motor has one.
    control = (
        int(model.actuator_ctrladr[actuator]) if hasattr(model, "actuator_ctrladr") else actuator
    )
    if is_motor and model.actuator_ctrllimited[control]:
        gain = abs(float(model.actuator_gainprm[actuator, 0]))
        return gain * float(abs(model.actuator_ctrlrange[control]).max())
    return None
