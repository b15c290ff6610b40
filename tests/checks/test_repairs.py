"""``fix`` repairs the fixable findings and nothing else."""

import math
from dataclasses import replace

import pytest

from helpers.faulty_robots import (
    FLAT_INERTIA,
    MESHES,
    ROBOTS,
    valid_robot,
    with_body,
    with_joint,
    with_link,
)
from helpers.robots import arm
from morphgen.checks import check, fix, rules
from morphgen.checks.rules import DEFAULT_DENSITY
from morphgen.model.inertia import inertial_from_density
from morphgen.model.robot import DEFAULT_EFFORT, DEFAULT_VELOCITY
from morphgen.model.tree import rename


def keys(robot):
    """Return code and location of every finding."""
    return {(finding.code, finding.where) for finding in check(robot)}


@pytest.mark.parametrize("code", [code for code in (*ROBOTS, *MESHES) if "name-" not in code])
def test_exactly_the_fixable_findings_are_fixed(code, tmp_path, monkeypatch):
    monkeypatch.setattr(rules, "MAX_STL_FACES", 1000)
    robot = ROBOTS[code]() if code in ROBOTS else MESHES[code](tmp_path)
    findings = check(robot)
    repaired, gone = fix(robot)
    fixable = {finding for finding in findings if finding.fixable}
    assert set(gone) == fixable
    assert keys(repaired) == keys(robot) - {(finding.code, finding.where) for finding in fixable}
    assert fix(repaired)[1] == ()


def test_a_valid_robot_is_unchanged():
    robot = valid_robot()
    assert fix(robot) == (robot, ())


def test_missing_mass_is_that_of_the_solid_geometry():
    robot, _ = fix(with_link(valid_robot(), "lower", inertial=None))
    shapes = valid_robot().link("lower").collisions
    assert robot.link("lower").inertial == inertial_from_density(shapes, DEFAULT_DENSITY)


def test_the_repair_of_an_inertia_keeps_mass_and_centre():
    broken = with_body("lower", inertia=FLAT_INERTIA, com=(0.0, 0.0, 0.1))
    before, after = broken.link("lower").inertial, fix(broken)[0].link("lower").inertial
    assert (after.mass, after.com) == (before.mass, before.com)
    solid = inertial_from_density(broken.link("lower").collisions, 1.0)
    assert after.inertia == pytest.approx([before.mass / solid.mass * v for v in solid.inertia])


def test_joints_are_repaired_together_with_home():
    broken = with_joint(
        valid_robot(), "shoulder", axis=(0, 3, 4), limits=(0.2, -0.2), effort=None, velocity=-1.0
    )
    robot, gone = fix(broken)
    joint = robot.joints[0]
    assert joint.axis == pytest.approx((0.0, 0.6, 0.8))
    assert joint.limits == (-0.2, 0.2)
    assert (joint.effort, joint.velocity) == (DEFAULT_EFFORT, DEFAULT_VELOCITY)
    assert robot.home[0] == 0.2
    assert {finding.code for finding in gone} == {
        "axis-not-unit",
        "effort-missing",
        "home-outside-limits",
        "limits-inverted",
        "velocity-missing",
    }


def test_a_nan_home_becomes_the_position_within_limits_nearest_to_zero():
    broken = replace(
        with_joint(valid_robot(), "shoulder", limits=(0.3, 1.0)), home=(math.nan, 0, 0, 0, 0)
    )
    assert fix(broken)[0].home[0] == 0.3


def test_names_are_changed_everywhere():
    broken = rename(arm(), {"left": "left pad", "right": "left_pad"}, {"left": "left/1"})
    robot, gone = fix(replace(broken, ignore_pairs=(("left pad", "left_pad"),)))
    assert "name-characters" not in {finding.code for finding in check(robot)}
    assert {finding.code for finding in gone} == {"name-characters"}
    assert [link.name for link in robot.links[4:]] == ["left_pad_2", "left_pad"]
    assert robot.joints[3].child == "left_pad_2"
    assert robot.joints[4].mimic.joint == robot.joints[3].name == "left_1"
    assert robot.ignore_pairs == (("left_pad", "left_pad_2"),)


def test_several_faults_are_repaired_together():
    broken = with_joint(with_body("lower", mass=math.nan), "extend", axis=(0, 0, 9), effort=None)
    broken = with_link(broken, "upper", inertial=None)
    broken = rename(broken, {"right": "world", "left": "left pad"}, {"elbow": "an elbow"})
    repaired, gone = fix(broken)
    assert len(gone) == 7
    assert check(repaired) == ()


def test_a_link_without_solid_geometry_is_not_repaired():
    body = valid_robot().link("lower").inertial
    broken = with_link(
        valid_robot(), "lower", inertial=replace(body, mass=-1.0), collisions=(), visuals=()
    )
    finding = next(finding for finding in check(broken) if finding.code == "mass-invalid")
    assert not finding.fixable
    assert fix(broken)[1] == ()


def test_a_joint_that_is_locked_at_zero_is_made_fixed():
    robot, gone = fix(with_joint(valid_robot(), "elbow", limits=(0.0, 0.0), effort=None))
    assert {finding.code for finding in gone} == {"home-outside-limits", "limits-empty"}
    assert robot.joints[robot.joint_index["elbow"]].kind == "fixed"
    assert "joint elbow: it was made fixed: both limits are 0" in robot.provenance["repairs"]
    assert fix(robot)[1] == ()
