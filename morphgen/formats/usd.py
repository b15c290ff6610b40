"""Convert a URDF to OpenUSD by urdf-usd-converter."""

from __future__ import annotations

from pathlib import Path

from morphgen.errors import FormatError
from morphgen.formats.quiet import quiet
from morphgen.formats.urdf.write import BOUND_INERTIA, BOUND_MASS


def convert_urdf(urdf: Path, folder: Path) -> Path:
    """Write a robot as USD: an asset whose layers and mesh library lie in ``folder/Payload``.

    Simulators compute what is missing from the collision shapes. Therefore a centre of mass at the
    origin of its link, which the converter leaves out, is added, and massless bodies get the bounds
    of the MJCF (1e-12 kg, 1e-14 kg m^2), because USD takes a mass of zero for a missing one.

    Returns:
        The file to open, named after the robot.
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
            stage.Save()
    except (Tf.ErrorException, RuntimeError, ValueError) as error:
        raise FormatError("urdf-usd-converter: " + " ".join(str(error).split())) from error
    return Path(asset.path)
