"""MJCF export agrees with the robot in MuJoCo, including MuJoCo's special cases."""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from helpers.mjcf import inertia_in_mujoco
from helpers.robots import arm, rod
from morphgen.errors import FormatError
from morphgen.formats.mjcf.write import FLAT_THICKNESS, mjcf_text, to_spec
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Inertial, Joint, Link, Robot


def no_file(mesh):
    raise AssertionError(f"{mesh} was written")


def text(robot):
    return mjcf_text(robot, no_file)


def compiled(robot):
    return mujoco.MjModel.from_xml_string(text(robot))


def single(shape, **kwargs):
    return Robot("one", (Link("body", Inertial(1.0, inertia=(1, 0, 0, 1, 0, 1)), **kwargs),))


def hinged(link, joint=None):
    """Return a link with a revolute joint on a massless root."""
    joint = joint or Joint("hinge", "revolute", "root", link.name, limits=(-1.0, 1.0))
    return Robot("hinged", (Link("root"), link), (joint,), home=(0.0,))


def test_inertias_keep_their_digits():
    matrix = np.array([[3.123456789e-8, 4e-9, -5e-9], [4e-9, 2.9e-8, 6e-9], [-5e-9, 6e-9, 3e-8]])
    link = Link("bead", Inertial.from_matrix(0.0123456789, (0.1, 0.2, 1 / 3), matrix))
    model = compiled(hinged(link))
    body = model.body("bead")
    assert body.mass[0] == pytest.approx(0.0123456789, rel=1e-9)
    assert body.ipos == pytest.approx((0.1, 0.2, 1 / 3), abs=1e-9)
    assert inertia_in_mujoco(model, "bead") == pytest.approx(matrix, abs=1e-6 * 3e-8)


def test_the_spec_equals_the_text():
    robot = arm()
    assert to_spec(robot).to_xml() == mujoco.MjSpec.from_string(text(robot)).to_xml()


def test_primitives_have_their_sizes_and_groups():
    shapes = (
        Shape(Box((0.1, 0.2, 0.3)), Pose((1.0, 2.0, 3.0))),
        Shape(Sphere(0.1)),
        Shape(Cylinder(0.1, 0.4)),
        Shape(Capsule(0.1, 0.4), rgba=(0.1, 0.2, 0.3, 0.5)),
    )
    model = compiled(single("body", visuals=shapes, collisions=shapes))
    kinds = [mujoco.mjtGeom(kind).name[7:].lower() for kind in model.geom_type]
    assert kinds == ["box", "sphere", "cylinder", "capsule"] * 2
    assert model.geom_size[:4].tolist() == [
        [0.05, 0.1, 0.15],
        [0.1, 0, 0],
        [0.1, 0.2, 0],
        [0.1, 0.2, 0],
    ]
    assert model.geom_pos[0].tolist() == [1.0, 2.0, 3.0]
    assert model.geom_rgba[3] == pytest.approx((0.1, 0.2, 0.3, 0.5))
    assert model.geom_group.tolist() == [2] * 4 + [3] * 4
    assert model.geom_contype.tolist() == [0] * 4 + [1] * 4
    assert model.geom_conaffinity.tolist() == [0] * 4 + [1] * 4


def test_continuous_and_unlimited_joints_have_no_range():
    for kind, limits in (("continuous", (-1.0, 1.0)), ("revolute", None)):
        joint = Joint("free", kind, "root", "rod", limits=limits)
        model = compiled(hinged(rod("rod"), joint))
        assert model.jnt_limited.tolist() == [0]
        assert model.actuator_ctrllimited.tolist() == [0]
        assert model.actuator_forcelimited.tolist() == [0]


def test_a_root_named_world_is_the_world_body():
    robot = hinged(rod("rod"))
    joint = replace(robot.joints[0], parent="world")
    robot = replace(robot, links=(Link("world"), robot.links[1]), joints=(joint,))
    assert compiled(robot).nbody == 2
    heavy = Link("world", Inertial(1.0))
    with pytest.raises(FormatError, match="rename"):
        text(replace(robot, links=(heavy, robot.links[1])))


@pytest.mark.parametrize("limits", [(0.0, 0.0), (1.0, -1.0)])
def test_limits_without_a_range_are_errors(limits):
    with pytest.raises(FormatError, match=r"'hinge'.*fixed"):
        text(hinged(rod("rod"), Joint("hinge", "revolute", "root", "rod", limits=limits)))


def meshed(path, *, collision, scale=(1.0, 1.0, 1.0)):
    shape = (Shape(Mesh(path, scale)),)
    shapes = {"collisions": shape} if collision else {"visuals": shape}
    return single("body", **shapes)


def export(mesh, path):
    mesh.export(path)
    return path


@pytest.fixture
def flat(tmp_path):
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    return export(square, tmp_path / "flat.stl")


@pytest.mark.parametrize("collision", [True, False])
def test_meshes_without_files_are_in_the_model(tmp_path, collision):
    path = export(trimesh.creation.box((1, 2, 3)), tmp_path / "cube.stl")
    model = to_spec(meshed(path, collision=collision, scale=(0.1, 0.1, -0.1))).compile()
    extents = sorted(np.ptp(model.mesh_vert, axis=0))
    assert extents == pytest.approx([0.1, 0.2, 0.3], abs=1e-6)


def test_each_mesh_file_is_declared_once(tmp_path):
    path = export(trimesh.creation.box(), tmp_path / "cube.stl")
    shape = Shape(Mesh(path))
    robot = single("body", visuals=(shape, shape), collisions=(shape,))
    written = mjcf_text(robot, lambda mesh: f"meshes/{Path(mesh.path).name}")
    assert re.findall(r'<mesh [^>]*file="([^"]*)"', written) == ["meshes/cube.stl"]
    assert written.count('mesh="cube"') == 3


def test_meshes_with_the_same_file_stem_have_unique_names(tmp_path):
    shapes = []
    for k in (1, 2):
        (tmp_path / str(k)).mkdir()
        path = export(trimesh.creation.box((k, k, k)), tmp_path / str(k) / "cube.stl")
        shapes.append(Shape(Mesh(path)))
    assert to_spec(single("body", visuals=tuple(shapes))).compile().nmesh == 2


def test_flat_visual_meshes_compile(flat, tmp_path):
    assert to_spec(meshed(flat, collision=False)).compile().nmeshface == 2
    written = mjcf_text(meshed(flat, collision=False), lambda mesh: str(mesh.path))
    assert mujoco.MjModel.from_xml_string(written).nmeshface == 2
    triangle = export(trimesh.Trimesh(np.eye(3), [[0, 1, 2]]), tmp_path / "triangle.stl")
    assert to_spec(meshed(triangle, collision=False)).compile().nmesh == 1


def test_flat_collision_meshes_get_a_thickness(flat):
    robot = meshed(flat, collision=True)
    written = mujoco.MjModel.from_xml_string(mjcf_text(robot, no_file))
    for model in (written, to_spec(robot).compile()):
        assert min(np.ptp(model.mesh_vert, axis=0)) == pytest.approx(FLAT_THICKNESS, rel=1e-3)


@pytest.mark.slow
def test_a_mesh_with_more_faces_than_mujoco_reads_from_stl(tmp_path):
    sphere = trimesh.creation.icosphere(subdivisions=7)
    assert len(sphere.faces) > 200_000
    path = export(sphere, tmp_path / "sphere.stl")
    assert to_spec(meshed(path, collision=False)).compile().nmeshface == len(sphere.faces)
