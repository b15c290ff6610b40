"""Robots hold their home configuration with the files of their bundle, or it is said why not."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from helpers.robots import arm
from helpers.simulators import needs_pybullet
from morphgen.checks import hold as module
from morphgen.checks.hold import hold_files, overloads, step_targets
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.grammar.robot_source import import_robot
from morphgen.model.geometry import Pose
from morphgen.model.robot import Inertial, Joint, Link, Robot


def held(robot, tmp_path, edit=lambda mjcf: mjcf):
    folder = write_bundle(robot, tmp_path / "bundle", picture=False)
    mjcf = folder / "robot.xml"
    mjcf.write_text(edit(mjcf.read_text()))
    return {row.simulator: row for row in hold_files(read_bundle(folder), folder)}


def lever(effort):
    """A bar of 2 kg whose centre of mass is 0.5 m beside its horizontal axis: 9.81 N m."""
    inertial = Inertial(2.0, (0.5, 0.0, 0.0), (0.01, 0.0, 0.0, 0.05, 0.0, 0.05))
    strength = {"limits": (-3.0, 3.0), "effort": effort, "velocity": 1.0}
    joint = Joint("pivot", "revolute", "base", "bar", axis=(0, 1, 0), **strength)
    return Robot("lever", (Link("base"), Link("bar", inertial)), (joint,), home=(0.0,))


@needs_pybullet
@pytest.mark.parametrize(("effort", "holds"), [(9.0, False), (11.0, True)])
def test_a_motor_that_is_too_weak_lets_go_under_gravity(effort, holds, tmp_path):
    rows = held(lever(effort), tmp_path)
    assert rows["mujoco (mjcf)"].passed  # compensates gravity without the motor
    row = rows["pybullet (urdf)"]
    assert (row.passed, row.joint) == (holds, "pivot")
    if not holds:
        assert row.drift > 0.5
        cause = "pivot needs 9.81 N m to carry the weight, its effort is 9"
        assert row.causes == overloads(lever(effort), (0.0,)) == (cause,)


@needs_pybullet
@pytest.mark.parametrize("make", [arm, lambda: lever(30.0), lambda: lever(None)])
def test_joints_hold_step_and_settle(make, tmp_path):
    rows = held(make(), tmp_path)
    assert list(rows) == ["mujoco (mjcf)", "pybullet (urdf)"]
    assert rows["mujoco (mjcf)"].drift < 1e-6
    for row in rows.values():
        assert (row.passed, row.message) == (True, "")
        assert row.drift < 1e-3
        assert row.follower_error < 0.002
        assert 0 < row.step_error <= 0.02
        assert 0 < row.settling_time < 0.5


def test_steps_lead_away_from_limits():
    joints = arm().joints
    shoulder = replace(joints[0], limits=(-2.0, 0.45))
    elbow = replace(joints[1], kind="continuous", limits=None)
    left = replace(joints[3], limits=(0.02, 0.02))
    robot = replace(arm(), joints=(shoulder, elbow, joints[2], left, joints[4]))
    # From home at 0.4, 0.5, 0.01 and 0.02; `left` has no room.
    assert (step_targets(robot) - robot.home).round(6).tolist() == [
        [-0.2, 0.0, 0.0, 0.0],
        [0.0, 0.2, 0.0, 0.0],
        [0.0, 0.0, 0.02, 0.0],
    ]
    near = replace(
        robot,
        home=(0.4, 0.5, 0.03, 0.02),
        joints=(*joints[:2], replace(joints[2], limits=(0.02, 0.04)), *joints[3:]),
    )
    assert step_targets(near)[2, 2] == pytest.approx(0.03 + 0.8 * 0.01)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kp="[^"]*" kv="[^"]*"', 'kp="1e-6" kv="1e-6"', "shoulder is 0.2 rad from its target"),
        ('range="-2 2"', 'range="0.35 2"', "shoulder is 0.15 rad from its target"),
        ('<joint name="right_mimic".*?/>', "", "right is "),
    ],
    ids=["weak", "blocked", "uncoupled"],
)
def test_a_joint_that_does_not_step_is_named(old, new, message, tmp_path):
    row = held(arm(), tmp_path, lambda mjcf: re.sub(old, new, mjcf, count=1))["mujoco (mjcf)"]
    assert (row.passed, row.causes) == (False, ())
    assert row.drift < 1e-6
    assert row.message.startswith(message)
    assert "when " in row.message


def test_a_rod_that_comes_off_its_leader_fails(tmp_path):
    """A parallelogram in an arm, whose followers have no armature and a soft equality."""

    def loosen(mjcf):
        mjcf = re.sub(r'(<joint name="rod[12]"[^>]*?) armature="[^"]*"', r"\1", mjcf)
        return re.sub(r' sol(ref|imp)="[^"]*"', "", mjcf)

    robot = import_robot(Path(__file__).parent / "files" / "palletiser.urdf")
    row = held(robot, tmp_path, loosen)["mujoco (mjcf)"]
    assert (row.passed, row.causes) == (False, ())
    assert row.drift < 1e-6  # it holds
    assert row.follower_error > 0.5
    assert re.match("rod[12] is .* rad from its leader when elbow steps by 0.2 rad", row.message)


def test_drift_is_the_distance_to_which_an_actuator_pulls(tmp_path):
    def pull(mjcf):
        (ctrl,) = re.findall(r' ctrl="([^"]*)"', mjcf)
        first, *others = ctrl.split()
        return mjcf.replace(ctrl, " ".join([str(float(first) + 0.05), *others]))

    row = held(arm(), tmp_path, pull)["mujoco (mjcf)"]
    assert (row.passed, row.joint) == (False, "shoulder")
    assert (row.drift, row.unit) == (pytest.approx(0.05, rel=0.02), "rad")
    assert row.message == f"shoulder moves {row.drift:.3g} rad"


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"home"', '"start"', "no keyframe 'home'"),
        ('"elbow"', '"knee"', "lacks joints elbow"),
        ("<worldbody>", "<nonsense>", "MuJoCo: "),
        (
            r'kp="[^"]*" kv="[^"]*"( ctrlrange="[^"]*") forcerange="[^"]*"',
            r'kp="1e12" kv="0"\1',
            "div",
        ),
        *(
            ("</mujoco>", f'<option timestep="{dt}"/></mujoco>', "(MuJoCo: .*|robot.xml: )time")
            for dt in ("1e-9", "0.00001", "nan")
        ),
    ],
)
def test_a_file_that_cannot_be_simulated_fails(old, new, message, tmp_path):
    row = held(arm(), tmp_path, lambda mjcf: re.sub(old, new, mjcf))["mujoco (mjcf)"]
    assert (row.passed, row.drift) == (False, None)
    assert re.match(message, row.message)


def test_a_robot_without_joints_holds(tmp_path):
    block = replace(arm().root, name="block")
    row = held(Robot("block", (block,)), tmp_path)["mujoco (mjcf)"]
    assert (row.passed, row.drift) == (True, 0.0)


def test_a_missing_simulator_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    rows = held(arm(), tmp_path).values()
    assert [(row.passed, row.message) for row in rows] == [(None, "not installed")] * 2


def test_overloads_are_those_of_the_pose():
    upright = replace(lever(9.0).joints[0], T_parent_joint=Pose.from_xyz_rpy(rpy=(1.5707963, 0, 0)))
    assert overloads(replace(lever(9.0), joints=(upright,)), (0.0,)) == ()


@pytest.mark.parametrize(
    ("property_of_joint", "causes"),
    [
        ({"effort": 0.01}, ["ten times the effort limits are enough"]),
        ({"damping": 40.0}, ["it settles without the joint damping"]),
        (
            {"damping": 10.0, "friction": 12.0},
            ["it settles without the joint damping", "it settles without the dry friction"],
        ),
    ],
)
def test_a_property_without_which_a_joint_settles_is_a_cause(property_of_joint, causes, tmp_path):
    light = Link("bar", Inertial(0.02, (0, 0, 0), (1e-3, 0, 0, 1e-3, 0, 1e-3)))
    joint = replace(lever(5.0).joints[0], **property_of_joint)
    robot = replace(lever(5.0).with_links([light]), joints=(joint,))
    row = held(robot, tmp_path)["mujoco (mjcf)"]
    assert (row.passed, row.causes) == (False, tuple(causes))
