"""Read a bundle with other libraries: joints, total mass and poses of a frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from morphgen.checks.joint_readings import JointReading, Reading
from morphgen.errors import FormatError
from morphgen.formats.bundle import MJCF, URDF
from morphgen.formats.quiet import quiet
from morphgen.model.geometry import Pose
from morphgen.model.robot import Mimic
from morphgen.typing import Array

if TYPE_CHECKING:
    import mujoco
    import pinocchio
    import yourdfpy

Read = Callable[[Path, str, Mapping[str, Array], int], Reading]
"""Function of the bundle's folder, a frame's name, the positions of every movable joint, shape (n,)
[rad or m], and the number n of configurations."""


@dataclass(frozen=True)
class Loader:
    """A library that reads one file of a bundle."""

    name: str
    """Name of the loader and its file."""
    module: str
    """Import name of the library."""
    read: Read
    """Reads the file; raises ``FormatError`` if the library rejects it or lacks the frame."""


def read_yourdfpy(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with yourdfpy, which moves mimic joints itself."""
    import yourdfpy

    urdf = yourdfpy.URDF.load(str(folder / URDF), load_meshes=False)
    if frame not in urdf.link_map:
        raise FormatError(f"no link {frame!r}")
    poses = np.empty((n, 4, 4))
    driven = [name for name in urdf.actuated_joint_names if name in q]
    for i in range(n):
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
        limits=(limit.lower, limit.upper) if limited else (-math.inf, math.inf),
        effort=limit.effort if limit is not None else None,
        velocity=limit.velocity if limit is not None else None,
        # yourdfpy leaves these two as text.
        damping=float(dynamics.damping or 0.0) if dynamics is not None else 0.0,
        friction=float(dynamics.friction or 0.0) if dynamics is not None else 0.0,
    )


def read_pybullet(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with PyBullet, with a floating base, because a fixed one reports no mass."""
    with quiet():
        import pybullet

        client = pybullet.connect(pybullet.DIRECT)
        try:
            body = pybullet.loadURDF(str(folder / URDF), physicsClientId=client)
            indices = range(pybullet.getNumJoints(body, physicsClientId=client))
            infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in indices]
            # In PyBullet's joint infos, 1 is the name, 2 the type and 12 the child link's name.
            movable = {
                info[1].decode(): i
                for i, info in zip(indices, infos, strict=True)
                if info[2] != pybullet.JOINT_FIXED
            }
            joints = {name: _pybullet_joint(infos[i]) for name, i in movable.items()}
            links = {info[12].decode(): i for i, info in zip(indices, infos, strict=True)}
            base = pybullet.getBodyInfo(body, physicsClientId=client)[0].decode()
            mass = sum(
                pybullet.getDynamicsInfo(body, i, physicsClientId=client)[0] for i in (-1, *indices)
            )
            if frame == base:
                return Reading(joints, float(mass), np.tile(np.eye(4), (n, 1, 1)), mimics=None)
            if frame not in links:
                raise FormatError(f"no link {frame!r}")
            poses = np.tile(np.eye(4), (n, 1, 1))
            for i in range(n):
                for name, index in movable.items():
                    if name in q:
                        pybullet.resetJointState(
                            body, index, float(q[name][i]), physicsClientId=client
                        )
                # Items 4 and 5 of a link state are the pose of the link's URDF frame.
                position, (x, y, z, w) = pybullet.getLinkState(
                    body, links[frame], computeForwardKinematics=1, physicsClientId=client
                )[4:6]
                poses[i, :3, 3] = position
                poses[i, :3, :3] = Pose(quaternion=(w, x, y, z)).matrix[:3, :3]
        except pybullet.error as error:
            raise FormatError(f"PyBullet: {error}") from error
        finally:
            pybullet.disconnect(client)
    return Reading(joints, float(mass), poses, mimics=None)


def _pybullet_joint(info: Sequence[float]) -> JointReading:
    """Return a joint from PyBullet's joint info, whose numbers are items 6 to 11."""
    damping, friction, lower, upper, effort, velocity = info[6:12]
    return JointReading(
        limits=(lower, upper) if lower <= upper else (-math.inf, math.inf),
        effort=effort,
        velocity=velocity,
        damping=damping,
        friction=friction,
    )


def read_pinocchio(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with Pinocchio, mimic joints uncoupled; a second model has the couplings."""
    import pinocchio

    with quiet():
        try:
            model = pinocchio.buildModelFromUrdf(str(folder / URDF))
        except (ValueError, RuntimeError) as error:
            raise FormatError("Pinocchio: " + " ".join(str(error).split())) from error
    kind = pinocchio.FrameType.BODY
    if not model.existFrame(frame, kind):
        raise FormatError(f"no link {frame!r}")
    index, data = model.getFrameId(frame, kind), model.createData()
    names = tuple(model.names)[1:]
    column = {name: model.idx_vs[k + 1] for k, name in enumerate(names)}
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
    joints = {name: _pinocchio_joint(model, model.getJointId(name)) for name in names}
    mass = float(sum(body.mass for body in model.inertias))
    return Reading(joints, mass, poses, _pinocchio_mimics(folder / URDF))


def _pinocchio_mimics(urdf: Path) -> dict[str, Mimic] | None:
    """Return the mimic joints; None if Pinocchio has no model of them.

    It refuses those that follow another mimic joint or a continuous one.
    """
    import pinocchio

    with quiet():
        try:
            model = pinocchio.buildModelFromUrdf(str(urdf), mimic=True)
        except (ValueError, RuntimeError):
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
    return JointReading(
        limits=(
            (-math.inf, math.inf)
            if unlimited
            else (float(model.lowerPositionLimit[q]), float(model.upperPositionLimit[q]))
        ),
        effort=float(model.effortLimit[v]),
        velocity=float(model.velocityLimit[v]),
        damping=float(model.damping[v]),
        friction=float(model.friction[v]),
    )


def read_mujoco(file: str, folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read ``robot.urdf`` or ``robot.xml`` with MuJoCo."""
    import mujoco

    try:
        model = mujoco.MjModel.from_xml_path(str(folder / file))
    except ValueError as error:
        raise FormatError("MuJoCo: " + " ".join(str(error).split())) from error
    data = mujoco.MjData(model)
    sites = {model.site(i).name: i for i in range(model.nsite)}
    bodies = {model.body(i).name: i for i in range(model.nbody)}
    if frame not in sites and frame not in bodies:
        raise FormatError(f"no site or body {frame!r}")
    address = {model.joint(i).name: model.jnt_qposadr[i] for i in range(model.njnt)}
    poses = np.tile(np.eye(4), (n, 1, 1))
    for i in range(n):
        for name in address.keys() & q.keys():
            data.qpos[address[name]] = q[name][i]
        mujoco.mj_kinematics(model, data)
        frame_view = data.site(sites[frame]) if frame in sites else data.body(bodies[frame])
        poses[i, :3, 3] = frame_view.xpos
        poses[i, :3, :3] = frame_view.xmat.reshape(3, 3)
    names = [model.joint(i).name for i in range(model.njnt)]
    joints = {name: _mujoco_joint(model, i) for i, name in enumerate(names)}
    return Reading(
        joints,
        float(model.body_mass.sum()),
        poses,
        dict(_mujoco_mimics(model, names)),
        has_actuators=file == MJCF,
    )


def _mujoco_joint(model: mujoco.MjModel, i: int) -> JointReading:
    """Return a joint of MuJoCo; one with an actuator has the actuator's effort and gains."""
    import mujoco

    dof = model.jnt_dofadr[i]
    limited = bool(model.jnt_limited[i])
    reading = JointReading(
        limits=tuple(model.jnt_range[i].tolist()) if limited else (-math.inf, math.inf),
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


def _mujoco_mimics(model: mujoco.MjModel, names: Sequence[str]) -> Iterator[tuple[str, Mimic]]:
    """Yield the joints that an equality couples to another one, or to a constant."""
    import mujoco

    for k in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist():
        follower, leader = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        offset, multiplier = model.eq_data[k, :2].tolist()
        yield names[follower], Mimic(names[leader] if leader >= 0 else "", multiplier, offset)


def read_usd(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the USD that urdf-usd-converter makes of the URDF with OpenUSD."""
    from morphgen.checks.usd_reader import read_stage

    return read_stage(folder / URDF, frame, q, n)


LOADERS = (
    Loader("yourdfpy", "yourdfpy", read_yourdfpy),
    Loader("pybullet", "pybullet", read_pybullet),
    Loader("mujoco (urdf)", "mujoco", partial(read_mujoco, URDF)),
    Loader("mujoco (mjcf)", "mujoco", partial(read_mujoco, MJCF)),
    Loader("pinocchio", "pinocchio", read_pinocchio),
    Loader("usd", "urdf_usd_converter", read_usd),
)
