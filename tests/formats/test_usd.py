"""Export to USD: what a stage holds, read with OpenUSD itself."""

import math
import re
from pathlib import Path

import pytest

import morphgen
from helpers.faulty_robots import with_joint
from helpers.robots import arm
from morphgen.cli import main
from morphgen.errors import FormatError
from morphgen.formats.bundle import write_bundle
from morphgen.formats.exchange import convert_urdf
from morphgen.model.geometry import Mesh, Pose

pytest.importorskip("urdf_usd_converter")
from pxr import Usd, UsdGeom, UsdPhysics

WORDS = ("arm=ur5", "ee=robotiq_2f85")
ROBOT = morphgen.compose(" ".join(WORDS))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("out")
    assert main(["export", *WORDS, "--format", "usd", "--out", str(out)]) == 0
    return out / "ur5-robotiq_2f85-usd"


@pytest.fixture(scope="module")
def stage(folder):
    return Usd.Stage.Open(str(folder / "ur5-robotiq_2f85.usda"))


def test_links_have_their_masses_and_centres_of_mass(stage):
    prims = {prim.GetName(): prim for prim in stage.Traverse()}
    for link in ROBOT.links:
        if not prims[link.name].HasAPI(UsdPhysics.RigidBodyAPI):
            assert link.inertial is None
            continue
        mass = UsdPhysics.MassAPI(prims[link.name])
        if link.inertial is None:  # zero would mean that the mass follows from the shapes
            assert 0 < mass.GetMassAttr().Get() <= 1e-12
            continue
        assert mass.GetMassAttr().Get() == pytest.approx(link.inertial.mass, rel=1e-6)
        centre = link.inertial.com
        assert tuple(mass.GetCenterOfMassAttr().Get()) == pytest.approx(centre, abs=1e-6)


def test_joints_have_their_couplings(stage):
    prims = {prim.GetName(): prim for prim in stage.Traverse()}
    followers = [joint for joint in ROBOT.joints if joint.mimic]
    assert len(followers) == 5
    for joint in followers:
        (leader,) = prims[joint.name].GetRelationship("newton:mimicJoint").GetTargets()
        assert leader.name == joint.mimic.joint
        multiplier = prims[joint.name].GetAttribute("newton:mimicCoef1").Get()
        assert multiplier == joint.mimic.multiplier


@pytest.mark.parametrize("turn", [2.1e-5, 5e-4])
def test_small_turns_of_joints_are_exact(turn, tmp_path):
    """The converter alone takes angles from a cosine in single precision."""
    mounted = Pose.from_xyz_rpy((0.0, 0.0, 0.3), (turn, 0.0, 0.0))
    robot = with_joint(arm(), "elbow", T_parent_joint=mounted)
    bundle = write_bundle(robot, tmp_path / "bundle", picture=False)
    stage = Usd.Stage.Open(str(convert_urdf(bundle / "robot.urdf", tmp_path / "usd")))
    joint = UsdPhysics.Joint(next(p for p in stage.Traverse() if p.GetName() == "elbow"))
    R = joint.GetLocalRot0Attr().Get() * joint.GetLocalRot1Attr().Get().GetInverse()
    assert 2 * math.asin(R.GetImaginary().GetLength()) == pytest.approx(turn, abs=1e-7)


def test_the_folder_stands_alone(folder, stage):
    meshes = [prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    assert meshes
    assert all(UsdGeom.Mesh(prim).GetPointsAttr().Get() for prim in meshes)
    files = [Path(layer.realPath) for layer in stage.GetUsedLayers() if not layer.anonymous]
    assert all(file.is_relative_to(folder) for file in files)
    for path in folder.rglob("*.usda"):
        assert not re.search(r"(/tmp|robot\.urdf)", path.read_text("utf-8"))


def test_every_collision_mesh_is_a_hull(stage):
    shapes = [shape for link in ROBOT.links for shape in link.collisions]
    meshes = sum(isinstance(shape.geometry, Mesh) for shape in shapes)
    approximations = [
        prim.GetAttribute("physics:approximation").Get()
        for prim in stage.Traverse()
        if prim.HasAPI(UsdPhysics.MeshCollisionAPI)
    ]
    assert approximations == ["convexHull"] * meshes


def test_a_urdf_that_the_converter_refuses_is_one_error(tmp_path):
    broken = tmp_path / "robot.urdf"
    broken.write_text("<robot name='r'><link/></robot>")
    with pytest.raises(FormatError, match=r"urdf-usd-converter: .*name"):
        convert_urdf(broken, tmp_path / "out")
