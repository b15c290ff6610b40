"""Importing a URDF or xacro as a robot: tool, home, repairs and ignored pairs."""

import numpy as np
import pytest

from helpers.faulty_robots import with_joint
from helpers.parts import PINCER
from helpers.robots import arm
from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import FormatError
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import import_robot, resolve_robot
from morphgen.model.geometry import IDENTITY, Box
from morphgen.model.kinematics import frame_pose
from morphgen.model.tree import rename


def test_the_tool_frame_is_at_the_given_link_if_there_is_one(robot_urdf):
    robot = import_robot(robot_urdf(arm()), tool="left")
    frame = robot.frame("tool")
    assert (frame.link, frame.T_link_frame) == ("left", IDENTITY)
    assert robot.provenance["source"] == "some_robot.urdf"
    robot = import_robot(robot_urdf(arm()))
    assert robot.frames == ()
    assert "tool-missing" in {finding.code for finding in check(robot)}


def test_the_given_root_link_becomes_the_root(robot_urdf):
    robot = import_robot(robot_urdf(arm()), root_link="lower", tool="slider")
    assert [link.name for link in robot.links] == ["lower", "slider", "left", "right"]
    assert frame_pose(robot, (0.02, 0.0))[:3, 3] == pytest.approx([0, 0, 0.32])


def test_the_robot_has_the_name_of_the_file_unless_a_name_is_given(robot_urdf):
    assert import_robot(robot_urdf(arm())).name == "arm"
    assert import_robot(robot_urdf(arm()), name="limb").name == "limb"


def test_home_has_no_self_collision(robot_urdf):
    robot = import_robot(robot_urdf(arm()))
    assert list(SelfCollisionChecker(robot).penetrations([robot.home])) == [{}]
    assert ("left", "slider") in robot.ignore_pairs


def test_home_is_zero_or_the_middle_of_a_range_without_zero(robot_urdf):
    path = robot_urdf(with_joint(arm(), "elbow", limits=(0.5, 1.5)))
    assert import_robot(path).home == pytest.approx(arm().home)  # morphgen's own, which says it
    path.write_text(path.read_text().replace("morphgen>", "others>"))
    assert import_robot(path).home == pytest.approx((0.0, 1.0, 0.0, 0.0))


def test_safe_repairs_are_applied_and_reported(robot_urdf):
    path = robot_urdf(arm())
    path.write_text(path.read_text().replace('<axis xyz="1 0 0"', '<axis xyz="2 0 0"'))
    robot = import_robot(path)
    assert robot.joints[1].axis == pytest.approx((1, 0, 0))
    assert any("joint elbow" in repair for repair in robot.provenance["repairs"])
    as_is = import_robot(path, repair=False)
    assert as_is.joints[1].axis == (2.0, 0.0, 0.0)
    assert as_is.provenance["repairs"] == []
    valid = with_joint(arm(), "right", mimic=None)
    assert import_robot(robot_urdf(valid)).provenance["repairs"] == []


def test_a_link_named_tool_is_renamed_in_favour_of_the_frame(robot_urdf):
    path = robot_urdf(rename(arm(), {"slider": "tool"}, {"extend": "tool_joint"}))
    robot = import_robot(path, tool="tool")
    assert robot.frame("tool").link == "tool_link"
    assert import_robot(path).frames == robot.frames
    assert resolve_robot(path, default_library()).frame("tool").link == "tool_link"
    assert {"tool", "tool_joint"}.isdisjoint({*robot.link_index, *robot.joint_index})
    assert "frame-name-taken" not in {finding.code for finding in check(robot)}
    np.testing.assert_allclose(
        frame_pose(robot, robot.home),
        frame_pose(import_robot(robot_urdf(arm()), tool="slider"), robot.home),
        atol=1e-12,
    )


def test_xacro_arguments_are_passed(tmp_path):
    path = tmp_path / "pincer.urdf.xacro"
    path.write_text(PINCER)
    robot = import_robot(path, {"length": "0.3"}, root_link="palm")
    assert robot.root.collisions[0].geometry == Box((0.02, 0.02, 0.3))
    assert robot.joints[1].mimic.joint == "left_slide"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"root_link": "bass"}, "no link 'bass' for root link; did you mean 'base'? valid: base,"),
        ({"tool": "slidr"}, "no link 'slidr' for tool; did you mean 'slider'?"),
        ({"root_link": "slider", "tool": "base"}, "tool 'base' is not below the root link"),
        ({"args": {"length": "1"}}, "xacro arguments length for a file that is not a xacro"),
    ],
)
def test_unknown_links_are_errors(robot_urdf, options, message):
    path = robot_urdf(arm())
    with pytest.raises(FormatError) as caught:
        import_robot(path, **options)
    assert str(caught.value).startswith(f"{path}: {message}")
