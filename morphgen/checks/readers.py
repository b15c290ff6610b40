"""Read a bundle with other libraries: joints, total mass and poses of a frame.

A library opens whatever a description names: files elsewhere on the machine, pipes that never end,
meshes with references of their own. Therefore a loader gets a copy (``loader_copy``): the
description with known elements only, its includes inserted, and its meshes rewritten, in a private
folder.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from lxml import etree

from morphgen.errors import FormatError, one_line
from morphgen.formats.bundle import MJCF, URDF, is_mjcf, mesh_file
from morphgen.formats.mjcf.document import read_document, remove_element
from morphgen.formats.quiet import quiet
from morphgen.formats.resolve import PackageFinder, default_finder, resolve_uri
from morphgen.formats.urdf import read
from morphgen.formats.urdf.schema import CHILDREN
from morphgen.formats.xml import parse_description
from morphgen.model.dynamics import GRAVITY
from morphgen.model.geometry import Mesh, Pose
from morphgen.model.mesh import require_bounded_meshes
from morphgen.model.robot import Mimic
from morphgen.typing import Array

if TYPE_CHECKING:
    import mujoco
    import pinocchio
    import yourdfpy


NO_LIMITS = (-math.inf, math.inf)  # position limits of a joint without any [rad or m]
DYNAMICS_SAMPLES = 20  # number of configurations in which forces and inertia are compared


@dataclass(frozen=True)
class JointReading:
    """A movable joint as a loader reads it; None where the loader reads no such value."""

    limits: tuple[float, float] = NO_LIMITS  # lower and upper position limit [rad or m]
    effort: float | None = None  # effort limit, infinite without one [N m or N]
    velocity: float | None = None  # velocity limit [rad/s or m/s]
    damping: float | None = None  # viscous damping [N m s/rad or N s/m]
    friction: float | None = None  # dry friction [N m or N]
    stiffness: float = math.nan  # gain of the joint's position actuator [N m/rad or N/m]
    derivative_gain: float = math.nan  # its derivative gain [N m s/rad or N s/m]
    armature: float = math.nan  # inertia that the motor adds to the joint [kg m^2 or kg]


@dataclass(frozen=True)
class Reading:
    """Robot as a loader reads it."""

    joints: Mapping[str, JointReading]  # the movable joints by name
    mass: float  # total mass [kg]
    T_root_frame: Array  # pose of the frame in each configuration, shape (n, 4, 4)
    mimics: Mapping[str, Mimic] | None = field(default_factory=dict)
    """Couplings of the mimic joints by name; None if the loader ignores them."""
    has_actuators: bool = False  # whether the file has an actuator for every independent joint
    forces: Array | None = None
    """Forces that hold the weight of the fixed robot in the first ``DYNAMICS_SAMPLES``
    configurations, a column per joint in the order of ``joints`` [N m or N]; None, here and below,
    if the loader computes none."""
    inertia: Array | None = None
    """Joint-space inertia in these configurations, shape (samples, n_joints, n_joints) [kg m^2,
    kg m or kg], without armature and with mimic joints uncoupled."""


_MASS_SCALE = 2.0**-20  # factor of the masses with which PyBullet computes forces
_SLIDE, _HINGE = 2, 3  # MuJoCo's types of the joints that a robot has

Read = Callable[[Path, str, Mapping[str, Array], int], Reading]
"""Function of a folder, the name of a frame, or of none for the root, the positions of every
movable joint, shape (n,) [rad or m], and the number n of configurations."""


@dataclass(frozen=True)
class Loader:
    """A library that reads one file of a bundle."""

    name: str  # name of the loader and its file
    module: str  # import name of the library
    read: Read  # reads the file; raises `FormatError` if the library rejects it or lacks the frame
    file: str  # the bundle's file that it reads


def read_yourdfpy(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with yourdfpy, which moves mimic joints itself."""
    import yourdfpy

    urdf = yourdfpy.URDF.load(str(folder / URDF), load_meshes=False)
    if frame and frame not in urdf.link_map:
        raise FormatError(f"no link {frame!r}")
    poses = np.tile(np.eye(4), (n, 1, 1))
    driven = [name for name in urdf.actuated_joint_names if name in q]
    for i in range(n if frame else 0):
        urdf.update_cfg({name: float(q[name][i]) for name in driven})
        poses[i] = urdf.get_transform(frame)
    links, joints = urdf.robot.links, urdf.robot.joints
    mass = sum(link.inertial.mass for link in links if link.inertial is not None)
    movable = [joint for joint in joints if joint.type != "fixed"]
    mimics = {
        joint.name: Mimic(
            joint.mimic.joint,
            1.0 if joint.mimic.multiplier is None else joint.mimic.multiplier,
            joint.mimic.offset or 0.0,
        )
        for joint in movable
        if joint.mimic is not None
    }
    readings = {joint.name: _yourdfpy_joint(joint) for joint in movable}
    return Reading(readings, float(mass), poses, mimics)


def _yourdfpy_joint(joint: yourdfpy.Joint) -> JointReading:
    limit, dynamics = joint.limit, joint.dynamics
    limited = joint.type != "continuous" and limit is not None
    return JointReading(
        limits=(limit.lower, limit.upper) if limited else NO_LIMITS,
        effort=limit.effort if limit is not None else None,
        velocity=limit.velocity if limit is not None else None,
        # yourdfpy leaves these two as text.
        damping=float(dynamics.damping or 0.0) if dynamics is not None else 0.0,
        friction=float(dynamics.friction or 0.0) if dynamics is not None else 0.0,
    )


@contextmanager
def bullet_client() -> Iterator[Any]:
    """Yield PyBullet with a world of its own."""
    with quiet():  # it writes its build time on the first import
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        client = BulletClient(pybullet.DIRECT)
    try:
        yield client
    except pybullet.error as error:
        raise FormatError(f"PyBullet: {error}") from error
    finally:
        client.disconnect()


def read_pybullet(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with PyBullet with a floating base, because a fixed one reports no mass.

    Forces and inertia are those of a second body with a fixed base, by the inertia of the file.
    """
    with quiet(), bullet_client() as client:
        body = client.loadURDF(str(folder / URDF))
        infos = [client.getJointInfo(body, i) for i in range(client.getNumJoints(body))]
        # In PyBullet's joint infos, 0 is the index, 1 the name, 2 the type, 12 the child's name.
        movable = {info[1].decode(): info for info in infos if info[2] != client.JOINT_FIXED}
        joints = {name: _pybullet_joint(info) for name, info in movable.items()}
        links = {info[12].decode(): info[0] for info in infos}
        links[client.getBodyInfo(body)[0].decode()] = -1
        mass = sum(client.getDynamicsInfo(body, link)[0] for link in range(-1, len(infos)))
        if frame and frame not in links:
            raise FormatError(f"no link {frame!r}")
        forces, inertia = _pybullet_dynamics(client, folder / URDF, list(movable), q, n)
        poses = np.tile(np.eye(4), (n, 1, 1))
        for i in range(n if links.get(frame, -1) >= 0 else 0):
            for name in movable.keys() & q.keys():
                client.resetJointState(body, movable[name][0], float(q[name][i]))
            # Items 4 and 5 of a link state are the pose of the link's URDF frame.
            state = client.getLinkState(body, links[frame], computeForwardKinematics=1)
            x, y, z, w = state[5]
            poses[i] = Pose(state[4], (w, x, y, z)).matrix
    return Reading(joints, float(mass), poses, mimics=None, forces=forces, inertia=inertia)


def _pybullet_dynamics(
    client: Any,  # noqa: ANN401
    urdf: Path,
    names: Sequence[str],
    q: Mapping[str, Array],
    n: int,
) -> tuple[Array, Array]:
    """Return the forces and the inertia; see ``Reading``."""
    flags = client.URDF_USE_INERTIA_FROM_FILE
    body = client.loadURDF(str(urdf), useFixedBase=True, flags=flags)
    # Inverse dynamics takes gravity in the principal axes of the base, item 4 of its dynamics.
    x, y, z, w = client.getDynamicsInfo(body, -1)[4]
    R_base_axes = Pose(quaternion=(w, x, y, z)).matrix[:3, :3]
    client.setGravity(*(R_base_axes.T @ (0.0, 0.0, -GRAVITY)).tolist())
    # Inverse dynamics (PyBullet 3.2.7) refuses inertia that is not symmetric to 1e-14 kg m^2, which
    # rounding passes in links of 200 kg m^2. A power of two scales all numbers without rounding.
    for i in range(client.getNumJoints(body)):
        mass, _, moments = client.getDynamicsInfo(body, i)[:3]
        scaled = [moment * _MASS_SCALE for moment in moments]
        client.changeDynamics(body, i, mass=mass * _MASS_SCALE, localInertiaDiagonal=scaled)
    forces, inertia = _no_dynamics(names, n)
    zero = [0.0] * len(names)
    for i in range(len(forces) if names else 0):
        positions = [float(q[name][i]) if name in q else 0.0 for name in names]
        forces[i] = client.calculateInverseDynamics(body, positions, zero, zero)
        inertia[i] = client.calculateMassMatrix(body, positions)
    return forces / _MASS_SCALE, inertia / _MASS_SCALE


def _no_dynamics(names: Sequence[str], n: int) -> tuple[Array, Array]:
    samples, joints = min(n, DYNAMICS_SAMPLES), len(names)
    return np.zeros((samples, joints)), np.zeros((samples, joints, joints))


def _pybullet_joint(info: Sequence[float]) -> JointReading:
    """Return a joint from PyBullet's joint info, whose numbers are items 6 to 11."""
    damping, friction, lower, upper, effort, velocity = info[6:12]
    limits = (lower, upper) if lower <= upper else NO_LIMITS
    return JointReading(limits, effort, velocity, damping, friction)


def _pinocchio_model(urdf: Path, **options: bool) -> pinocchio.Model:
    import pinocchio

    with quiet():
        try:
            return pinocchio.buildModelFromUrdf(str(urdf), **options)
        except (ValueError, RuntimeError) as error:
            raise FormatError(f"Pinocchio: {one_line(str(error))}") from error


def read_pinocchio(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with Pinocchio, mimic joints uncoupled; a second model has the couplings."""
    import pinocchio

    model = _pinocchio_model(folder / URDF)
    model.gravity.linear = np.array([0.0, 0.0, -GRAVITY])
    kind = pinocchio.FrameType.BODY
    if frame and not model.existFrame(frame, kind):
        raise FormatError(f"no link {frame!r}")
    index, data = model.getFrameId(frame, kind) if frame else 0, model.createData()
    names = tuple(model.names)[1:]
    column = {name: model.idx_vs[k + 1] for k, name in enumerate(names)}
    columns = list(column.values())
    forces, inertia = _no_dynamics(names, n)
    poses = np.empty((n, 4, 4))
    for i in range(n):
        v = np.zeros(model.nv)
        for name in names:
            if name in q:
                v[column[name]] = q[name][i]
        # Continuous joints have a cosine and a sine in Pinocchio's q, so integrate their angle.
        configuration = pinocchio.integrate(model, pinocchio.neutral(model), v)
        pinocchio.framesForwardKinematics(model, data, configuration)
        poses[i] = data.oMf[index].homogeneous
        if i < len(forces):
            load = pinocchio.computeGeneralizedGravity(model, data, configuration)
            M = np.triu(pinocchio.crba(model, data, configuration))
            forces[i] = load[columns]
            inertia[i] = (M + np.triu(M, 1).T)[np.ix_(columns, columns)]
    joints = {name: _pinocchio_joint(model, model.getJointId(name)) for name in names}
    mass = float(sum(body.mass for body in model.inertias))
    return Reading(
        joints, mass, poses, _pinocchio_mimics(folder / URDF), forces=forces, inertia=inertia
    )


def _pinocchio_mimics(urdf: Path) -> dict[str, Mimic] | None:
    """Return the mimic joints; None if one follows a mimic or continuous one: it is refused."""
    try:
        model = _pinocchio_model(urdf, mimic=True)
    except FormatError:
        return None
    pairs = zip(model.mimicking_joints.tolist(), model.mimicked_joints.tolist(), strict=True)
    mimics = {}
    for follower, leader in pairs:
        joint = model.joints[follower].extract()
        mimics[model.names[follower]] = Mimic(model.names[leader], joint.scaling, joint.offset)
    return mimics


def _pinocchio_joint(model: pinocchio.Model, k: int) -> JointReading:
    """Return a joint of Pinocchio by its number; one with a cosine and a sine has no limits."""
    q, v, unlimited = model.idx_qs[k], model.idx_vs[k], model.nqs[k] > 1
    lower, upper = model.lowerPositionLimit, model.upperPositionLimit
    return JointReading(
        limits=NO_LIMITS if unlimited else (float(lower[q]), float(upper[q])),
        effort=float(model.effortLimit[v]),
        velocity=float(model.velocityLimit[v]),
        damping=float(model.damping[v]),
        friction=float(model.friction[v]),
    )


def load_model(path: Path) -> mujoco.MjModel:
    """Compile a URDF or MJCF with MuJoCo."""
    import mujoco

    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise FormatError(f"MuJoCo: {one_line(str(error))}") from error
    finally:
        # MuJoCo keeps up to 500 MB of meshes by their paths: here those of a copy, read once.
        mujoco.mj_clearCache(mujoco.mj_getCache())


def read_mujoco(file: str, folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read ``robot.urdf`` or ``robot.xml`` with MuJoCo, relative to a free root."""
    import mujoco

    model = load_model(folder / file)
    movable = [i for i in range(model.njnt) if model.jnt_type[i] in (_SLIDE, _HINGE)]
    # A joint without a name is called after its body, as morphgen's reader does.
    names = [
        model.joint(i).name or f"{model.body(model.jnt_bodyid[i]).name}_joint" for i in movable
    ]
    joints = {name: _mujoco_joint(model, i) for i, name in zip(movable, names, strict=True)}
    # Forces and inertia are those of the bodies, without contacts and equalities.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.gravity[:] = 0.0, 0.0, -GRAVITY
    data = mujoco.MjData(model)
    sites = {model.site(i).name: i for i in range(model.nsite)}
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    if frame and frame not in sites and frame not in bodies:
        raise FormatError(f"no site or body {frame!r}")
    columns = model.jnt_dofadr[movable]
    forces, inertia = _no_dynamics(names, n)
    M = np.zeros((model.nv, model.nv))
    for free in np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE):
        data.qpos[model.jnt_qposadr[free] :][:7] = 0, 0, 0, 1, 0, 0, 0
    poses = np.tile(np.eye(4), (n, 1, 1))
    for i in range(n):
        for joint, name in zip(movable, names, strict=True):
            if name in q:
                data.qpos[model.jnt_qposadr[joint]] = q[name][i]
        mujoco.mj_kinematics(model, data)
        if frame in sites:
            poses[i, :3, 3] = data.site(sites[frame]).xpos
            poses[i, :3, :3] = data.site(sites[frame]).xmat.reshape(3, 3)
        elif frame:
            R = data.body(bodies[frame]).xmat.reshape(3, 3)
            poses[i, :3, 3] = data.body(bodies[frame]).xpos + R @ _anchor(model, bodies[frame])
            poses[i, :3, :3] = R
        if i < len(forces):
            mujoco.mj_forward(model, data)
            mujoco.mj_fullM(model, data, M)
            forces[i] = data.qfrc_bias[columns]
            # Setting the armature to zero is not enough: MuJoCo keeps the inertia of simple bodies.
            inertia[i] = (M - np.diag(model.dof_armature))[np.ix_(columns, columns)]
    return Reading(
        joints,
        float(model.body_mass.sum()),
        poses,
        dict(_mujoco_mimics(model)),
        has_actuators=file == MJCF,
        forces=forces,
        inertia=inertia,
    )


def _anchor(model: mujoco.MjModel, body: int) -> Array:
    """Return where a body has its last hinge, the origin of the link that morphgen makes of it."""
    last = int(model.body_jntadr[body] + model.body_jntnum[body]) - 1
    is_hinge = model.body_jntnum[body] > 0 and model.jnt_type[last] == _HINGE
    return np.asarray(model.jnt_pos[last]) if is_hinge else np.zeros(3)


def _mujoco_joint(model: mujoco.MjModel, i: int) -> JointReading:
    """Return a joint of MuJoCo; one with an actuator has the actuator's effort and gains."""
    import mujoco

    dof = model.jnt_dofadr[i]
    limited = bool(model.jnt_limited[i])
    reading = JointReading(
        limits=tuple(model.jnt_range[i].tolist()) if limited else NO_LIMITS,
        effort=float(model.jnt_actfrcrange[i, 1]) if model.jnt_actfrclimited[i] else None,
        damping=float(model.dof_damping[dof]),
        friction=float(model.dof_frictionloss[dof]),
        armature=float(model.dof_armature[dof]),
    )
    actuators = np.flatnonzero(
        (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == i)
    )
    if len(actuators) != 1:
        return reading
    (k,) = actuators.tolist()
    limited = bool(model.actuator_forcelimited[k])
    return replace(
        reading,
        effort=float(model.actuator_forcerange[k, 1]) if limited else math.inf,
        stiffness=float(model.actuator_gainprm[k, 0]),
        derivative_gain=-float(model.actuator_biasprm[k, 2]),
    )


def _mujoco_mimics(model: mujoco.MjModel) -> Iterator[tuple[str, Mimic]]:
    """Yield the joints that an equality couples to another one, or to a constant."""
    import mujoco

    for k in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist():
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        offset, multiplier = model.eq_data[k, :2].tolist()
        name = model.joint(leader).name if leader >= 0 else ""
        yield model.joint(follower).name, Mimic(name, multiplier, offset)


LOADERS = (
    Loader("yourdfpy", "yourdfpy", read_yourdfpy, URDF),
    Loader("pybullet", "pybullet", read_pybullet, URDF),
    Loader("mujoco (urdf)", "mujoco", partial(read_mujoco, URDF), URDF),
    Loader("mujoco (mjcf)", "mujoco", partial(read_mujoco, MJCF), MJCF),
    Loader("pinocchio", "pinocchio", read_pinocchio, URDF),
)
"""Loaders of a bundle. Those of the URDF also read a URDF of others, that of the MJCF an MJCF."""


_CHILDREN: Mapping[str, Collection[str]] = {
    **CHILDREN,
    "robot": ("link", "joint", "material", "mujoco"),
    "mujoco": ("compiler", "option"),
    "option": ("flag",),
}
"""Child elements of a URDF that loaders get, by parent element."""
_FILE_ATTRIBUTES = ("assetdir", "meshdir", "strippath", "texturedir")
"""Attributes of ``<compiler>`` that say where files lie; in the copy they lie beside it."""


@contextmanager
def loader_copy(path: Path, finder: PackageFinder | None = None) -> Iterator[Path]:
    """Yield a temporary folder with a copy of a robot that other libraries may open.

    It has ``robot.urdf`` and ``robot.xml`` of a bundle, or what was read, with meshes as STL or OBJ
    beside them, without elements that a robot does not need.
    """
    finder = finder or default_finder()
    with TemporaryDirectory(prefix="morphgen-") as name:
        folder = Path(name)
        if not path.is_dir():
            read.require_description_file(path)
            if is_mjcf(path):
                _copy_mjcf(path, folder, finder)
            else:
                _copy_urdf(path, folder, finder)
        for file, copy in ((URDF, _copy_urdf), (MJCF, _copy_mjcf)):
            # Each loader says itself that its file is missing.
            if path.is_dir() and (path / file).exists():
                copy(resolve_uri(file, path / URDF, finder), folder, finder)
        yield folder


def _copy_mjcf(path: Path, folder: Path, finder: PackageFinder) -> None:
    from morphgen.formats.mjcf.read import compile_document  # loads trimesh

    document = read_document(path, finder, with_options=True)
    compile_document(document)
    root = etree.fromstring(document.text)
    copied = _mesh_copies(folder)
    for element in root.iterfind("asset/mesh[@name]"):
        if element.get("name", "") in document.meshes:
            element.set("file", copied(document.meshes[element.get("name", "")]))
    (folder / MJCF).write_bytes(etree.tostring(root, encoding="utf-8"))


def _copy_urdf(path: Path, folder: Path, finder: PackageFinder) -> None:
    data = read.urdf_bytes(path, {}, finder)
    require_bounded_meshes(read.robot_from_xml(data, path, finder))
    root, _ = parse_description(data, str(path))
    meshes, _, _ = read.resolved_meshes(root, path, finder)
    _keep_known(root)
    copied = _mesh_copies(folder)
    for shape in root.iterfind("link/*"):
        # Of several geometries, loaders get the one that morphgen reads.
        for surplus in (*shape.findall("geometry")[1:], *shape.findall("geometry/*")[1:]):
            remove_element(surplus)
        for element in shape.iterfind("geometry/mesh"):
            element.set("filename", copied(meshes[element.get("filename", "")]))
    (folder / URDF).write_bytes(etree.tostring(root, encoding="utf-8"))


def _keep_known(element: etree._Element) -> None:
    """Remove elements that loaders do not get, names with a namespace, and empty shapes."""
    for key in [*element.attrib]:
        if key.startswith("{") or (element.tag == "compiler" and key in _FILE_ATTRIBUTES):
            del element.attrib[key]
    for child in [*element]:
        if child.tag not in _CHILDREN.get(str(element.tag), ()):
            element.remove(child)
            continue
        _keep_known(child)
        if child.tag in ("visual", "collision") and not len(child.findall("geometry/*")):
            element.remove(child)


def _mesh_copies(folder: Path) -> Callable[[Path], str]:
    names: dict[Path, str] = {}

    def copied(path: Path) -> str:
        if path not in names:
            names[path], data = mesh_file(Mesh(path))
            (folder / names[path]).write_bytes(data)
        return names[path]

    return copied
