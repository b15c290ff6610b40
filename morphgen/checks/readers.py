"""Read a bundle with other libraries: joints, total mass and poses of a frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from morphgen.errors import FormatError
from morphgen.formats.quiet import quiet
from morphgen.model.geometry import Pose
from morphgen.typing import Array


@dataclass(frozen=True)
class Reading:
    """Robot as a loader reads it."""

    joints: tuple[str, ...]
    """Names of the movable joints."""
    mass: float
    """Total mass [kg]."""
    T_root_frame: Array
    """Pose of the frame in each configuration, shape (n, 4, 4)."""


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

    urdf = yourdfpy.URDF.load(str(folder / "robot.urdf"), load_meshes=False)
    if frame not in urdf.link_map:
        raise FormatError(f"no link {frame!r}")
    poses = np.empty((n, 4, 4))
    driven = [name for name in urdf.actuated_joint_names if name in q]
    for i in range(n):
        urdf.update_cfg({name: float(q[name][i]) for name in driven})
        poses[i] = urdf.get_transform(frame)
    links, joints = urdf.robot.links, urdf.robot.joints
    mass = sum(link.inertial.mass for link in links if link.inertial is not None)
    return Reading(tuple(j.name for j in joints if j.type != "fixed"), float(mass), poses)


def read_pybullet(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with PyBullet, with a floating base, because a fixed one reports no mass."""
    with quiet():
        import pybullet

        client = pybullet.connect(pybullet.DIRECT)
        try:
            body = pybullet.loadURDF(str(folder / "robot.urdf"), physicsClientId=client)
            indices = range(pybullet.getNumJoints(body, physicsClientId=client))
            infos = [pybullet.getJointInfo(body, i, physicsClientId=client) for i in indices]
            # In PyBullet's joint infos, 1 is the name, 2 the type and 12 the child link's name.
            movable = {
                info[1].decode(): i
                for i, info in zip(indices, infos, strict=True)
                if info[2] != pybullet.JOINT_FIXED
            }
            links = {info[12].decode(): i for i, info in zip(indices, infos, strict=True)}
            base = pybullet.getBodyInfo(body, physicsClientId=client)[0].decode()
            mass = sum(
                pybullet.getDynamicsInfo(body, i, physicsClientId=client)[0] for i in (-1, *indices)
            )
            if frame == base:
                return Reading(tuple(movable), float(mass), np.tile(np.eye(4), (n, 1, 1)))
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
    return Reading(tuple(movable), float(mass), poses)


def read_pinocchio(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the URDF with Pinocchio, without coupling mimic joints."""
    import pinocchio

    with quiet():
        try:
            model = pinocchio.buildModelFromUrdf(str(folder / "robot.urdf"))
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
    return Reading(names, float(sum(body.mass for body in model.inertias)), poses)


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
    return Reading(tuple(address), float(model.body_mass.sum()), poses)


def read_usd(folder: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Read the USD that urdf-usd-converter makes of the URDF with OpenUSD."""
    from morphgen.checks.usd_reader import read_stage

    return Reading(*read_stage(folder / "robot.urdf", frame, q, n))


LOADERS = (
    Loader("yourdfpy", "yourdfpy", read_yourdfpy),
    Loader("pybullet", "pybullet", read_pybullet),
    Loader("mujoco (urdf)", "mujoco", partial(read_mujoco, "robot.urdf")),
    Loader("mujoco (mjcf)", "mujoco", partial(read_mujoco, "robot.xml")),
    Loader("pinocchio", "pinocchio", read_pinocchio),
    Loader("usd", "urdf_usd_converter", read_usd),
)
