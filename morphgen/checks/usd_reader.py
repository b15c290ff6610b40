"""Read a robot from USD with OpenUSD's Python library, for the comparison of loaders."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from morphgen.checks.joint_readings import JointReading, Reading
from morphgen.errors import FormatError
from morphgen.formats.usd import convert_urdf
from morphgen.model.geometry import Pose
from morphgen.typing import Array


def read_stage(urdf: Path, frame: str, q: Mapping[str, Array], n: int) -> Reading:
    """Convert a URDF to USD, open the stage and move its physics joints.

    The joints of ``UsdPhysics`` are followed from the root link to the frame, with the local poses
    that they have on their two bodies: the nested transforms of the prims are only the pose in
    which all joints are at zero.

    Args:
        urdf: The robot's URDF.
        frame: Name of the frame's link in the URDF; empty for the root.
        q: Positions of every movable joint, shape (n,) [rad or m].
        n: Number of configurations.

    Returns:
        The robot. Of its joints only the position limits are read: ``UsdPhysics`` has no others.

    Raises:
        FormatError: If the converter refuses the URDF, or the stage has no prim for the frame.
        ModuleNotFoundError: If urdf-usd-converter is not installed.
    """
    from pxr import Usd, UsdPhysics

    with TemporaryDirectory() as scratch:
        stage = Usd.Stage.Open(str(convert_urdf(urdf, Path(scratch))))
        prims = list(stage.Traverse())
        joints = {
            str(body): joint
            for joint in map(UsdPhysics.Joint, prims)
            if joint
            for body in joint.GetBody1Rel().GetTargets()
        }
        links = stage.GetDefaultPrim().GetChild("Geometry")
        of_frame = [prim for prim in Usd.PrimRange(links) if _name(prim) == frame or not frame]
        if not of_frame:
            raise FormatError(f"no prim {frame!r}")
        T_world_root, T_world_frame = (
            _poses(prim, joints, q, n) for prim in (links.GetChildren()[0], of_frame[0])
        )
        masses = [UsdPhysics.MassAPI(prim).GetMassAttr().Get() for prim in prims]
        movable = {
            _name(joint.GetPrim()): JointReading(limits=_limits(joint.GetPrim()))
            for joint in joints.values()
            if not joint.GetPrim().IsA(UsdPhysics.FixedJoint)
        }
    mass = float(sum(value for value in masses if value is not None))
    return Reading(movable, mass, np.linalg.inv(T_world_root) @ T_world_frame, mimics=None)


def _limits(prim: Any) -> tuple[float, float]:  # noqa: ANN401
    """Return the position limits of a joint [rad or m]."""
    scale = 1.0 if prim.GetTypeName() == "PhysicsPrismaticJoint" else math.pi / 180
    lower, upper = (prim.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper"))
    return (
        -math.inf if lower is None else scale * lower,
        math.inf if upper is None else scale * upper,
    )


def _poses(prim: Any, joints: Mapping[str, Any], q: Mapping[str, Array], n: int) -> Array:  # noqa: ANN401
    """Return the poses of a prim in the world, shape (n, 4, 4)."""
    if not prim or prim.IsPseudoRoot():
        return np.tile(np.eye(4), (n, 1, 1))
    joint = joints.get(str(prim.GetPath()))
    if joint is None:
        from pxr import UsdGeom

        local = UsdGeom.Xformable(prim).GetLocalTransformation() if prim else None
        T_parent_prim = np.eye(4) if local is None else np.array(local).T
        return _poses(prim.GetParent(), joints, q, n) @ T_parent_prim
    parents = joint.GetBody0Rel().GetTargets()
    parent = prim.GetStage().GetPrimAtPath(parents[0]) if parents else None
    return (
        _poses(parent, joints, q, n)
        @ _local(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get())
        @ _motion(joint.GetPrim(), q, n)
        @ np.linalg.inv(_local(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get()))
    )


def _motion(prim: Any, q: Mapping[str, Array], n: int) -> Array:  # noqa: ANN401
    """Return the motion of a joint in its frame, shape (n, 4, 4)."""
    motion = np.tile(np.eye(4), (n, 1, 1))
    token, positions = prim.GetAttribute("physics:axis").Get(), q.get(_name(prim))
    if token is None or positions is None:  # a fixed joint has no axis
        return motion
    axis = "XYZ".index(token)
    if prim.GetTypeName() == "PhysicsPrismaticJoint":
        motion[:, axis, 3] = positions
        return motion
    a, b = (axis + 1) % 3, (axis + 2) % 3
    motion[:, a, a] = motion[:, b, b] = np.cos(positions)
    motion[:, b, a] = np.sin(positions)
    motion[:, a, b] = -motion[:, b, a]
    return motion


def _local(position: Any, rotation: Any) -> Array:  # noqa: ANN401
    """Return the matrix of a joint's local pose on a body."""
    quaternion = np.array([rotation.GetReal(), *rotation.GetImaginary()], np.float64)
    w, x, y, z = (quaternion / np.linalg.norm(quaternion)).tolist()
    px, py, pz = map(float, position)
    return Pose((px, py, pz), (w, x, y, z)).matrix


def _name(prim: Any) -> str:  # noqa: ANN401
    """Return the URDF's name of a prim: USD allows fewer characters, so it may be a label."""
    label = prim.GetMetadata("displayName")
    return str(label or prim.GetName())
