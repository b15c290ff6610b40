"""Robot descriptions are read by their root element, wherever a robot can be named."""

import pytest

import morphgen
from helpers.mjcf import TWO_JOINTS, write
from helpers.parts import write_part
from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.bundle import read_bundle, read_robot, write_bundle
from morphgen.formats.description import is_mjcf, read_description
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.robot_source import import_robot

SITE = TWO_JOINTS.replace(
    '<joint name="b"', '<site name="attachment_site" pos="0 0 1"/><joint name="b"'
)


def test_root_element_decides_between_urdf_and_mjcf(tmp_path):
    urdf = tmp_path / "arm.xml"
    urdf.write_text("<!-- an arm -->" + urdf_text(arm(), str), encoding="utf-8")
    assert not is_mjcf(urdf)
    assert read_description(urdf).name == "arm"
    mjcf = write(tmp_path, TWO_JOINTS, "two.urdf")
    assert is_mjcf(mjcf)
    assert read_description(mjcf).dof == 2


@pytest.mark.parametrize("text", ["", "<", "no XML", "<sdf/>", "<!-- only a comment -->"])
def test_other_files_are_refused_by_the_urdf_reader(text, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(text, encoding="utf-8")
    assert not is_mjcf(path)
    with pytest.raises(FormatError, match=r"robot\.xml"):
        read_robot(path)


def test_xacro_arguments_of_other_files_are_refused(tmp_path):
    with pytest.raises(FormatError, match="xacro arguments size for a file that is not a xacro"):
        read_description(write(tmp_path, TWO_JOINTS), {"size": "1"})


def test_imports_accept_mjcf(tmp_path):
    path = write(tmp_path, SITE)
    assert import_robot(path).frame("tool").link == "right"
    right = import_robot(path, root_link="right", tool="right", name="half")
    assert (right.name, right.dof, right.frame("tool").link) == ("half", 0, "right")
    assert right.provenance["source"] == "robot.xml"


def test_mjcf_of_a_bundle_stands_for_the_bundle(tmp_path):
    folder = write_bundle(arm(), tmp_path / "arm", picture=False)
    robot, bundle = read_robot(folder / "robot.xml"), read_bundle(folder)
    assert (robot.name, robot.home, robot.links) == (bundle.name, bundle.home, bundle.links)


def test_part_from_an_mjcf(tmp_path):
    write(tmp_path / "library", SITE)
    write_part(
        tmp_path / "library",
        file="robot.xml",
        root="base",
        tool={"link": "right"},
        **dict.fromkeys(("parameters", "mount", "home", "accepted")),
    )
    robot = morphgen.compose("arm=ur5 ee=pincer", library=[tmp_path / "library"])
    assert {"ee_left", "ee_right"} <= set(robot.link_index)
