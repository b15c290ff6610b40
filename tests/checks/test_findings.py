"""Findings, repairs, and home poses."""

import math
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
import yaml

from helpers.faulty_robots import (
    FLAT_INERTIA,
    MESHES,
    ROBOTS,
    hinge,
    valid_robot,
    valid_robot_with_mesh,
    with_body,
    with_end,
    with_joint,
    with_link,
)
from helpers.robots import arm
from morphgen.checks import check, fix, rules
from morphgen.checks.rules import DEFAULT_DENSITY, MAX_GAP, check_links_apart
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import inertial_from_density
from morphgen.model.robot import (
    DEFAULT_EFFORT,
    DEFAULT_VELOCITY,
    Inertial,
    Joint,
    Link,
    Mimic,
    Robot,
)
from morphgen.model.tree import rename, scale_links


@pytest.fixture(autouse=True)
def _few_faces(monkeypatch):
    monkeypatch.setattr(rules, "MAX_STL_FACES", 1000)


def found(robot, code):
    """Return the first finding with a code."""
    return next(finding for finding in check(robot) if finding.code == code)


def codes(robot):
    return {finding.code for finding in check(robot)}


def faulty(code, folder):
    return ROBOTS[code]() if code in ROBOTS else MESHES[code](folder)


def test_a_valid_robot_has_no_findings_and_no_repairs(tmp_path):
    for robot in (valid_robot(), valid_robot_with_mesh(tmp_path)):
        assert check(robot) == ()
        assert fix(robot) == (robot, ())


def test_a_mimic_gripper_has_only_the_finding_about_loaders():
    assert [finding.severity for finding in check(arm())] == ["info"]


@pytest.mark.parametrize("code", [*ROBOTS, *MESHES])
def test_each_fault_has_its_finding_and_all_are_sorted(code, tmp_path):
    findings = check(faulty(code, tmp_path))
    assert code in {finding.code for finding in findings}
    rank = {"error": 0, "warning": 1, "info": 2}
    assert list(findings) == sorted(findings, key=lambda f: (rank[f.severity], f.code, f.where))
    assert findings == check(faulty(code, tmp_path))
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
    pad = Link("pad", collisions=valid_robot().link("right").collisions)
    fixed = replace(hinge("pad"), kind="fixed", limits=None)
    assert found(with_end(pad, hinge("pad")), "inertia-missing").severity == "error"
    assert found(with_end(pad, fixed), "inertia-missing").severity == "info"


@pytest.mark.parametrize(("low", "is_physical"), [(1.0001e-3, True), (0.9999e-3, False)])
def test_the_triangle_inequality_agrees_with_mujoco(low, is_physical):
    robot = with_body("lower", inertia=(low, 0.0, 0.0, low, 0.0, 2e-3))
    assert ("inertia-not-physical" not in codes(robot)) is is_physical
    inertial = f'<inertial pos="0 0 0" mass="1" diaginertia="{low} {low} 2e-3"/>'
    xml = f"<mujoco><worldbody><body><joint/>{inertial}</body></worldbody></mujoco>"
    with nullcontext() if is_physical else pytest.raises(ValueError, match=r"A \+ B >= C"):
        mujoco.MjModel.from_xml_string(xml)


def test_a_long_axis_is_an_error_only_for_prismatic_joints():
    for joint, severity in (("extend", "error"), ("elbow", "warning")):
        robot = with_joint(valid_robot(), joint, axis=(0.0, 0.0, 1.5))
        assert found(robot, "axis-not-unit").severity == severity


def test_an_axis_rounded_in_a_file_is_a_unit_axis():
    robot = with_joint(valid_robot(), "elbow", axis=(0.7071, 0.7071, 0.0))
    assert "axis-not-unit" not in codes(robot)


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
    assert "self-collision" not in codes(replace(robot, ignore_pairs=ignored))


def keys(robot):
    """Return code and location of every finding."""
    return {(finding.code, finding.where) for finding in check(robot)}


@pytest.mark.parametrize("code", [code for code in (*ROBOTS, *MESHES) if "name-" not in code])
def test_exactly_the_fixable_findings_are_fixed(code, tmp_path):
    robot = faulty(code, tmp_path)
    repaired, gone = fix(robot)
    fixable = {finding for finding in check(robot) if finding.fixable}
    assert set(gone) == fixable
    assert keys(repaired) == keys(robot) - {(finding.code, finding.where) for finding in fixable}
    assert fix(repaired)[1] == ()


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
    faults = "axis-not-unit effort-missing home-outside-limits limits-inverted velocity-missing"
    assert {finding.code for finding in gone} == set(faults.split())


def test_a_nan_home_becomes_the_position_within_limits_nearest_to_zero():
    shifted = with_joint(valid_robot(), "shoulder", limits=(0.3, 1.0))
    broken = replace(shifted, home=(math.nan, 0, 0, 0, 0))
    assert fix(broken)[0].home[0] == 0.3


def test_names_are_changed_everywhere():
    broken = rename(arm(), {"left": "left pad", "right": "left_pad"}, {"left": "left/1"})
    robot, gone = fix(replace(broken, ignore_pairs=(("left pad", "left_pad"),)))
    assert "name-characters" not in codes(robot)
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
    bad = replace(valid_robot().link("lower").inertial, mass=-1.0)
    broken = with_link(valid_robot(), "lower", inertial=bad, collisions=(), visuals=())
    finding = next(finding for finding in check(broken) if finding.code == "mass-invalid")
    assert not finding.fixable
    assert fix(broken)[1] == ()


def test_a_joint_that_is_locked_at_zero_is_made_fixed():
    robot, gone = fix(with_joint(valid_robot(), "elbow", limits=(0.0, 0.0), effort=None))
    assert {finding.code for finding in gone} == {"home-outside-limits", "limits-empty"}
    assert robot.joints[robot.joint_index["elbow"]].kind == "fixed"
    assert "joint elbow: it was made fixed: both limits are 0" in robot.provenance["repairs"]
    assert fix(robot)[1] == ()


def pair(parent, child, T_parent_child=Pose(), between=()):  # noqa: B008
    """A robot of two links with one shape each and bare links between them."""
    names = ["parent", *between, "child"]
    links = (
        Link("parent", visuals=(Shape(parent),)),
        *(Link(name) for name in between),
        Link("child", visuals=(Shape(child),)),
    )
    joints = tuple(
        Joint(name, "fixed", above, name, T_parent_child if name == "child" else Pose())
        for above, name in pairwise(names)
    )
    return Robot("pair", links, joints)


def gap_findings(robot):
    return [(finding.where, finding.why) for finding in check_links_apart(robot)]


def mesh(folder, name, made):
    made.export(folder / name)
    return Mesh(folder / name)


@pytest.mark.parametrize("offset", [0.0, 0.05, 0.1, 0.1 + 0.9 * MAX_GAP, 0.1 + MAX_GAP])
@pytest.mark.parametrize("height", [0.0, 1 / 3, 1e3])
def test_links_that_touch_or_nearly_do_are_not_apart(offset, height):
    """Also where they are 5 mm apart but for rounding."""
    box = (Shape(Box((0.1, 0.1, 0.1))),)
    links = (Link("root"), Link("parent", visuals=box), Link("child", visuals=box))
    joints = (
        Joint("mount", "fixed", "root", "parent", Pose((0, 0, height))),
        Joint("gap", "fixed", "parent", "child", Pose((0, 0, offset))),
    )
    assert gap_findings(Robot("boxes", links, joints)) == []


def test_a_gap_is_reported_with_both_links_and_its_width():
    box = Box((0.1, 0.1, 0.1))
    assert gap_findings(pair(box, box, Pose((0.0, 0.0, 0.1 + 1.2 * MAX_GAP)))) == [
        ("links parent, child", "at home their visual shapes are 6 mm apart")
    ]


def test_links_without_shapes_are_skipped():
    ball = Sphere(0.05)
    near, far = (Pose((z, 0.0, 0.0)) for z in (0.1, 0.2))
    assert gap_findings(pair(ball, ball, near, between=("a", "b"))) == []
    assert gap_findings(pair(ball, ball, far, between=("a", "b"))) == [
        ("links parent, child", "at home their visual shapes are 100 mm apart")
    ]
    robot = pair(ball, ball, far)
    bare = replace(robot.links[0], visuals=(), collisions=robot.links[0].visuals)
    assert gap_findings(replace(robot, links=(bare, robot.links[1]))) == []


def test_gaps_are_measured_at_home():
    reach = hinge("tip", axis=(0.0, 0.0, 1.0), kind="prismatic", limits=(0.0, 1.0))
    robot = with_end(Link("tip", visuals=(Shape(Box((0.1, 0.1, 0.1))),)), reach)
    assert gap_findings(robot) == []
    assert gap_findings(replace(robot, home=(*robot.home[:-1], 1.0))) != []


def test_an_enclosed_solid_is_not_apart(tmp_path):
    shell = mesh(tmp_path, "shell.stl", trimesh.creation.box((0.4, 0.4, 0.4)))
    core = mesh(tmp_path, "core.stl", trimesh.creation.icosphere(radius=0.05))
    for small in (core, Sphere(0.05), Box((0.05, 0.05, 0.05))):
        assert gap_findings(pair(shell, small)) == []
        assert gap_findings(pair(small, shell)) == []
    assert gap_findings(pair(shell, core, Pose((0.3, 0.0, 0.0)))) != []


def test_a_rod_in_the_opening_of_a_ring_is_apart_from_it(tmp_path):
    ring = mesh(tmp_path, "ring.stl", trimesh.creation.annulus(0.05, 0.06, 0.02))
    within = 1000 * (0.05 * np.cos(np.pi / 32) - 0.01)  # to the faces of the ring's 32 sides
    assert gap_findings(pair(ring, Cylinder(0.01, 0.5))) == [
        ("links parent, child", f"at home their visual shapes are {within:.3g} mm apart")
    ]


def test_unreadable_shapes_and_invalid_joints_are_left_to_other_checks(tmp_path):
    gone, bad = tmp_path / "gone.stl", tmp_path / "bad.stl"
    bad.write_text("no mesh")
    for shape in (Mesh(gone), Mesh(bad), Mesh(bad, (0.0, 1.0, 1.0)), Box((0.0, 0.1, 0.1))):
        assert gap_findings(pair(shape, Sphere(0.1), Pose((1.0, 0.0, 0.0)))) == []
    assert gap_findings(replace(valid_robot(), home=(math.nan, *valid_robot().home[1:]))) == []


@pytest.mark.parametrize("name", ["base", "upper"])
def test_either_link_can_accept_a_gap(name):
    ball = Shape(Sphere(0.02), Pose((0.0, 0.0, 0.18)))
    torn = with_link(valid_robot(), "upper", visuals=(ball, Shape(Sphere(0.02), Pose((0, 0, 0.3)))))
    (finding,) = check(torn)
    assert (finding.code, finding.severity) == ("links-apart", "warning")
    told = replace(torn, provenance={"accepted": {name: {"links-apart": "a magnet"}}})
    (finding,) = check(told)
    assert finding.severity == "info"
    assert finding.why.endswith("; accepted: a magnet")


def test_a_panda_scaled_about_its_link_frames_has_gaps():
    panda = load_part(default_library().manifest("panda")).fragment
    factors = {"panda_link0": 1.5, "panda_link1": 0.5, "panda_link4": 1.4}
    torn = {finding.where for finding in check_links_apart(scale_links(panda, factors))}
    assert torn == {"links panda_link0, panda_link1", "links panda_link4, panda_link5"}
