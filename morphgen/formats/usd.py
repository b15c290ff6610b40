"""Convert a URDF to OpenUSD by urdf-usd-converter."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.errors import FormatError
from morphgen.formats.quiet import quiet
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS
from morphgen.formats.xml import parse_xml
from morphgen.model.geometry import Pose

if TYPE_CHECKING:
    from pxr import Usd


def convert_urdf(urdf: Path, folder: Path) -> Path:
    """Write a robot as USD, with layers in ``folder/Payload``; return the file to open.

    Simulators compute what is missing from the collision shapes. So a centre of mass at the origin
    of its link, which the converter leaves out, is added, and massless bodies get the bounds of the
    MJCF, because USD takes a mass of zero for a missing one.
    """
    import urdf_usd_converter
    from pxr import Gf, Tf, Usd, UsdPhysics

    try:
        with quiet():
            asset = urdf_usd_converter.Converter().convert(str(urdf), str(folder))
            stage = Usd.Stage.Open(asset.path)
            for prim in stage.Traverse():
                if not prim.HasAPI(UsdPhysics.RigidBodyAPI):
                    continue
                body = UsdPhysics.MassAPI.Apply(prim)
                if not body.GetCenterOfMassAttr().HasAuthoredValue():
                    body.GetCenterOfMassAttr().Set(Gf.Vec3f(0))
                if not body.GetMassAttr().Get():
                    body.GetMassAttr().Set(BOUND_MASS)
                    body.GetDiagonalInertiaAttr().Set(Gf.Vec3f(BOUND_INERTIA))
            _write_poses(stage, urdf)
            stage.Save()
    except (Tf.ErrorException, RuntimeError, ValueError) as error:
        raise FormatError("urdf-usd-converter: " + " ".join(str(error).split())) from error
    return Path(asset.path)


def _prim_name(prim: Usd.Prim) -> str:
    """Return the URDF's name of a prim: USD allows fewer characters, so it may be a label."""
    return str(prim.GetMetadata("displayName") or prim.GetName())


def _write_poses(stage: Usd.Stage, urdf: Path) -> None:
    """Write the poses of all links and joints from the origins of the URDF's joints.

    urdf-usd-converter 0.3.4 makes quaternions of matrices in single precision: a turn of less than
    0.34 mrad becomes none, and one of 0.5 mrad 0.7.
    """
    from pxr import Gf, UsdPhysics

    origins: dict[tuple[str, str], Pose] = {}
    for joint in parse_xml(urdf.read_bytes(), str(urdf)).iterfind("joint"):
        origin = joint.find("origin")
        texts = ("", "") if origin is None else (origin.get("xyz", ""), origin.get("rpy", ""))
        (x, y, z), (roll, pitch, yaw) = (map(float, (text or "0 0 0").split()) for text in texts)
        ends = (joint.find(end) for end in ("parent", "child"))
        parent, child = ("" if end is None else str(end.get("link")) for end in ends)
        origins[parent, child] = Pose.from_xyz_rpy((x, y, z), (roll, pitch, yaw))

    def origin_of(prim: Usd.Prim) -> Pose | None:
        parent = prim.GetParent()
        is_link = parent and prim.GetTypeName() == "Xform"
        return origins.get((_prim_name(parent), _prim_name(prim))) if is_link else None

    for prim in stage.Traverse():
        orient, T_parent_link = prim.GetAttribute("xformOp:orient"), origin_of(prim)
        if orient and T_parent_link is not None:
            orient.Set(Gf.Quatf(*T_parent_link.quaternion))
    for joint in filter(None, map(UsdPhysics.Joint, stage.Traverse())):
        ends = joint.GetBody0Rel().GetTargets()
        link, T_end_link = stage.GetPrimAtPath(joint.GetBody1Rel().GetTargets()[0]), Pose()
        # Links without a rigid body of their own may lie between the two ends.
        while link.GetPath() not in ends and (T_parent_link := origin_of(link)) is not None:
            link, T_end_link = link.GetParent(), T_parent_link @ T_end_link
        turn = joint.GetLocalRot1Attr().Get()
        T_end_joint = T_end_link @ Pose(quaternion=(turn.GetReal(), *turn.GetImaginary()))
        joint.GetLocalPos0Attr().Set(Gf.Vec3f(*T_end_joint.position))
        joint.GetLocalRot0Attr().Set(Gf.Quatf(*T_end_joint.quaternion))
