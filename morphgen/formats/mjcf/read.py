"""Read a robot from an MJCF, as MuJoCo compiles it."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

from morphgen.errors import nearest
from morphgen.formats.mjcf.compile import compile_document, ellipsoid_mesh, inline_meshes
from morphgen.formats.mjcf.document import GEOM_TYPES, MjcfDocument, listed, read_document
from morphgen.formats.resolve import PackageFinder, default_finder
from morphgen.formats.urdf.read import require_description_file
from morphgen.formats.urdf.write import BOUND_MASS
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
from morphgen.model.tree import take_name
from morphgen.typing import Array

WORLD = 0  # index of the world body
_JOINT = mujoco.mjtJoint
_REFUSED_JOINTS = {
    _JOINT.mjJNT_BALL: ("type ball; expected hinge or slide, such as three hinges at one place"),
    _JOINT.mjJNT_FREE: (
        "type free, which only the root of a robot may have; name it by --root-link BODY of "
        "morphgen import"
    ),
}
FLOOR_GEOMS = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
"""Types of geoms that are a floor where the world has them."""


@dataclass(frozen=True)
class RobotBodies:
    """The bodies of a robot."""

    bodies: tuple[int, ...]
    """Indices of the bodies, root first, parents before children."""
    joints: frozenset[int]
    """Indices of the joints between these bodies."""
    findings: tuple[Finding, ...] = ()
    """Findings about shapes of the world that were left out of the robot."""

    @property
    def root(self) -> int:
        """Index of the root's body."""
        return self.bodies[0]


def robot_bodies(
    model: mujoco.MjModel, document: MjcfDocument, root_body: str | None = None
) -> RobotBodies:
    """Return the bodies that are the robot.

    With ``root_body`` it is that body with all below it; its own joints are left out. Otherwise it
    is the one body in the world: with a free joint, which is left out, or welded to the world at
    its origin. If that body is elsewhere or moves, or the world has shapes other than planes, the
    world is the root. It is also the root of several bodies that all have joints, as of two arms.
    """
    findings: tuple[Finding, ...] = ()
    if root_body is not None:
        names = [model.body(body).name for body in range(model.nbody)]
        if root_body not in names:
            hint = nearest(root_body, names)
            raise document.error(f"no body {root_body!r} for root link{hint}")
        root = names.index(root_body)
    else:
        top = [body for body in range(1, model.nbody) if model.body_parentid[body] == WORLD]
        root, findings = _root(model, top, document)
    bodies = _below(model, root)
    kept = set(bodies)
    joints = frozenset(
        joint
        for joint in range(model.njnt)
        if model.jnt_bodyid[joint] in kept and model.jnt_bodyid[joint] != root
    )
    for kind, why in _REFUSED_JOINTS.items():
        if refused := [j for j in sorted(joints) if model.jnt_type[j] == kind]:
            labels = listed(joint_label(model, joint) for joint in refused)
            raise document.error(f"joint {labels}: {why}")
    return RobotBodies(bodies, joints, findings)


def joint_label(model: mujoco.MjModel, joint: int) -> str:
    """Return a joint's name, or for one without a name its body's."""
    return model.joint(joint).name or f"(of {body_label(model, int(model.jnt_bodyid[joint]))})"


def body_label(model: mujoco.MjModel, body: int) -> str:
    """Return a body's name, or for one without a name its number."""
    return model.body(body).name or f"(body {body})"


def _root(
    model: mujoco.MjModel, top: list[int], document: MjcfDocument
) -> tuple[int, tuple[Finding, ...]]:
    if not top:
        raise document.error("it has no bodies; expected at least one in <worldbody>")
    if len(top) > 1:
        still = [body for body in top if not _has_joints(model, body)]
        loose = [body for body in top if _is_free(model, body)]
        if still or loose:
            names = listed(body_label(model, body) for body in top)
            raise document.error(
                f"the world holds the bodies {names}, of which {_label(model, still or loose)}; "
                "name the robot's by --root-link BODY of morphgen import"
            )
        return WORLD, ()
    body = top[0]
    shapes = [
        g for g in _geoms(model, WORLD) if mujoco.mjtGeom(model.geom_type[g]) not in FLOOR_GEOMS
    ]
    if _is_free(model, body):
        return body, _left_out(model, shapes, document)
    is_welded = (
        model.body_jntnum[body] == 0
        and not shapes
        and not model.body_pos[body].any()
        and np.array_equal(model.body_quat[body], (1, 0, 0, 0))
    )
    return (body if is_welded else WORLD), ()


def _label(model: mujoco.MjModel, bodies: list[int]) -> str:
    word = "is free" if _is_free(model, bodies[0]) else "has no joints"
    return f"{body_label(model, bodies[0])!r} {word}"


def _left_out(
    model: mujoco.MjModel, geoms: list[int], document: MjcfDocument
) -> tuple[Finding, ...]:
    if not geoms:
        return ()
    return (
        Finding(
            "world-shapes",
            "warning",
            f"{document.path.name}: worldbody",
            f"{len(geoms)} geoms of the world stand beside a robot with a free base",
            "put them into a body of the robot, if they belong to it",
            f"{len(geoms)} geoms of the world were left out",
        ),
    )


def _geoms(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_geomadr[body])
    return range(first, first + int(model.body_geomnum[body]))


def _is_free(model: mujoco.MjModel, body: int) -> bool:
    joint = model.body_jntadr[body]
    return bool(joint >= 0 and model.jnt_type[joint] == _JOINT.mjJNT_FREE)


def _has_joints(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body or one below it has a joint."""
    return any(model.body_jntnum[other] for other in _below(model, body))


def _below(model: mujoco.MjModel, body: int) -> tuple[int, ...]:
    """Return a body and those below it, parents before children."""
    kept = {body: None}
    for other in range(body + 1, model.nbody):
        if int(model.body_parentid[other]) in kept:
            kept[other] = None
    return tuple(kept)


_GEOM = mujoco.mjtGeom
_LAST_DRAWN_GROUP = 2  # last geom group that MuJoCo's viewers show
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)  # colour of a geom that names none


@dataclass(frozen=True)
class BodyShapes:
    """Shapes of a body, in the body's frame."""

    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]
    ellipsoids: tuple[str, ...] = ()
    """Labels of the geoms that are ellipsoids, which meshes approximate."""

    def moved(self, T_link_body: Pose) -> BodyShapes:
        """Return the shapes in the frame of a link."""
        if T_link_body.is_identity:
            return self
        visuals, collisions = (
            tuple(replace(s, T_link_shape=T_link_body @ s.T_link_shape) for s in shapes)
            for shapes in (self.visuals, self.collisions)
        )
        return replace(self, visuals=visuals, collisions=collisions)


def body_shapes(
    spec: mujoco.MjSpec, model: mujoco.MjModel, body: int, document: MjcfDocument
) -> BodyShapes:
    """Return the shapes of a body.

    A geom without contacts (``contype`` and ``conaffinity`` are zero) in groups 0 to 2 is a visual
    shape. A geom with contacts, or one of a ``<pair>``, is a collision shape; those of groups 0 to
    2 are drawn, too, if the body has no visual shapes of its own. Planes and height fields of the
    world are its floor and left out, as are geoms that neither touch nor are drawn.

    An ellipsoid becomes a convex mesh of its volume, or a sphere if its radii are equal.

    MuJoCo moves meshes to their centre of mass and principal axes; the shapes are again in the
    coordinates of the mesh files.
    """
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    drawn: list[Shape] = []
    refused: dict[str, list[str]] = {}
    ellipsoids: list[str] = []
    for geom in _geoms(model, body):
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) or geom in paired
        rgba = _rgba(model, geom)
        is_drawn = model.geom_group[geom] <= _LAST_DRAWN_GROUP and (rgba is None or rgba[3] > 0)
        kind = _GEOM(model.geom_type[geom])
        is_floor = body == WORLD and kind in FLOOR_GEOMS
        if is_floor or not (touches or is_drawn):
            continue
        geometry, T_body_shape = _geometry(spec, model, geom, document)
        name = model.geom(geom).name or f"(of {body_label(model, body)})"
        if kind == _GEOM.mjGEOM_ELLIPSOID and isinstance(geometry, Mesh):
            ellipsoids.append(name)
        if geometry is None:
            refused.setdefault(kind.name.removeprefix("mjGEOM_").lower(), []).append(name)
            continue
        shape = Shape(geometry, T_body_shape)
        if touches:
            collisions.append(shape)
        if is_drawn:
            (drawn if touches else visuals).append(replace(shape, rgba=rgba))
    for form, names in refused.items():
        raise document.error(f"geom {listed(names)}: type {form}; expected {GEOM_TYPES}")
    return BodyShapes(tuple(visuals or drawn), tuple(collisions), tuple(ellipsoids))


def ellipsoid_findings(geoms: Sequence[str], document: MjcfDocument) -> tuple[Finding, ...]:
    """Return a finding about ellipsoids that became meshes; none without ellipsoids."""
    if not geoms:
        return ()
    return (
        Finding(
            "ellipsoid-mesh",
            "info",
            f"{document.path.name}: geom {listed(geoms)}",
            "a robot has no ellipsoids",
            "use a capsule, if the shape has to be exact",
            "became a convex mesh of the volume of the ellipsoid",
        ),
    )


def _geometry(
    spec: mujoco.MjSpec, model: mujoco.MjModel, geom: int, document: MjcfDocument
) -> tuple[Geometry | None, Pose]:
    """Return a geom's geometry and its pose in the body's frame; None if it has no counterpart."""
    a, b, c = model.geom_size[geom].tolist()
    T_body_geom = pose_of(model.geom_pos[geom], model.geom_quat[geom])
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
            k = model.geom_dataid[geom]
            name = model.mesh(k).name
            T_mesh_geom = pose_of(model.mesh_pos[k], model.mesh_quat[k])
            mesh, T_mesh_file = _mesh(spec.mesh(name), document)
            return mesh, T_body_geom @ T_mesh_geom.inverse() @ T_mesh_file
        case _:
            return None, T_body_geom


def _mesh(asset: mujoco.MjsMesh, document: MjcfDocument) -> tuple[Mesh, Pose]:
    """Return a mesh asset as its file with a scale, and the pose of that in the asset's frame.

    MuJoCo maps a vertex v of the file to S R^T (v - p), with the position p and rotation R of
    ``refpos`` and ``refquat`` and the scale S.
    """
    x, y, z = (float(value) for value in asset.scale)
    T_ref_file = pose_of(asset.refpos, asset.refquat).inverse()
    if T_ref_file.quaternion != rotation.IDENTITY and not x == y == z:
        raise document.error(
            f"mesh {asset.name!r} is turned by refquat and has the uneven scale {x:g} {y:g} {z:g}; "
            "turn the vertices in its file"
        )
    px, py, pz = T_ref_file.position
    T_asset_file = Pose((x * px, y * py, z * pz), T_ref_file.quaternion)
    return Mesh(document.meshes[asset.name], (x, y, z)), T_asset_file


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


def pose_of(position: Array, quaternion: Array) -> Pose:
    """Return a pose from MuJoCo's position (3,) [m] and quaternion (4,), (w, x, y, z)."""
    x, y, z = (float(value) for value in position)
    a, b, c, d = (float(value) for value in quaternion)
    return Pose((x, y, z), rotation.normalize((a, b, c, d)))


_TOOL_WORDS = ("tool", "tcp", "attachment", "pinch", "grip", "grasp", "ee", "eef", "end_effector")
"""Words in the name of a site that make it the tool, the most specific first."""


def read_frames(
    model: mujoco.MjModel,
    links: Mapping[int, str],
    T_link_body: Mapping[int, Pose],
    joints: Sequence[Joint],
) -> tuple[Frame, ...]:
    """Return a frame for every site with a name.

    A URDF has a link and a joint for a frame; a site whose name they would take from another link
    or joint gets ``_site`` appended. If neither a site nor a link is called ``tool``, the first
    site with a word such as ``attachment``, ``tcp`` or ``grip`` in its name is the frame ``tool``,
    besides its own. The order of the words decides, then that of the file.
    """
    taken = {*links.values(), *(joint.parent for joint in joints), *(j.child for j in joints)}
    joint_names = {joint.name for joint in joints}
    sites = []
    for site in range(model.nsite):
        body = int(model.site_bodyid[site])
        if model.site(site).name and body in links:
            T_body_site = pose_of(model.site_pos[site], model.site_quat[site])
            sites.append((model.site(site).name, links[body], T_link_body[body] @ T_body_site))
    names = {*taken, *(name for name, _, _ in sites)}
    frames = []
    for name, link, T_link_site in sites:
        is_taken = name in taken or f"{name}_joint" in joint_names
        own = take_name(f"{name}_site", names) if is_taken else name
        frames.append(Frame(own, link, T_link_site))
    if TOOL in taken or any(frame.name == TOOL for frame in frames):
        return tuple(frames)
    tool = next(
        (frame for word in _TOOL_WORDS for frame in frames if _has_word(frame.name, word)), None
    )
    if tool is None:
        return tuple(frames)
    return (*frames, Frame(TOOL, tool.link, tool.T_link_frame))


def _has_word(name: str, word: str) -> bool:
    """Return whether a name has a word: ``grip`` in ``left_gripper``, ``ee`` only on its own."""
    ending = "" if len(word) > 3 else r"(?![a-z])"
    return re.search(rf"(?<![a-z]){word}{ending}", name.lower()) is not None


_EQ = mujoco.mjtEq
_OBJ = mujoco.mjtObj
_WRAP = mujoco.mjtWrap
_WRAPPED_GEOMS = (_WRAP.mjWRAP_SPHERE, _WRAP.mjWRAP_CYLINDER)


@dataclass(frozen=True)
class Couplings:
    """Requirements of equality constraints on joints, by the index of the joint."""

    mimics: dict[int, tuple[int, float, float]] = field(default_factory=dict)
    """Leader, multiplier and offset [rad or m] of each coupled joint."""
    locks: dict[int, float] = field(default_factory=dict)
    """Position of each joint that is held in place [rad or m]."""
    findings: list[Finding] = field(default_factory=list)
    """Constraints that were left out."""

    def mimic(self, joint: int, model: mujoco.MjModel, names: dict[int, str]) -> Mimic | None:
        """Return the mimic of a joint; None if it is independent."""
        if joint not in self.mimics:
            return None
        leader, multiplier, offset = self.mimics[joint]
        return Mimic(names[leader], multiplier, offset)

    def leader(self, joint: int) -> int:
        """Return the joint at the end of a chain of mimics, or the joint that closes a circle."""
        seen = {joint}
        while joint in self.mimics:
            joint = self.mimics[joint][0]
            if joint in seen:
                break
            seen.add(joint)
        return joint


@dataclass(frozen=True)
class _Scope:
    """The part of a compiled model that becomes a robot."""

    model: mujoco.MjModel
    joints: Collection[int]
    bodies: Collection[int]
    document: MjcfDocument


def read_couplings(
    model: mujoco.MjModel, joints: Collection[int], bodies: Collection[int], document: MjcfDocument
) -> Couplings:
    """Return the couplings among joints, and refuse the constraints that a robot cannot have.

    An active ``<equality><joint>`` of degree 1 is a mimic; one without ``joint2`` holds its joint.
    An ``<equality><tendon>`` of one fixed tendon of two joints is a mimic, too. Other tendons are
    accepted only if they merely drive joints that follow the same leader. Constraints to mocap
    bodies outside the robot, by which users drag it, are left out with a finding. Inactive
    constraints have no effect.
    """
    scope, couplings = _Scope(model, joints, bodies, document), Couplings()
    resolved_tendons = set()
    for k in range(model.neq):
        kind = _EQ(model.eq_type[k])
        if not model.eq_active0[k] or not _touches(scope, k, kind):
            continue
        name = model.equality(k).name or _ends(model, k, kind)
        if kind == _EQ.mjEQ_JOINT:
            _add_joint_equality(scope, couplings, k, name)
        elif kind == _EQ.mjEQ_TENDON and _add_tendon_equality(scope, couplings, k, name):
            resolved_tendons.add(int(model.eq_obj1id[k]))
        elif _is_handle(scope, k, kind):
            couplings.findings.append(
                Finding(
                    "mocap-constraint",
                    "warning",
                    f"{document.path.name}: equality {name!r}",
                    "it connects the robot to a mocap body, which is not of the robot",
                    "remove it, if it is not needed",
                    "a constraint to a mocap body was left out",
                )
            )
        else:
            word = kind.name.removeprefix("mjEQ_").lower()
            raise document.error(
                f"equality {name!r}: a {word} constraint has no counterpart; expected joint "
                "constraints of degree 1"
            )
    _lock_followers(couplings)
    for tendon in range(model.ntendon):
        if tendon not in resolved_tendons:
            _require_actuation_only(scope, couplings, tendon)
    return couplings


def _touches(scope: _Scope, equality: int, kind: mujoco.mjtEq) -> bool:
    """Return whether a constraint acts on a joint or body of the robot."""
    ends = _objects(scope.model, equality)
    if kind == _EQ.mjEQ_JOINT:
        return any(end in scope.joints for end in ends)
    if kind == _EQ.mjEQ_TENDON:
        return any(_tendon_touches(scope, end) for end in ends)
    return any(body in scope.bodies for body in _connected_bodies(scope.model, equality))


def _objects(model: mujoco.MjModel, equality: int) -> list[int]:
    """Return the indices of the one or two objects at the ends of a constraint."""
    return [int(k) for k in (model.eq_obj1id[equality], model.eq_obj2id[equality]) if k >= 0]


def _connected_bodies(model: mujoco.MjModel, equality: int) -> list[int]:
    """Return the bodies at the ends of a constraint other than of joints and tendons."""
    ends = _objects(model, equality)
    if model.eq_objtype[equality] == _OBJ.mjOBJ_SITE:
        return [int(model.site_bodyid[end]) for end in ends]
    if model.eq_objtype[equality] == _OBJ.mjOBJ_GEOM:
        return [int(model.geom_bodyid[end]) for end in ends]
    return ends


def _is_handle(scope: _Scope, equality: int, kind: mujoco.mjtEq) -> bool:
    """Return whether a constraint connects the robot to a mocap body that is not of the robot."""
    return kind in (_EQ.mjEQ_CONNECT, _EQ.mjEQ_WELD) and any(
        body not in scope.bodies and scope.model.body_mocapid[body] >= 0
        for body in _connected_bodies(scope.model, equality)
    )


def _ends(model: mujoco.MjModel, equality: int, kind: mujoco.mjtEq) -> str:
    """Return what a constraint without a name connects."""
    object_type = {_EQ.mjEQ_JOINT: _OBJ.mjOBJ_JOINT, _EQ.mjEQ_TENDON: _OBJ.mjOBJ_TENDON}.get(
        kind, model.eq_objtype[equality]
    )
    ends = _objects(model, equality)
    return " - ".join(mujoco.mj_id2name(model, int(object_type), end) or "" for end in ends)


def _add_joint_equality(scope: _Scope, couplings: Couplings, k: int, name: str) -> None:
    """Add q1 - ref1 = a0 + a1 (q2 - ref2), or a1 = 0 without a second joint."""
    model = scope.model
    follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
    a0, a1, *higher = (float(value) for value in model.eq_data[k, :5])
    if leader < 0:
        _claim(scope, couplings, follower, name)
        couplings.locks[follower] = _ref(model, follower) + a0
        return
    if any(higher):
        degree = max(power for power, value in enumerate(higher, start=2) if value)
        raise scope.document.error(
            f"equality {name!r}: its polycoef has degree {degree}; expected degree 1, as of a "
            "mimic joint"
        )
    _require_own_joints(scope, (follower, leader), name)
    _claim(scope, couplings, follower, name)
    offset = _ref(model, follower) + a0 - a1 * _ref(model, leader)
    couplings.mimics[follower] = (leader, a1, offset)


def _add_tendon_equality(scope: _Scope, couplings: Couplings, k: int, name: str) -> bool:
    """Add c1 q1 + c2 q2 = length0 + a0 of a fixed tendon; return False if it is something else."""
    model = scope.model
    terms = _terms(model, int(model.eq_obj1id[k]))
    if model.eq_obj2id[k] >= 0 or terms is None or len({joint for joint, _ in terms}) != 2:
        return False
    (leader, c_leader), *others = terms
    follower, c_follower = others[0]
    if len(others) > 1 or c_follower == 0:
        return False
    _require_own_joints(scope, (follower, leader), name)
    _claim(scope, couplings, follower, name)
    length = float(model.tendon_length0[model.eq_obj1id[k]]) + float(model.eq_data[k, 0])
    couplings.mimics[follower] = (leader, -c_leader / c_follower, length / c_follower)
    return True


def _require_own_joints(scope: _Scope, ends: Iterable[int], name: str) -> None:
    outside = [joint_label(scope.model, joint) for joint in ends if joint not in scope.joints]
    if outside:
        raise scope.document.error(
            f"equality {name!r}: joint {listed(outside)} is not of the robot"
        )


def _lock_followers(couplings: Couplings) -> None:
    """Hold the joints that follow a joint that is held."""
    mimics, locks = couplings.mimics, couplings.locks
    while held := [joint for joint, (leader, _, _) in mimics.items() if leader in locks]:
        for joint in held:
            leader, multiplier, offset = mimics.pop(joint)
            locks[joint] = multiplier * locks[leader] + offset


def _require_actuation_only(scope: _Scope, couplings: Couplings, tendon: int) -> None:
    if not _tendon_touches(scope, tendon):
        return
    model, document = scope.model, scope.document
    name = model.tendon(tendon).name
    terms = _terms(model, tendon)
    if terms is None:
        raise document.error(
            f"tendon {name!r} is spatial, which has no counterpart; remove it and what uses it"
        )
    moving = [joint for joint, _ in terms if joint not in couplings.locks]
    if len({couplings.leader(joint) for joint in moving}) > 1:
        raise document.error(
            f"tendon {name!r} couples the joints "
            f"{listed(model.joint(joint).name for joint in moving)}, which has no counterpart; "
            "couple them by <equality><joint>, or remove the tendon and what uses it"
        )


def _terms(model: mujoco.MjModel, tendon: int) -> list[tuple[int, float]] | None:
    """Return joint and coefficient of every term of a fixed tendon; None for a spatial tendon."""
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    if any(model.wrap_type[w] != _WRAP.mjWRAP_JOINT for w in wraps):
        return None
    return [(int(model.wrap_objid[w]), float(model.wrap_prm[w])) for w in wraps]


def _tendon_touches(scope: _Scope, tendon: int) -> bool:
    model = scope.model
    terms = _terms(model, tendon)
    if terms is not None:
        return any(joint in scope.joints for joint, _ in terms)
    first = int(model.tendon_adr[tendon])
    for w in range(first, first + int(model.tendon_num[tendon])):
        item = int(model.wrap_objid[w])
        kind = _WRAP(model.wrap_type[w])
        if kind == _WRAP.mjWRAP_SITE and int(model.site_bodyid[item]) in scope.bodies:
            return True
        if kind in _WRAPPED_GEOMS and int(model.geom_bodyid[item]) in scope.bodies:
            return True
    return False


def _claim(scope: _Scope, couplings: Couplings, joint: int, name: str) -> None:
    """Require that no other constraint determines a joint."""
    if joint in couplings.mimics or joint in couplings.locks:
        raise scope.document.error(
            f"equality {name!r}: another one couples joint {scope.model.joint(joint).name!r}, too; "
            "expected one"
        )


def _ref(model: mujoco.MjModel, joint: int) -> float:
    return float(model.qpos0[model.jnt_qposadr[joint]])


_TRN = mujoco.mjtTrn
_JOINT_TRANSMISSIONS = (_TRN.mjTRN_JOINT, _TRN.mjTRN_JOINTINPARENT)


def read_efforts(model: mujoco.MjModel) -> dict[int, float]:
    """Return the effort limits by joint [N m or N].

    A joint's ``actuatorfrcrange`` comes first. Without it, the limits of the actuators on the joint
    are added up: their ``forcerange``, or for motors without one the ``ctrlrange`` times the gain;
    each times the gear. A joint has no effort limit if one of its actuators has none.
    """
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


_HOME = "home"  # name of the keyframe that is the home configuration
_TOLERANCE = 1e-9  # excess over a limit at which a home position is still within it [rad or m]


def read_mjcf(
    path: Path, finder: PackageFinder | None = None, *, root_body: str | None = None
) -> Robot:
    """Read an MJCF, with its defaults, angles and inertias resolved by MuJoCo.

    Bodies become links, hinges revolute or continuous joints, slides prismatic joints, and bodies
    without a joint are fixed. Links without mass, named ``BODY_JOINT``, separate several joints of
    a body. A link's frame is its body's; if the body's last hinge has a ``pos``, the frame is there
    instead, as URDF requires. A joint's position is MuJoCo's, also with a ``ref``.

    Meshes without a file and ellipsoids get one in the user's cache; see ``mjcf.compile``.

    ``robot_bodies`` says which bodies are the robot, ``body_shapes`` which geoms are visual and
    collision shapes, ``read_couplings`` what becomes a mimic joint, ``read_efforts`` how joints get
    effort limits, and ``read_frames`` what becomes the frame ``tool``. Masses up to that of
    ``mjcf_text`` for links without mass count as none. The keyframe ``home``, or the first one, is
    the home configuration if it is within the limits; otherwise every joint is at its ``ref``, or
    in the middle of its range. ``<exclude>`` makes ignored pairs. What a ``Robot`` does not hold is
    left out: stiffness, armature, gains, sensors, cameras, lights and textures.
    """
    require_description_file(path)
    document = read_document(path, finder or default_finder())
    spec, model, warnings = compile_document(document)
    document = replace(document, meshes={**document.meshes, **inline_meshes(spec, document)})
    chosen = robot_bodies(model, document, root_body)
    couplings = read_couplings(model, chosen.joints, chosen.bodies, document)
    tree = _Tree(model, chosen, couplings)
    links, ignored = [], []
    ellipsoids: list[str] = []
    for body in chosen.bodies:
        for joint in tree.steps[body][:-1]:
            links.append(Link(joint.child))
        shapes = body_shapes(spec, model, body, document).moved(tree.T_link_body[body])
        links.append(_link(model, body, tree, shapes))
        ellipsoids += shapes.ellipsoids
    for signature in model.exclude_signature.tolist():
        a, b = signature >> 16, signature & 0xFFFF
        if a in tree.link and b in tree.link:
            ignored.append(sorted_pair(tree.link[a], tree.link[b]))
    joints = tuple(joint for body in chosen.bodies for joint in tree.steps[body])
    home, findings = _home(model, joints, tree, document)
    return Robot(
        document.name,
        tuple(links),
        joints,
        read_frames(model, tree.link, tree.T_link_body, joints),
        home,
        tuple(sorted(set(ignored))),
        source_findings=(
            *document.findings,
            *warnings,
            *chosen.findings,
            *couplings.findings,
            *findings,
            *ellipsoid_findings(ellipsoids, document),
        ),
    )


class _Tree:
    """Joints and link frames of the bodies.

    Attributes:
        link: Name of the link of every body.
        T_link_body: Pose of every body's frame in its link's frame.
        steps: Joints that attach every body's link to that of its parent, with links in between.
        joint_index: Index in the model of every movable joint by name.
    """

    def __init__(self, model: mujoco.MjModel, chosen: RobotBodies, couplings: Couplings) -> None:
        names = {model.body(body).name for body in chosen.bodies}
        self._link_names = names
        self._joint_names = {model.joint(j).name for j in chosen.joints}
        self._model = model
        self._couplings = couplings
        self._efforts = read_efforts(model)
        self.link = {
            body: model.body(body).name or take_name(f"body_{body}", self._link_names)
            for body in chosen.bodies
        }
        self._names = {
            joint: model.joint(joint).name
            or take_name(f"{self.link[int(model.jnt_bodyid[joint])]}_joint", self._joint_names)
            for joint in sorted(chosen.joints)
        }
        self.joint_index = {name: joint for joint, name in self._names.items()}
        self.T_link_body: dict[int, Pose] = {chosen.root: IDENTITY}
        self.steps: dict[int, list[Joint]] = {chosen.root: []}
        for body in chosen.bodies[1:]:
            self._attach(body)

    def _attach(self, body: int) -> None:
        model = self._model
        parent = int(model.body_parentid[body])
        link, name = self.link[parent], self.link[body]
        T = self.T_link_body[parent] @ pose_of(model.body_pos[body], model.body_quat[body])
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        self.steps[body] = []
        for joint in range(first, first + count):
            is_last = joint == first + count - 1
            own = self._names[joint]
            child = name if is_last else take_name(f"{name}_{own}", self._link_names)
            step, T = self._joint(joint, own, link, child, T)
            self.steps[body].append(step)
            link = child
        if count == 0:
            own = take_name(f"{name}_joint", self._joint_names)
            self.steps[body].append(Joint(own, "fixed", link, name, T))
            T = IDENTITY
        self.T_link_body[body] = T

    def _joint(
        self, joint: int, name: str, parent: str, child: str, T_parent_body: Pose
    ) -> tuple[Joint, Pose]:
        """Return a joint, and the pose of its body's frame in the frame of its child link."""
        model = self._model
        is_slide = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        axis = _vector(model.jnt_axis[joint])
        # The link of a hinge is at its anchor; a slide moves every point alike.
        anchor = (0.0, 0.0, 0.0) if is_slide else _vector(model.jnt_pos[joint])
        position = self._couplings.locks.get(joint, 0.0)
        motion = position - float(model.qpos0[model.jnt_qposadr[joint]])
        T_parent_joint = T_parent_body @ Pose(anchor) @ _displacement(is_slide, axis, motion)
        T_child_body = Pose((-anchor[0], -anchor[1], -anchor[2])) if any(anchor) else IDENTITY
        if joint in self._couplings.locks:
            return Joint(name, "fixed", parent, child, T_parent_joint, axis), T_child_body
        lower, upper = model.jnt_range[joint].tolist()
        is_limited = bool(model.jnt_limited[joint])
        kind: JointKind = "prismatic" if is_slide else "revolute" if is_limited else "continuous"
        dof = int(model.jnt_dofadr[joint])
        return (
            Joint(
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
                mimic=self._couplings.mimic(joint, model, self._names),
            ),
            T_child_body,
        )


def _displacement(is_slide: bool, axis: Vec3, motion: float) -> Pose:
    """Return the displacement of a joint that moves by an angle [rad] or a length [m]."""
    if motion == 0.0:
        return IDENTITY
    x, y, z = axis
    if is_slide:
        return Pose((motion * x, motion * y, motion * z))
    sine = math.sin(motion / 2)
    return pose_of(np.zeros(3), np.array([math.cos(motion / 2), sine * x, sine * y, sine * z]))


def _link(model: mujoco.MjModel, body: int, tree: _Tree, shapes: BodyShapes) -> Link:
    """Return the link of a body, with its mass properties in the link's frame."""
    inertial = None
    if body != WORLD and model.body_mass[body] > BOUND_MASS * (1 + 1e-9):
        T = tree.T_link_body[body] @ pose_of(model.body_ipos[body], model.body_iquat[body])
        R = T.matrix[:3, :3]
        matrix = R @ np.diag(model.body_inertia[body]) @ R.T
        inertial = Inertial.from_matrix(float(model.body_mass[body]), T.position, matrix)
    return Link(tree.link[body], inertial, shapes.visuals, shapes.collisions)


def _home(
    model: mujoco.MjModel, joints: tuple[Joint, ...], tree: _Tree, document: MjcfDocument
) -> tuple[tuple[float, ...], tuple[Finding, ...]]:
    """Return the home configuration, and a finding about a keyframe that is out of limits."""
    keys = [model.key(k).name for k in range(model.nkey)]
    key = keys.index(_HOME) if _HOME in keys else 0
    independent = [joint for joint in joints if joint.is_independent]
    address = {
        joint.name: int(model.jnt_qposadr[tree.joint_index[joint.name]]) for joint in independent
    }
    outside = []
    if keys:
        home = tuple(float(model.key_qpos[key, address[joint.name]]) for joint in independent)
        outside = [
            joint.name
            for joint, q in zip(independent, home, strict=True)
            if not _is_within(joint, q)
        ]
        if not outside:
            return home, ()
    refs = [(joint, float(model.qpos0[address[joint.name]])) for joint in independent]
    home = tuple(q if _is_within(j, q) else sum(j.effective_limits) / 2 for j, q in refs)
    if not outside:
        return home, ()
    finding = Finding(
        "keyframe-outside-limits",
        "warning",
        f"{document.path.name}: key {keys[key]!r}",
        f"the position of joint {outside[0]!r} is outside its limits",
        "correct qpos of the keyframe",
        "the keyframe was left out; home is the reference position",
    )
    return home, (finding,)


def _is_within(joint: Joint, position: float) -> bool:
    if joint.limits is None:
        return True
    lower, upper = joint.limits
    return lower - _TOLERANCE <= position <= upper + _TOLERANCE


def _vector(values: np.ndarray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
