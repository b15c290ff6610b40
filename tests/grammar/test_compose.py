"""Composition joins parts at exact poses, keeps their properties and says where they are from."""

import json
import math
from dataclasses import replace
from importlib.util import find_spec
from operator import attrgetter

import numpy as np
import pytest

from helpers.parts import write_part
from helpers.robots import LIBRARY, composed, derive, joined
from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.checks.readers import LOADERS
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import CompositionError, PartError
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.compose import compose, join, load_parts
from morphgen.grammar.library import default_library
from morphgen.grammar.request import default_name
from morphgen.grammar.syntax import Derivation
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import forward_kinematics, frame_pose, random_configurations
from morphgen.model.robot import Inertial

PAPER_ARMS = ("ur5", "panda", "kinova_gen3", "jaco2", "xarm7", "lwr", "yumi_right", "widowx")
EES = LIBRARY.names("ee")
SAMPLE = [("panda", "robotiq_2f85"), ("widowx", "sake_ez")]


class PosedRobot:
    """A robot in one configuration, and the poses of its parts."""

    def __init__(self, text, seed=0):
        self.placed = load_parts(derive(text), LIBRARY)
        self.robot = joined(text)
        (self.q,) = random_configurations(self.robot, 1, np.random.default_rng(seed))
        self.T_world_link = forward_kinematics(self.robot, self.q)
        names = [self.robot.joints[k].name for k in self.robot.independent_joints]
        self.positions = dict(zip(names, self.q, strict=True))

    def alone(self, label):
        """Return link poses of the part alone, in its root frame, at the same configuration."""
        body = self.placed[label].part.fragment
        joints = [body.joints[k].name for k in body.independent_joints]
        return forward_kinematics(body, [self.positions[f"{label}_{name}"] for name in joints])

    def links(self, label):
        """(pose in the robot, pose in the part alone) of every link of a part."""
        body = self.placed[label].part.fragment
        pairs = zip(body.links, self.alone(label), strict=True)
        index = self.robot.link_index
        there = [(f"{label}_{link.name}", T_part_link) for link, T_part_link in pairs]
        return [(self.T_world_link[index[n]], T) for n, T in there if n in index]

    def root(self, label):
        """Return the pose of the root of a part in the robot."""
        T_world_link, T_part_link = self.links(label)[-1]
        return T_world_link @ np.linalg.inv(T_part_link)

    def placement(self, label, placement):
        """Return the pose of a frame of a part manifest in the robot."""
        part = self.placed[label].part
        link = placement.link.replace("/", "_")
        T_part_link = self.alone(label)[part.fragment.link_index[link]]
        offset = Pose.from_xyz_rpy(placement.xyz, placement.rpy).matrix
        return self.root(label) @ T_part_link @ offset

    def flange(self):
        return self.placement("arm", self.placed["arm"].part.manifest.ports["flange"])

    def mount(self):
        return self.placement("ee", self.placed["ee"].part.manifest.mount)


def turn(yaw):
    return Pose.from_xyz_rpy((0, 0, 0), (0, 0, yaw)).matrix


@pytest.mark.parametrize(
    ("arm", "ee"),
    [
        *(("ur5", name) for name in EES if name != "none"),
        *((arm, "panda_hand") for arm in PAPER_ARMS[1:]),
    ],
)
def test_the_end_effector_mount_equals_the_flange_up_to_mount_yaw(arm, ee):
    there = PosedRobot(f"arm={arm} ee={ee} ee.mount_yaw=33deg")
    expected = there.flange() @ turn(math.radians(33))
    np.testing.assert_allclose(there.mount(), expected, atol=1e-12)
    if (arm, ee) == ("panda", "panda_hand"):  # rotated by 45 degrees, as Franka Emika delivers it
        hand = there.T_world_link[there.robot.link_index["ee_panda_hand"]]
        np.testing.assert_allclose(hand, there.flange() @ turn(math.radians(33 - 45)), atol=1e-9)


def test_without_an_end_effector_the_tool_is_the_flange():
    there = PosedRobot("arm=ur5 ee.mount_yaw=90deg ee=none")
    tool = frame_pose(there.robot, there.q)
    np.testing.assert_allclose(tool, there.flange() @ turn(math.pi / 2), atol=1e-12)


@pytest.mark.parametrize(
    "text", ["base=planar arm=panda ee=robotiq_2f85", "arm=lwr ee=jaco_fingers"]
)
def test_parts_have_the_same_kinematics_in_the_robot_as_alone(text):
    there = PosedRobot(text, seed=2)
    for label in there.placed:
        for T_world_link, T_part_link in there.links(label):
            np.testing.assert_allclose(T_world_link, there.root(label) @ T_part_link, atol=1e-12)


def test_joints_keep_axis_limits_effort_velocity_damping_and_mimic():
    text = "arm=panda ee=robotiq_2f85"
    robot = joined(text)
    kept = attrgetter("kind", "axis", "limits", "effort", "velocity", "damping", "friction")
    for label, here in load_parts(derive(text), LIBRARY).items():
        for joint in here.part.fragment.joints:
            robot_joint = robot.joints[robot.joint_index[f"{label}_{joint.name}"]]
            assert kept(robot_joint) == kept(joint)
            mimic = joint.mimic and replace(joint.mimic, joint=f"{label}_{joint.mimic.joint}")
            assert robot_joint.mimic == mimic


def test_names_are_unique_and_prefixed_with_the_label_of_their_part():
    robot = composed("base=pedestal left.arm=ur5 left.ee=plane right.arm=ur5 right.ee=plane")
    scopes = ("base_", "left_arm_", "left_ee_", "right_arm_", "right_ee_")
    for names in ([j.name for j in robot.joints], [link.name for link in robot.links]):
        assert len(set(names)) == len(names)
        assert all(name.startswith(scopes) for name in names)
    assert "left_arm_wrist_3_joint" in robot.joint_index
    assert "right_arm_wrist_3_joint" in robot.joint_index


def test_mass_is_the_sum_over_the_parts():
    text = "base=pedestal left.arm=ur5 left.ee=stick right.arm=panda right.ee=panda_hand"
    parts = load_parts(derive(text), LIBRARY).values()
    assert joined(text).mass == pytest.approx(math.fsum(here.part.fragment.mass for here in parts))


def test_home_concatenates_the_homes_of_the_parts():
    robot = composed("base=gantry ee=robotiq_2f140")
    names = [robot.joints[k].name for k in robot.independent_joints]
    home = dict(zip(names, robot.home, strict=True))
    assert home["base_z"] == pytest.approx(0.8)
    assert robot.home[:5] == pytest.approx((0, 0, 0.8, 0, 0))
    assert list(home)[5:] == ["ee_finger_joint"]
    ur5 = composed("arm=ur5 ee=yumi_gripper")
    assert ur5.home == pytest.approx((0, -1.57, 1.57, -1.57, -1.57, 0, 0.025))


def test_the_tool_frame_is_at_the_working_point_of_the_end_effector():
    """The far edge of the plate, the centre of the ball of the stick, or between the fingers."""
    for ee, ahead in (
        ("plane ee.size=80mm", 0.08),
        ("stick ee.length=0.25", 0.25),
        ("sphere", 0.1),
        ("panda_hand", 0.1034),
        ("robotiq_2f85", 0.144),
    ):
        there = PosedRobot(f"arm=ur5 ee={ee}")
        T_flange_tool = np.linalg.inv(there.flange()) @ frame_pose(there.robot, there.q)
        assert T_flange_tool[:3, 3] == pytest.approx([0, 0, ahead], abs=1e-9)
        assert T_flange_tool[:3, 2] == pytest.approx([0, 0, 1], abs=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        "arm=panda ee=robotiq_2f85",
        "arm=yumi left.ee=yumi_gripper right.ee=yumi_gripper",
        "base=pedestal left.arm=ur5 left.ee=stick right.arm=xarm7 right.ee=panda_hand",
        "base=planar arm=lwr ee=stick",
    ],
)
def test_no_robot_collides_with_itself_at_home(text):
    robot = composed(text)
    assert list(SelfCollisionChecker(robot).penetrations([robot.home])) == [{}]
    assert robot.ignore_pairs == tuple(sorted({tuple(sorted(pair)) for pair in robot.ignore_pairs}))
    assert {name for pair in robot.ignore_pairs for name in pair} <= set(robot.link_index)


def test_link_pairs_that_can_collide_are_not_ignored():
    """Arms side by side can collide with each other, and an arm with its own base."""
    robot = composed("left.arm=ur5 right.arm=ur5 base=fixed base.spread=0.5")
    assert ("left_arm_forearm_link", "right_arm_forearm_link") not in robot.ignore_pairs
    assert ("left_arm_base_link", "left_arm_forearm_link") not in robot.ignore_pairs
    home = list(robot.home[6:])
    stretched = [[pan, 0, 0, 0, 0, 0, *home] for pan in (math.pi / 2, -math.pi / 2)]
    outwards, inwards = SelfCollisionChecker(robot).penetrations(stretched)
    assert outwards == {}
    assert ("left_arm_forearm_link", "right_arm_upper_arm_link") in inwards


def test_two_arms_are_mounted_at_their_ports():
    robot = composed("base=pedestal left.arm=ur5 left.ee=stick right.arm=xarm7 right.ee=panda_hand")
    T_root_link = forward_kinematics(robot, robot.home)
    left = T_root_link[robot.link_index["left_arm_base_link"]]
    right = T_root_link[robot.link_index["right_arm_link_base"]]
    np.testing.assert_allclose(left[:3, 3], [0, 0.3, 0.5], atol=1e-12)
    np.testing.assert_allclose(right[:3, 3], [0, -0.3, 0.5], atol=1e-12)
    assert robot.dof == 6 + 7 + 1


def test_each_limb_has_one_tool_frame():
    assert [frame.name for frame in joined("arm=ur5 ee=plane").frames] == ["tool"]
    robot = joined("base=pedestal left.arm=ur5 left.ee=stick right.arm=ur5 right.ee=plane")
    assert {frame.name for frame in robot.frames} == {"tool", "left_tool", "right_tool"}
    assert robot.frame("left_tool").link == "left_ee_stick"
    assert robot.frame("tool").link == robot.frame("right_tool").link == "right_ee_plate"


def test_an_empty_root_link_of_a_part_adds_no_link():
    robot = joined("arm=ur5 ee=none")
    assert [link.name for link in robot.links if link.name.startswith("ee")] in ([], ["ee_link"])
    assert robot.mass == pytest.approx(joined("arm=ur5 ee=plane").mass - 0.01 * 0.1 * 0.1 * 1000)


def fixed(*children):
    return Derivation("base", "fixed", (), children)


@pytest.mark.parametrize(
    ("node", "message"),
    [
        (
            fixed(("topp", Derivation("arm", "ur5"))),
            "'fixed' has no port 'topp'; did you mean 'top'? valid: left, right, top",
        ),
        (fixed(("top", Derivation("base", "ur5"))), "two parts are labelled 'base'"),
        (Derivation("arm", "yumi"), "'yumi' needs a base: its mount is not its root"),
        (
            Derivation("arm", "ur5", (("mount_yaw", 1.0),)),
            "'arm' is not attached to a port: it has no mount_yaw",
        ),
        (
            fixed(("top", Derivation("arm", "ur5")), ("top", Derivation("arm2", "ur5"))),
            "port 'top' of 'fixed' is already taken: it cannot hold 'arm2', too",
        ),
    ],
)
def test_incompatible_parts_are_an_error(node, message):
    with pytest.raises(CompositionError) as caught:
        compose(node, LIBRARY, "robot")
    assert str(caught.value) == message


@pytest.mark.parametrize("yaw", [100.0, float("inf"), float("nan")])
def test_a_derivation_with_a_mount_yaw_out_of_range_is_an_error(yaw):
    arm = Derivation("arm", "ur5", (("mount_yaw", yaw),))
    with pytest.raises(PartError, match=r"arm\.mount_yaw=\w+: out of range"):
        compose(fixed(("top", arm)), LIBRARY, "robot")


OVERLAPPING = {(arm, "so101_jaw") for arm in ("jaco2", "lwr", "yumi_right")}
OVERLAPPING |= {("yumi_right", "panda_hand")}
"""Hands whose shapes reach behind the flange, into the arm: the card says so."""


def test_overlapping_parts_are_reported_and_not_ignored():
    words = "base=pedestal base.spread=0 left.arm=lwr right.arm=lwr"
    robot = compose(derive(words), LIBRARY, "robot")
    findings = [finding for finding in check(robot) if finding.severity != "info"]
    assert {finding.code for finding in findings} == {"self-collision"}
    assert any("left_arm" in f.where and "right_arm" in f.where for f in findings)


def conforms(arm, ee, tmp_path, samples):
    derivation = derive(f"arm={arm} ee={ee}")
    robot = compose(derivation, LIBRARY, default_name(derivation, LIBRARY))
    findings = check(robot)
    codes = {finding.code for finding in findings if finding.severity != "info"}
    assert codes == ({"self-collision"} if (arm, ee) in OVERLAPPING else set())
    folder = write_bundle(robot, tmp_path / robot.name, findings, picture=False)
    report = conformance(folder, samples)
    assert report.passed
    assert len(report.rows) == len(LOADERS) == 5
    missing = {loader.name for loader in LOADERS if find_spec(loader.module) is None}
    assert {row.loader for row in report.rows if row.message} == missing <= {"pybullet", "usd"}


@pytest.mark.parametrize(("arm", "ee"), SAMPLE)
def test_all_loaders_agree_on_a_sample_of_robots(arm, ee, tmp_path):
    conforms(arm, ee, tmp_path, 20)


@pytest.mark.slow
@pytest.mark.parametrize("ee", EES)
@pytest.mark.parametrize("arm", PAPER_ARMS)
def test_all_loaders_agree_on_every_arm_of_the_paper_with_every_end_effector(arm, ee, tmp_path):
    conforms(arm, ee, tmp_path, 100)


def test_provenance_names_licence_and_citation_of_every_part():
    parts = joined("arm=ur5 ee=robotiq_2f85").provenance["parts"]
    labels = [(part["label"], part["part"]) for part in parts]
    assert labels == [("base", "fixed"), ("arm", "ur5"), ("ee", "robotiq_2f85")]
    assert parts[1]["licence"] == "BSD-3-Clause"
    assert "universal_robot" in parts[1]["citation"]
    assert "linkage is open" in parts[2]["notes"]
    assert "notes" not in parts[0]


def test_a_finding_accepted_by_a_part_has_severity_info_and_a_reason_in_the_bundle_too(tmp_path):
    robot = joined("arm=panda")
    by_itself = [f for f in check(replace(robot, provenance={})) if f.severity == "warning"]
    assert ("inertia-implausible", "link arm_panda_link1") in {(f.code, f.where) for f in by_itself}
    (finding,) = [f for f in check(robot) if f.where == "link arm_panda_link1"]
    assert finding.severity == "info"
    assert "; accepted: identified on the real arm" in finding.why
    folder = write_bundle(robot, tmp_path / "panda", check(robot), picture=False)
    card = json.loads((folder / "card.json").read_text())
    accepted = [f["severity"] for f in card["findings"] if f["code"] == "inertia-implausible"]
    assert accepted == ["info"]
    assert {f.severity for f in check(read_bundle(folder))} <= {"info"}


def test_accepting_one_finding_accepts_no_other(tmp_path):
    """Neither the same fault of another link, nor another fault of the same link."""
    write_part(tmp_path, accepted={"disc": {"inertia-implausible": "it is a flywheel"}})
    library = default_library([tmp_path])
    robot = join(derive("arm=lwr ee=pincer", library), library, "robot")
    light, odd = robot.link("ee_disc").inertial.mass, (1.0, 0.0, 0.0, 1.0, 0.0, 1.0)
    disc = replace(robot.link("ee_disc"), inertial=Inertial(100 * light, inertia=odd))
    palm = replace(robot.link("ee_palm"), inertial=Inertial(0.08, (0, 0, 0.1), odd))
    severity = {(f.where, f.code): f.severity for f in check(robot.with_links([disc, palm]))}
    assert severity["link ee_disc", "inertia-implausible"] == "info"
    assert severity["link ee_disc", "density-implausible"] == "warning"
    assert severity["link ee_palm", "inertia-implausible"] == "warning"
