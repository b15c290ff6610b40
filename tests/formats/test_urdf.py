"""Reading and writing URDF: round trips, and errors with line numbers."""

import pickle

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.bundle import read_robot
from morphgen.formats.rounding import format_number
from morphgen.formats.urdf.read import UnsoundError, read_urdf
from morphgen.formats.urdf.write import urdf_text
from morphgen.model.geometry import Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.robot import Joint, Link, Robot


def no_mesh(mesh):
    raise AssertionError(f"no mesh expected: {mesh}")


def written(robot, folder):
    path = folder / "robot.urdf"
    path.write_text(urdf_text(robot, no_mesh))
    return path


def text_file(folder, text):
    path = folder / "robot.urdf"
    path.write_text(text)
    return path


def test_links_are_sorted_from_the_root_and_missing_limits_are_not_zero(tmp_path):
    path = text_file(
        tmp_path,
        '<robot name="r"><link name="c"/><link name="a"/><link name="b"/>'
        '<joint name="j2" type="fixed"><parent link="b"/><child link="c"/></joint>'
        '<joint name="j1" type="revolute"><parent link="a"/><child link="b"/></joint></robot>',
    )
    robot = read_urdf(path)
    assert [link.name for link in robot.links] == ["a", "b", "c"]
    assert (robot.joints[0].limits, robot.joints[0].effort) == (None, None)


def test_home_is_in_the_middle_of_a_range_without_zero(tmp_path):
    joint = Joint("j", "prismatic", "a", "b", limits=(0.2, 0.8), effort=1.0, velocity=1.0)
    robot = Robot("r", (Link("a"), Link("b")), (joint,), home=(0.3,))
    path = written(robot, tmp_path)
    assert read_urdf(path).home == (0.3,)
    path.write_text(path.read_text().replace("morphgen>", "others>"))
    assert read_urdf(path).home == (0.5,)


def test_a_urdf_without_its_bundle_keeps_tool_and_home(tmp_path):
    path = written(arm(), tmp_path)
    alone = read_robot(path)
    assert alone.home == arm().home
    (tool,), (expected,) = alone.frames, arm().frames
    assert (tool.name, tool.link) == (expected.name, expected.link)
    np.testing.assert_allclose(
        tool.T_link_frame.matrix, expected.T_link_frame.matrix, rtol=0, atol=1e-9
    )
    assert [link.name for link in alone.links] == [link.name for link in arm().links]


@pytest.mark.parametrize("position", ["nan", "inf", "1e999", "left", ""])
def test_a_home_that_is_not_a_number_is_an_error(tmp_path, position):
    path = written(arm(), tmp_path)
    path.write_text(path.read_text().replace('position="0.4"', f'position="{position}"'))
    with pytest.raises(FormatError, match=rf"robot.urdf:\d+: home position '{position}'"):
        read_robot(path)


def test_a_rotated_inertial_frame_is_expressed_in_link_axes(tmp_path):
    path = text_file(
        tmp_path,
        '<robot name="r"><link name="a"><inertial><origin rpy="0 0 1.5707963267948966"/>'
        '<mass value="1"/><inertia ixx="1" iyy="2" izz="3" ixy="0" ixz="0" iyz="0"/></inertial>'
        "</link></robot>",
    )
    inertial = read_urdf(path).root.inertial
    assert inertial is not None
    np.testing.assert_allclose(np.diag(inertial.matrix), [2, 1, 3], atol=1e-12)


def test_a_capsule_is_written_as_cylinder_and_spheres_and_read_back(tmp_path):
    T = Pose.from_xyz_rpy((0.1, 0, 0), (1.0, 0, 0))
    others = (Shape(Sphere(0.05)), Shape(Cylinder(0.05, 0.1)))
    link = Link("a", collisions=(*others, Shape(Capsule(0.05, 0.2), T), *others))
    path = written(Robot("r", (link,)), tmp_path)
    kinds = [Sphere, Cylinder, Capsule, Sphere, Cylinder]
    assert [type(shape.geometry) for shape in read_urdf(path).root.collisions] == kinds
    assert read_urdf(path).root.collisions[2].geometry == Capsule(0.05, 0.2)
    path.write_text(path.read_text().replace('length="0.2"', 'length="0.3"'))
    shapes = read_urdf(path).root.collisions[2:5]
    assert [type(shape.geometry) for shape in shapes] == [Cylinder, Sphere, Sphere]
    ends = [np.array(shape.T_link_shape.position) for shape in shapes[1:]]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(0.2)
    np.testing.assert_allclose((ends[0] + ends[1]) / 2, T.position, atol=1e-12)


def test_a_missing_mesh_is_an_error(tmp_path):
    path = text_file(
        tmp_path,
        '<robot name="r"><link name="a"><visual><geometry><mesh filename="gone.stl"/></geometry>'
        "</visual></link></robot>",
    )
    with pytest.raises(UnsoundError, match=r"gone\.stl") as caught:
        read_urdf(path)
    assert caught.value.findings[0].code == "mesh-unresolved"
    sent = pickle.loads(pickle.dumps(caught.value))  # as a worker process sends it
    assert (str(sent), sent.findings) == (str(caught.value), caught.value.findings)


def test_numbers_have_twelve_digits_and_no_negative_zero():
    values = (0.1 + 0.2, -0.0, 1e-13, 1.0, -1.5707963267948966)
    texts = ["0.3", "0", "0", "1", "-1.57079632679"]
    assert [format_number(value) for value in values] == texts
