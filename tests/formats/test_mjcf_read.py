"""MJCF becomes the robot that MuJoCo simulates, or is refused with the reason."""

import mujoco
import numpy as np
import pytest

from helpers.composed import composed
from helpers.mjcf import TWO_JOINTS, read, refusal, write
from helpers.robots import arm, rod
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.mjcf.read import read_mjcf
from morphgen.formats.mjcf.write import mjcf_text
from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Sphere
from morphgen.model.kinematics import (
    forward_kinematics,
    movable_positions,
    random_configurations,
)
from morphgen.model.robot import Joint, Robot


def positions(robot, q):
    """Return the position of every movable joint by name."""
    names = (robot.joints[k].name for k in robot.movable_joints)
    return dict(zip(names, movable_positions(robot, q).tolist(), strict=True))


def assert_poses_agree(robot, path):
    """Compare links and sites with MuJoCo at random configurations."""
    data = mujoco_data(path)
    for q in random_configurations(robot, 10, np.random.default_rng(0)):
        for name, value in positions(robot, q).items():
            data.joint(name).qpos[0] = value
        assert_pose_agrees(robot, q, data)


def mujoco_data(path):
    return mujoco.MjData(mujoco.MjModel.from_xml_path(str(path)))


def assert_pose_agrees(robot, q, data):
    """Compare mass properties of links, and sites, with those of MuJoCo in its state."""
    mujoco.mj_kinematics(data.model, data)
    T_root_link = forward_kinematics(robot, q)
    for T, link in zip(T_root_link, robot.links, strict=True):
        if link.inertial is None:
            continue
        com = T @ [*link.inertial.com, 1]
        np.testing.assert_allclose(com[:3], data.body(link.name).xipos, atol=1e-9)
        R, R_com = T[:3, :3], data.body(link.name).ximat.reshape(3, 3)
        principal = np.diag(data.model.body(link.name).inertia)
        inertia = R @ link.inertial.matrix @ R.T
        np.testing.assert_allclose(inertia, R_com @ principal @ R_com.T, atol=1e-9)
    for frame in robot.frames:
        if frame.name != "tool":
            T = T_root_link[robot.link_index[frame.link]] @ frame.T_link_frame.matrix
            np.testing.assert_allclose(T[:3, 3], data.site(frame.name).xpos, atol=1e-9)
            np.testing.assert_allclose(T[:3, :3].ravel(), data.site(frame.name).xmat, atol=1e-9)


def assert_same(robot, other):
    """Compare what an MJCF holds of a robot."""
    assert other.name == robot.name
    assert set(other.link_index) == set(robot.link_index)
    for link in robot.links:
        inertial = other.link(link.name).inertial
        if link.inertial is None or link.inertial.mass == 0:
            assert inertial is None
            continue
        assert inertial.mass == pytest.approx(link.inertial.mass, rel=1e-9)
        np.testing.assert_allclose(inertial.com, link.inertial.com, atol=1e-9)
        np.testing.assert_allclose(inertial.matrix, link.inertial.matrix, rtol=1e-6, atol=1e-11)
        for kind in ("visuals", "collisions"):
            shapes, read_shapes = getattr(link, kind), getattr(other.link(link.name), kind)
            assert [type(s.geometry) for s in shapes] == [type(s.geometry) for s in read_shapes]
            for shape, read_shape in zip(shapes, read_shapes, strict=True):
                T, T_read = shape.T_link_shape.matrix, read_shape.T_link_shape.matrix
                np.testing.assert_allclose(T, T_read, atol=1e-6)
    for joint in (robot.joints[k] for k in robot.movable_joints):
        read_joint = other.joints[other.joint_index[joint.name]]
        assert (read_joint.is_independent, read_joint.is_continuous) == (
            joint.is_independent,
            joint.is_continuous,
        )
        if joint.limits is not None and not joint.is_continuous:
            assert read_joint.limits == pytest.approx(joint.limits, abs=1e-9)
        if joint.is_independent and joint.effort:
            assert read_joint.effort == pytest.approx(joint.effort)
    assert positions(other, other.home) == pytest.approx(positions(robot, robot.home), abs=1e-9)
    assert other.ignore_pairs == robot.ignore_pairs
    assert {frame.name for frame in other.frames} == {frame.name for frame in robot.frames}
    assert_same_poses(robot, other)


def assert_same_poses(robot, other):
    """Compare links, mimic joints and frames of two robots at random configurations."""
    order = {robot.joints[k].name: i for i, k in enumerate(robot.independent_joints)}
    columns = [order[other.joints[k].name] for k in other.independent_joints]
    for q in random_configurations(robot, 5, np.random.default_rng(1)):
        T, T_read = forward_kinematics(robot, q), forward_kinematics(other, q[columns])
        assert positions(other, q[columns]) == pytest.approx(positions(robot, q), abs=1e-9)
        for name, i in robot.link_index.items():
            np.testing.assert_allclose(T_read[other.link_index[name]], T[i], atol=1e-9)
        for frame in robot.frames:
            other_frame = other.frame(frame.name)
            np.testing.assert_allclose(
                T_read[other.link_index[other_frame.link]] @ other_frame.T_link_frame.matrix,
                T[robot.link_index[frame.link]] @ frame.T_link_frame.matrix,
                atol=1e-9,
            )


def branching():
    """A tree whose joints are in another order than MuJoCo's, which is depth first."""
    places = {"left": ("root", -0.2), "right": ("root", 0.2), "left_tip": ("left", 0.0)}
    links = tuple(rod(name) for name in ("root", *places, "right_tip"))
    joints = tuple(
        Joint(child, "revolute", parent, child, Pose((x, 0, 0.3)), (0, 1, 0), (-2.0, 2.0))
        for child, (parent, x) in {**places, "right_tip": ("right", 0.0)}.items()
    )
    return Robot("tree", links, joints, home=(0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize("make", [arm, branching])
def test_written_robots_read_the_same(make, tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(mjcf_text(make(), lambda mesh: ""), encoding="utf-8")
    assert_same(make(), read_mjcf(path))


@pytest.mark.parametrize(
    "words", ["arm=ur5 ee=plane", "arm=arm3 ee=panda_hand", "base=gantry arm=arm3 ee=plane"]
)
def test_mjcf_of_composed_bundles_reads_the_same(words, tmp_path):
    folder = write_bundle(composed(words), tmp_path / "arm", picture=False)
    robot = read_bundle(folder)
    assert_same(robot, read_mjcf(folder / "robot.xml"))


def test_defaults_degrees_and_several_joints_of_a_body_agree_with_mujoco(tmp_path):
    path = write(
        tmp_path,
        """
        <compiler angle="degree" eulerseq="zyx"/>
        <default>
          <joint damping="0.5" frictionloss="0.1"/>
          <default class="arm"><joint axis="0 1 0" range="-90 45"/>
            <geom type="capsule" size="0.02 0.1" rgba="1 0 0 1"/></default>
        </default>
        <worldbody>
          <geom type="plane" size="1 1 1"/>
          <body name="base" pos="0.1 0 0.2" euler="10 20 30">
            <geom type="box" size="0.1 0.2 0.3"/>
            <body name="upper" pos="0 0 0.3" childclass="arm">
              <joint name="pan" axis="0 0 1"/>
              <joint name="lift" pos="0.05 0 0.02"/>
              <joint name="reach" type="slide" axis="1 0 1" range="0 0.2"/>
              <geom name="u" pos="0 0 0.1"/>
              <site name="elbow" pos="0 0.1 0.2" euler="0 45 0"/>
              <body name="lower" pos="0 0 0.25" euler="0 0 90">
                <joint name="bend" pos="0 0.03 -0.02" ref="15" range="-30 60"/>
                <joint name="turn" axis="1 1 0" limited="false"/>
                <geom fromto="0 0 0 0.1 0.2 0.3"/>
                <body name="tip" pos="0 0 0.2">
                  <joint name="last" pos="0.1 0 0" axis="0 0 1" range="-20 20"/>
                  <geom type="cylinder"/><geom type="sphere" pos="0.1 0 0" mass="2"/>
                  <site name="grip_site" pos="0 0 0.1"/>
                </body>
              </body>
            </body>
          </body>
        </worldbody>""",
    )
    robot = read_mjcf(path)
    assert_poses_agree(robot, path)
    assert [link.name for link in robot.links] == [
        *("world", "base", "upper_pan", "upper_lift", "upper"),
        *("lower_bend", "lower", "tip"),
    ]
    joints = {joint.name: joint for joint in robot.joints}
    kinds = {name: joint.kind for name, joint in joints.items()}
    assert kinds == {
        "base_joint": "fixed",
        "pan": "revolute",
        "lift": "revolute",
        "reach": "prismatic",
        "bend": "revolute",
        "turn": "continuous",
        "last": "revolute",
    }
    assert joints["lift"].limits == pytest.approx((-np.pi / 2, np.pi / 4))
    assert (joints["pan"].damping, joints["pan"].friction) == (0.5, 0.1)
    upper = robot.link("upper")
    assert upper.visuals[0].rgba == (1.0, 0.0, 0.0, 1.0)
    assert isinstance(upper.collisions[0].geometry, Capsule)
    assert upper.collisions[0].geometry == Capsule(0.02, 0.2)
    assert robot.link("world").collisions == ()
    assert isinstance(robot.link("base").collisions[0].geometry, Box)
    tip = [type(shape.geometry) for shape in robot.link("tip").collisions]
    assert tip == [Cylinder, Sphere]
    tool = robot.frame("tool")
    assert (tool.link, tool.T_link_frame) == ("tip", robot.frame("grip_site").T_link_frame)


def test_visual_and_collision_geoms_are_told_apart(tmp_path):
    robot = read(
        tmp_path,
        """
        <asset><material name="blue" rgba="0 0 1 1"/></asset>
        <worldbody><body name="a">
          <geom size="0.1" contype="0" conaffinity="0" material="blue"/>
          <geom size="0.2"/><geom size="0.3" group="3"/>
          <geom size="0.4" group="4" contype="0" conaffinity="0"/>
          <body name="b"><geom size="0.5" rgba="0 1 0 0.5"/><geom size="0.6" group="3"/></body>
        </body></worldbody>""",
    )

    def radii(shapes):
        return [shape.geometry.radius for shape in shapes]

    a, b = robot.links
    assert (radii(a.visuals), radii(a.collisions)) == ([0.1], [0.2, 0.3])
    assert (radii(b.visuals), radii(b.collisions)) == ([0.5], [0.5, 0.6])
    assert a.visuals[0].rgba == (0, 0, 1, 1)
    assert b.visuals[0].rgba == (0, 1, 0, 0.5)
    assert b.collisions[0].rgba is None


def test_joint_equalities_become_mimic_and_fixed_joints(tmp_path):
    path = write(
        tmp_path,
        """
        <compiler angle="radian"/>
        <worldbody><body name="base"><geom size="0.1"/>
          <body name="left"><joint name="a" ref="0.2" range="-1 1"/><geom size="0.1"/></body>
          <body name="right"><joint name="b" ref="0.1" range="-3 3"/><geom size="0.1"/></body>
          <body name="held"><joint name="c" ref="0.3" range="-1 1"/>
            <geom size="0.1" pos="0.5 0.1 0"/></body>
        </body></worldbody>
        <equality><joint joint1="b" joint2="a" polycoef="0.5 -2 0 0 0"/>
          <joint joint1="c" polycoef="0.4 0 0 0 0"/></equality>
        <tendon><fixed name="both"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed>
        </tendon>
        <actuator><position tendon="both" kp="1"/>
          <motor joint="a" gear="3" ctrlrange="-2 2"/></actuator>
        <contact><exclude body1="right" body2="left"/></contact>
        <keyframe><key qpos="0.9 0 0"/><key name="home" qpos="0.5 0 0"/></keyframe>""",
    )
    robot = read_mjcf(path)
    _, b, c = robot.joints
    assert (b.mimic.joint, b.mimic.multiplier) == ("a", -2.0)
    assert b.mimic.offset == pytest.approx(0.1 + 0.5 + 2 * 0.2)
    assert c.kind == "fixed"
    assert robot.home == (0.5,)
    assert robot.ignore_pairs == (("left", "right"),)
    assert robot.joints[0].effort == 6.0
    follower = 0.1 + 0.5 - 2 * (0.5 - 0.2)  # from its reference, as the leader
    data = mujoco_data(path)
    data.qpos[:] = (0.5, follower, 0.3 + 0.4)
    assert_pose_agrees(robot, robot.home, data)


def test_fixed_tendon_of_two_joints_held_by_an_equality_is_a_mimic(tmp_path):
    robot = read(
        tmp_path,
        TWO_JOINTS
        + """<tendon><fixed name="t"><joint joint="a" coef="2"/><joint joint="b" coef="4"/></fixed>
        </tendon><equality><tendon tendon1="t" polycoef="0.4 0 0 0 0"/></equality>""",
    )
    mimic = robot.joints[1].mimic
    assert (mimic.joint, mimic.multiplier, mimic.offset) == ("a", -0.5, pytest.approx(0.1))


def test_joint_that_follows_a_held_joint_is_held(tmp_path):
    path = write(
        tmp_path,
        """<compiler angle="radian"/><worldbody><body name="base"><geom size="0.1"/>
        <body name="x"><joint name="a"/><geom size="0.1" pos="1 0 0"/></body>
        <body name="y"><joint name="b" axis="1 0 0"/><geom size="0.1" pos="0 1 0"/></body>
        </body></worldbody><equality><joint joint1="b" joint2="a" polycoef="0.1 2 0 0 0"/>
        <joint joint1="a" polycoef="0.3 0 0 0 0"/></equality>""",
    )
    robot = read_mjcf(path)
    assert robot.dof == 0
    data = mujoco_data(path)
    data.qpos[:] = (0.3, 0.7)
    assert_pose_agrees(robot, robot.home, data)


def test_free_base_becomes_the_root(tmp_path):
    robot = read(
        tmp_path,
        """<worldbody><geom type="box" size="1 1 1"/><body name="trunk" pos="0 0 1"><freejoint/>
        <geom size="0.1"/><body name="leg"><joint name="hip"/><geom size="0.1"/></body></body>
        </worldbody><keyframe><key qpos="0 0 1 1 0 0 0 0.5"/></keyframe>""",
    )
    assert (robot.root.name, robot.dof, robot.home) == ("trunk", 1, (0.5,))
    assert [finding.code for finding in robot.source_findings] == ["world-shapes"]


def test_keyframe_outside_the_limits_is_left_out(tmp_path):
    robot = read(
        tmp_path,
        """<compiler angle="radian"/>
        <worldbody><body name="base"><geom size="0.1"/><body name="tip">
        <joint name="a" range="1 2"/><geom size="0.1"/></body></body></worldbody>
        <keyframe><key name="rest" qpos="3"/></keyframe>""",
    )
    assert robot.home == (1.5,)
    (finding,) = robot.source_findings
    assert (finding.code, finding.where) == ("keyframe-outside-limits", "robot.xml: key 'rest'")


def test_root_body_cuts_the_robot_out_of_a_scene(tmp_path):
    scene = """<worldbody><body name="table"><geom size="0.1"/></body>
        <body name="handle" mocap="true"/>
        <body name="arm"><geom size="0.1"/><body name="tip"><joint name="a"/><geom size="0.1"/>
        </body></body><body name="ball"><freejoint name="fly"/><geom size="0.1"/></body></worldbody>
        <equality><weld name="drag" body1="handle" body2="tip"/></equality>"""
    assert refusal(tmp_path, scene) == (
        "the world holds the bodies 'table', 'handle', 'arm', 'ball', of which 'table' has no "
        "joints; name the robot's by --root-link BODY of morphgen import"
    )
    robot = read(tmp_path, scene, root_body="arm")
    assert [link.name for link in robot.links] == ["arm", "tip"]
    assert [finding.code for finding in robot.source_findings] == ["mocap-constraint"]
    assert refusal(tmp_path, scene, root_body="amr") == (
        "no body 'amr' for root link; did you mean 'arm'? valid: arm, ball, handle, table, tip, "
        "world"
    )


def test_names_are_unique_and_sites_do_not_take_those_of_links(tmp_path):
    robot = read(
        tmp_path,
        """<worldbody><body name="a"><geom size="0.1"/><site name="a"/>
        <body name="b"><joint/><joint name="b_joint" axis="1 0 0"/><geom size="0.1"/></body>
        <body><joint/><geom size="0.1"/></body></body></worldbody>""",
    )
    assert [link.name for link in robot.links] == ["a", "b_b_joint_2", "b", "body_3"]
    assert [joint.name for joint in robot.joints] == ["b_joint_2", "b_joint", "body_3_joint"]
    assert [frame.name for frame in robot.frames] == ["a_site"]


def test_what_a_robot_has_no_place_for_is_counted(tmp_path):
    body = """<option timestep="0.001"><flag gravity="disable"/></option>
        <default><geom condim="4"/></default>
        <worldbody><light/><body name="base"><geom size="0.1" friction="1 1 1" solref="1 1"/>
        <body name="tip" gravcomp="1"><joint name="a" stiffness="3"/><geom size="0.1" friction="1"/>
        </body></body></worldbody>
        <actuator><position joint="a" kp="9" ctrlrange="-1 1"/></actuator>
        <sensor><jointpos joint="a"/><jointvel joint="a"/></sensor>"""
    findings = read(tmp_path, body).source_findings
    assert {finding.severity for finding in findings} == {"info"}
    assert [finding.repair for finding in findings] == [
        "left out: 1 <option> of <mujoco> with 1 elements inside",
        "left out: 1 <sensor> of <mujoco> with 2 elements inside",
        "left out: 1 <light> of <worldbody>",
        "left out: 1 condim=..., 2 friction=..., 1 solref=... of <geom>",
        "left out: 1 gravcomp=... of <body>",
        "left out: 1 stiffness=... of <joint>",
        "left out: 1 kp=... of <position>",
    ]
