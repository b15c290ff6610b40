"""Every fault has a finding; a valid robot has none."""

from dataclasses import replace
from pathlib import Path

import mujoco
import pytest
import yaml

from helpers.faulty_robots import (
    MESHES,
    ROBOTS,
    hinge,
    valid_robot,
    valid_robot_with_mesh,
    with_body,
    with_end,
    with_joint,
)
from helpers.robots import arm
from morphgen.checks import check, rules
from morphgen.model.robot import Inertial, Link, Mimic
from morphgen.model.tree import rename


def found(robot, code):
    """Return the first finding with a code."""
    return next(finding for finding in check(robot) if finding.code == code)


def test_a_valid_robot_has_no_findings(tmp_path):
    assert check(valid_robot()) == ()
    assert check(valid_robot_with_mesh(tmp_path)) == ()


def test_a_mimic_gripper_has_only_the_finding_about_loaders():
    assert [finding.severity for finding in check(arm())] == ["info"]


@pytest.mark.parametrize("code", MESHES)
def test_each_fault_of_a_mesh_has_its_finding(code, tmp_path, monkeypatch):
    monkeypatch.setattr(rules, "MAX_STL_FACES", 1000)
    assert code in {finding.code for finding in check(MESHES[code](tmp_path))}


@pytest.mark.parametrize("code", ROBOTS)
def test_each_fault_has_its_finding_and_all_are_sorted(code):
    findings = check(ROBOTS[code]())
    assert code in {finding.code for finding in findings}
    rank = ["error", "warning", "info"]
    assert list(findings) == sorted(
        findings, key=lambda f: (rank.index(f.severity), f.code, f.where)
    )
    assert findings == check(ROBOTS[code]())
    assert all(f.why and f.fix and "\n" not in f.why + f.fix for f in findings)


def test_every_row_of_the_table_has_a_robot_with_its_fault():
    rows = yaml.safe_load((Path(rules.__file__).parent / "findings.yaml").read_text())
    assert {row.split("/")[0] for row in rows} == {*ROBOTS, *MESHES}


def test_a_tool_is_required_only_on_request():
    assert check(replace(valid_robot(), frames=()), tool_required=False) == ()


def test_a_bare_frame_needs_no_mass():
    pad = replace(hinge("pad"), kind="fixed", limits=None)
    assert check(with_end(Link("pad"), pad)) == ()
    assert check(with_end(Link("pad", Inertial(0.0)), pad)) == ()


def test_a_massless_link_is_an_error_only_without_a_rigid_neighbour_with_mass():
    shape = valid_robot().link("right").collisions
    moving = with_end(Link("pad", collisions=shape), hinge("pad"))
    fixed = with_end(
        Link("pad", collisions=shape), replace(hinge("pad"), kind="fixed", limits=None)
    )
    assert found(moving, "inertia-missing").severity == "error"
    assert found(fixed, "inertia-missing").severity == "info"


def test_the_triangle_inequality_agrees_with_mujoco():
    for low, code in ((1.0001e-3, None), (0.9999e-3, "inertia-not-physical")):
        body = (low, 0.0, 0.0, low, 0.0, 2e-3)
        codes = {finding.code for finding in check(with_body("lower", inertia=body))}
        assert (code in codes) is (code is not None)
        moments = " ".join(str(body[i]) for i in (0, 3, 5))
        xml = (
            "<mujoco><worldbody><body><joint/>"
            f'<inertial pos="0 0 0" mass="1" diaginertia="{moments}"/>'
            "</body></worldbody></mujoco>"
        )
        if code is None:
            mujoco.MjModel.from_xml_string(xml)
        else:
            with pytest.raises(ValueError, match="A \\+ B >= C"):
                mujoco.MjModel.from_xml_string(xml)


def test_a_long_axis_is_an_error_only_for_prismatic_joints():
    for joint, severity in (("extend", "error"), ("elbow", "warning")):
        robot = with_joint(valid_robot(), joint, axis=(0.0, 0.0, 1.5))
        assert found(robot, "axis-not-unit").severity == severity


def test_an_axis_rounded_in_a_file_is_a_unit_axis():
    robot = with_joint(valid_robot(), "elbow", axis=(0.7071, 0.7071, 0.0))
    assert "axis-not-unit" not in {finding.code for finding in check(robot)}


def test_the_range_of_a_mimic_joint_includes_its_whole_chain():
    robot = with_joint(arm(), "right", mimic=Mimic("left", -0.5))
    assert {finding.severity for finding in check(robot)} == {"info"}
    free = with_joint(robot, "left", kind="continuous", limits=None)
    assert "from -inf to inf" in found(free, "mimic-range").why


def test_a_root_may_be_called_world():
    assert check(rename(valid_robot(), {"base": "world"})) == ()


def test_overlap_of_an_ignored_pair_is_not_a_finding():
    robot = ROBOTS["self-collision"]()
    pairs = [finding.where for finding in check(robot) if finding.code == "self-collision"]
    ignored = tuple(tuple(pair.removeprefix("links ").split(", ")) for pair in pairs)
    assert ignored
    assert "self-collision" not in {f.code for f in check(replace(robot, ignore_pairs=ignored))}
