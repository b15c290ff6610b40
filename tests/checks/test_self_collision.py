"""Collisions of a robot with itself, and whether its motors hold it."""

import re
from dataclasses import replace
from itertools import combinations

import mujoco
import numpy as np
import pytest
import trimesh

from helpers.robots import arm, chain, composed
from helpers.scenes import needs_pybullet
from morphgen.checks import conformance as module
from morphgen.checks.conformance import hold_files
from morphgen.checks.self_collision import (
    ALWAYS_SHARE,
    PENETRATION,
    SelfCollisionChecker,
    adjacent_pairs,
    survey_collisions,
)
from morphgen.checks.srdf import (
    collision_matrix,
    parse_srdf,
    read_srdf,
    robot_srdf_text,
    with_disabled_pairs,
)
from morphgen.errors import FormatError, RobotError
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.model.geometry import Box, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Frame, Inertial, Joint, Link, Robot


def ball(name, radius=0.05):
    return Link(name, collisions=(Shape(Sphere(radius)),))


def penetrations(robot, q):
    return list(SelfCollisionChecker(robot).penetrations(q))


def slides(*offsets):
    """Return balls on prismatic joints along x on an empty root, at the given offsets."""
    joints = tuple(
        Joint(f"x{i}", "prismatic", "root", f"ball{i}", Pose((x, 0, 0)), limits=(-1.0, 1.0))
        for i, x in enumerate(offsets)
    )
    balls = (ball(f"ball{i}") for i in range(len(offsets)))
    return Robot("slides", (Link("root"), *balls), joints, home=(0.0,) * len(offsets))


def test_depths_are_those_of_spheres():
    depths = penetrations(slides(0.0, 0.3), [[0.0, 0.0], [0.0, -0.22], [0.25, 0.0]])
    pair = ("ball0", "ball1")
    assert depths == [{}, *({pair: pytest.approx(depth, abs=1e-6)} for depth in (0.02, 0.05))]


def test_touching_faces_do_not_collide():
    block = (Shape(Box((0.1, 0.1, 0.1))),)
    robot = slides(0.0, 0.1)
    blocks = (replace(link, collisions=block) for link in robot.links[1:])
    robot = replace(robot, links=(robot.root, *blocks))
    clear, deep = penetrations(robot, [[0.0, -PENETRATION / 2], [0.0, -2 * PENETRATION]])
    assert clear == {}
    assert set(deep) == {("ball0", "ball1")}


def test_links_of_the_root_are_tested():
    """MuJoCo by default does not test bodies welded to the world against their children."""
    robot = chain(ball("a"), ball("b", 0.3))
    (found,) = penetrations(robot, [robot.home])
    assert set(found) == {("a", "b")}


def test_mimic_joints_follow():
    robot = replace(arm(), ignore_pairs=survey_collisions(arm()).ignore_pairs)
    assert penetrations(robot, [(*robot.home[:3], 0.04)]) == [{}]


def test_a_mesh_counts_as_its_convex_hull(tmp_path):
    ring = trimesh.creation.annulus(r_min=0.4, r_max=0.5, height=0.1)
    ring.export(tmp_path / "ring.stl")
    mesh = Link("ring", collisions=(Shape(Mesh(tmp_path / "ring.stl")),))
    robot = chain(mesh, ball("inside"))
    robot = replace(robot, joints=(replace(robot.joints[0], T_parent_joint=Pose((0.0, 0.1, 0.0))),))
    (found,) = penetrations(robot, [robot.home])
    assert set(found) == {("inside", "ring")}


@pytest.mark.parametrize(
    ("names", "fixed", "pairs"),
    [
        ("abc", "", {"ab", "bc"}),
        ("aXYbc", "", {"ab", "bc"}),  # links without shapes do not separate
        ("abcd", "c", {"ab", "ac", "bc", "bd", "cd"}),  # links on fixed joints are one body
    ],
)
def test_links_across_a_joint_are_adjacent(names, fixed, pairs):
    robot = chain(*(Link(name) if name.isupper() else ball(name) for name in names))
    joints = tuple(replace(j, kind="fixed") if j.child == fixed else j for j in robot.joints)
    home = (0.0,) * sum(joint.is_independent for joint in joints)
    robot = replace(robot, joints=joints, home=home)
    assert adjacent_pairs(robot) == tuple(sorted((a, b) for a, b in pairs))
    assert adjacent_pairs(slides(0.0, 0.3)) == ()  # siblings on an empty root


def test_pairs_that_penetrate_at_home_are_ignored():
    robot = slides(0.0, 0.05, 0.5)
    pairs = survey_collisions(robot).ignore_pairs
    assert pairs == (("ball0", "ball1"),)
    assert penetrations(replace(robot, ignore_pairs=pairs), [robot.home]) == [{}]
    # MuJoCo knows neither a second world nor an empty range.
    joints = tuple(replace(j, parent="world", limits=(0.0, 0.0)) for j in robot.joints)
    robot = replace(robot, links=(Link("world"), *robot.links[1:]), joints=joints)
    assert survey_collisions(robot).ignore_pairs == pairs


def test_pairs_that_nearly_always_penetrate_are_ignored():
    """The fin penetrates the wall in most configurations, but not at home."""
    wall = Link("wall", collisions=(Shape(Box((0.02, 2.0, 2.0)), Pose((0.3, 0.0, 0.0))),))
    fin = Link("fin", collisions=(Shape(Sphere(0.1), Pose((0.0, 0.0, 0.1))),))
    for reach, expected in ((10.0, False), (0.08, True)):
        push = Joint(
            "push", "prismatic", "wall", "hand", axis=(1, 0, 0), limits=(0.24, 0.24 + reach)
        )
        turn = Joint("turn", "continuous", "hand", "fin", axis=(0, 0, 1))
        robot = Robot("r", (wall, ball("hand"), fin), (push, turn), home=(0.0, 0.0))
        assert (("fin", "wall") in survey_collisions(robot).ignore_pairs) == expected
        assert ("fin", "wall") not in penetrations(robot, [robot.home])[0]


def test_known_pairs_are_sorted_and_have_links():
    known = survey_collisions(slides(0.0, 0.5), known_pairs=[("ball1", "ball0")])
    assert known.ignore_pairs == (("ball0", "ball1"),)
    with pytest.raises(RobotError, match="no link 'ball9'"):
        survey_collisions(slides(0.0, 0.5), known_pairs=[("ball0", "ball9")])


def test_free_is_where_nothing_penetrates():
    robot = arm()
    checker = SelfCollisionChecker(robot, ())
    q = random_configurations(robot, 100, np.random.default_rng(0))
    free = checker.free(q)
    assert free.tolist() == [not contacts for contacts in checker.penetrations(q)]
    touching = SelfCollisionChecker(slides(0.0, 0.1)).free([[0.0, -PENETRATION / 2], [0.0, -0.01]])
    assert touching.tolist() == [True, False]
    assert checker.free(np.zeros((0, robot.dof))).tolist() == []
    for ask, wrong in ((checker.free, q[0]), (checker.penetrations, [[0.0]])):
        with pytest.raises(ValueError, match="q has shape"):
            ask(wrong)


def test_a_heap_of_overlapping_links_fits_into_memory():
    robot = slides(*[0.0] * 40)
    (found,) = penetrations(robot, [robot.home])
    assert len(found) == 40 * 39 // 2


def test_a_configuration_is_perturbed_where_epa_fails(monkeypatch, tmp_path, capfd):
    monkeypatch.chdir(tmp_path)
    collide, given_up = mujoco.mj_collision, []

    def give_up(model, data):
        if len(given_up) < 2:
            given_up.append(data.qpos[0])
            mujoco.get_mju_user_warning()("EPA: out of memory for faces on expanding polytope")
            data.ncon = 0
        else:
            collide(model, data)

    monkeypatch.setattr("mujoco.mj_collision", give_up)
    (found,) = penetrations(slides(0.0, 0.08), [[0.0, 0.0]])
    assert found == {("ball0", "ball1"): pytest.approx(0.02)}
    assert given_up == [0.0, 1e-9]
    given_up.clear()
    assert SelfCollisionChecker(slides(0.0, 0.08)).free([[0.0, 0.0]]).tolist() == [False]
    assert len(given_up) == 2
    assert not list(tmp_path.iterdir())
    assert capfd.readouterr() == ("", "")


def test_repeated_epa_failure_is_an_error(monkeypatch):
    def give_up(model, data):
        del model, data
        mujoco.get_mju_user_warning()("EPA: out of memory for faces on expanding polytope")

    monkeypatch.setattr("mujoco.mj_collision", give_up)
    with pytest.raises(
        RobotError, match=r"'slides': MuJoCo finds no penetration depth .* \[0\.0, 0\.0\]: EPA"
    ):
        penetrations(slides(0.0, 0.08), [[0.0, 0.0]])


SAMPLES = 400


def at(x, z):
    return Pose((x, 0.0, z))


def balls():
    """A robot of one ball per link, so that its collisions are distances between centres."""
    radii = {"base": 0.1, "turn": 0.05, "bare": None, "knob": 0.05, "slide": 0.05}
    radii |= {"post": 0.1, "top": 0.1, "carrier": 0.05, "big": 0.87}
    links = tuple(ball(name, radius) if radius else Link(name) for name, radius in radii.items())
    joints = (
        Joint("turn", "revolute", "base", "turn", at(0.3, 0.0), (0, 0, 1), (-3.0, 3.0)),
        Joint("bare", "fixed", "turn", "bare", at(0.0, 0.1)),
        Joint("knob", "fixed", "bare", "knob", at(0.0, 0.1)),
        Joint("slide", "prismatic", "knob", "slide", at(0.0, 0.0), (0, 0, 1), (-0.5, 0.5)),
        Joint("post", "fixed", "base", "post", at(0.0, 0.25)),
        Joint("top", "fixed", "post", "top", at(0.0, -0.1)),
        Joint("carrier", "prismatic", "base", "carrier", at(0.0, 3.0), (1, 0, 0), (0.0, 1.0)),
        Joint("big", "fixed", "carrier", "big", at(0.0, -2.75)),
    )
    home = (0.0, 0.3, 1.0)
    return Robot("balls", links, joints, (Frame("tool", "slide"),), home, (("bare", "turn"),))


def colliding_pairs(robot, q):
    """Sets of pairs of colliding balls at configurations, by the distances of their centres."""
    centres = forward_kinematics(robot, q)[..., :3, 3]
    result = [set() for _ in q]
    bodies = [(i, link) for i, link in enumerate(robot.links) if link.collisions]
    for (i, a), (j, b) in combinations(bodies, 2):
        reach = sum(link.collisions[0].geometry.radius for link in (a, b)) - PENETRATION
        distances = np.linalg.norm(centres[:, i] - centres[:, j], axis=-1)
        for k in np.flatnonzero(distances < reach):
            result[k].add(tuple(sorted((a.name, b.name))))
    return result


def test_reasons_agree_with_brute_force():
    robot = balls()
    reasons = collision_matrix(robot, samples=SAMPLES)
    q = random_configurations(robot, SAMPLES, np.random.default_rng(0))
    colliding = colliding_pairs(robot, q)
    seen = sorted(set().union(*colliding))
    counts = {pair: sum(pair in pairs for pairs in colliding) for pair in seen}
    linked = {("base", "turn"), ("knob", "turn"), ("knob", "slide"), ("base", "post")}
    linked |= {("post", "top"), ("base", "carrier"), ("big", "carrier")}
    (at_home,) = colliding_pairs(robot, np.array([robot.home]))
    names = sorted(link.name for link in robot.links if link.collisions)
    expected = {("bare", "turn"): "User"}
    for pair in combinations(names, 2):
        count = counts.get(pair, 0)
        if pair in linked:
            expected[pair] = "Adjacent"
        elif pair in at_home:
            expected[pair] = "Default"
        elif count >= ALWAYS_SHARE * SAMPLES:
            expected[pair] = "Always"
        elif count == 0:
            expected[pair] = "Never"
    assert reasons == dict(sorted(expected.items()))
    assert set(reasons.values()) == {"Adjacent", "Default", "Always", "Never", "User"}
    assert reasons["base", "top"] == "Default"  # fixed to each other
    assert reasons["big", "post"] == "Always"
    assert ("slide", "turn") not in reasons  # collides at times


def test_srdf_holds_the_matrix():
    robot = balls()
    text = robot_srdf_text(robot, samples=50)
    reasons = collision_matrix(robot, samples=50)
    srdf = parse_srdf(text.encode(), "balls")
    disabled = srdf.findall("disable_collisions")
    assert {(p.get("link1"), p.get("link2")): p.get("reason") for p in disabled} == reasons
    assert text == robot_srdf_text(robot, samples=50)
    assert set(with_disabled_pairs(robot, srdf).ignore_pairs) == set(reasons)


TEXT = """\
<robot name="arm &amp; &quot;hand&quot;">
  <group name="arm">
    <chain base_link="base" tip_link="tool"/>
  </group>
  <group name="ee">
    <link name="left"/>
    <link name="right"/>
  </group>
  <group_state name="home" group="arm">
    <joint name="shoulder" value="0.30000000000000004"/>
    <joint name="elbow" value="-1e-17"/>
    <joint name="extend" value="0.01"/>
  </group_state>
  <group_state name="home" group="ee">
    <joint name="left" value="0.02"/>
  </group_state>
  <end_effector name="ee" parent_link="slider" group="ee" parent_group="arm"/>
  <link_sphere_approximation link="upper">
    <sphere center="0.1 -0.2 0.14285714285714285" radius="0.05"/>
  </link_sphere_approximation>
  <disable_collisions """


def test_gripper_of_an_imported_arm_is_an_end_effector(tmp_path):
    sphere = Shape(Sphere(0.05), Pose((0.1, -0.2, 1 / 7)))
    robot = arm().with_links([replace(arm().link("upper"), collisions=(sphere,))])
    robot = replace(robot, name='arm & "hand"', home=(0.1 + 0.2, -1e-17, 0.01, 0.02))
    text = robot_srdf_text(robot, samples=10)
    assert text.startswith(TEXT)
    (tmp_path / "arm.srdf").write_text(text)
    assert read_srdf(tmp_path / "arm.srdf").get("name") == robot.name


def groups(robot):
    root = parse_srdf(robot_srdf_text(robot, samples=10).encode(), "x")
    return root, {group.get("name"): group for group in root.findall("group")}


def test_arm_without_end_effector_has_one_group():
    assert [*groups(balls())[1]] == ["arm"]


def test_parts_of_composed_robots_are_end_effectors():
    robot = composed("base=planar ee=cube")
    root, found = groups(robot)
    assert [*found] == ["arm", "ee"]
    assert all(link.get("name").startswith("ee_") for link in found["ee"])
    assert root.find("end_effector").get("parent_link") in robot.link_index


def test_robot_without_tool_is_refused():
    with pytest.raises(FormatError, match=r"'balls' has no frame 'tool'.*import FILE --tool LINK"):
        robot_srdf_text(replace(balls(), frames=()))


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
        assert row.message.endswith("; effort 9 of pivot does not hold the load of 9.81")


@needs_pybullet
@pytest.mark.parametrize("make", [arm, lambda: lever(30.0), lambda: lever(None)])
def test_joints_hold(make, tmp_path):
    rows = held(make(), tmp_path)
    assert list(rows) == ["mujoco (mjcf)", "pybullet (urdf)"]
    assert rows["mujoco (mjcf)"].drift < 1e-6
    for row in rows.values():
        assert (row.passed, row.message) == (True, "")
        assert row.drift < 1e-3


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
