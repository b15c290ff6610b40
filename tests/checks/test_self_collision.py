"""Self-collision tests and pairs to ignore."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from helpers.robots import arm, chain
from morphgen.checks.self_collision import (
    PENETRATION,
    SelfCollisionChecker,
    adjacent_pairs,
    survey_collisions,
)
from morphgen.errors import RobotError
from morphgen.model.geometry import Box, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Joint, Link, Robot

BALL = (Shape(Sphere(0.05)),)


def ball(name):
    return Link(name, collisions=BALL)


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


def test_a_margin_counts_gaps_as_negative_depths():
    robot = slides(0.0, 0.1004)
    (depths,) = SelfCollisionChecker(robot, margin=1e-3).penetrations([[0.0, 0.0]])
    assert depths == {("ball0", "ball1"): pytest.approx(-4e-4, abs=1e-9)}
    (depths,) = SelfCollisionChecker(robot, margin=3e-4).penetrations([[0.0, 0.0]])
    assert depths == {}


def test_depths_are_those_of_spheres():
    robot = slides(0.0, 0.3)
    depths = penetrations(robot, [[0.0, 0.0], [0.0, -0.22], [0.25, 0.0]])
    assert depths[0] == {}
    assert depths[1] == {("ball0", "ball1"): pytest.approx(0.02, abs=1e-6)}
    assert depths[2] == {("ball0", "ball1"): pytest.approx(0.05, abs=1e-6)}


def test_touching_faces_do_not_collide():
    block = (Shape(Box((0.1, 0.1, 0.1))),)
    robot = slides(0.0, 0.1)
    robot = replace(
        robot, links=(robot.root, *(replace(x, collisions=block) for x in robot.links[1:]))
    )
    clear, deep = penetrations(robot, [[0.0, -PENETRATION / 2], [0.0, -2 * PENETRATION]])
    assert clear == {}
    assert set(deep) == {("ball0", "ball1")}


def test_links_of_the_root_are_tested():
    """MuJoCo by default does not test bodies welded to the world against their children."""
    robot = chain(ball("a"), replace(ball("b"), collisions=(Shape(Sphere(0.3)),)))
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
    joints = tuple(
        replace(joint, kind="fixed") if joint.child == fixed else joint for joint in robot.joints
    )
    home = (0.0,) * sum(joint.is_independent for joint in joints)
    robot = replace(robot, joints=joints, home=home)
    assert adjacent_pairs(robot) == tuple(sorted((a, b) for a, b in pairs))


def test_siblings_on_an_empty_root_are_not_adjacent():
    assert adjacent_pairs(slides(0.0, 0.3)) == ()


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


def test_only_pairs_across_parts_are_tested():
    robot = arm()
    part = {"base": 0, "upper": 0, "lower": 0}
    whole = survey_collisions(robot).ignore_pairs
    inside = [pair for pair in whole if part.get(pair[0]) == part.get(pair[1])]
    asked = []

    def across(a, b):
        asked.append((a, b))
        return part.get(a) != part.get(b)

    assert survey_collisions(robot, known_pairs=inside, should_test=across).ignore_pairs == whole
    assert not set(asked) & set(whole)


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
    touching = SelfCollisionChecker(slides(0.0, 0.1)).free(
        [[0.0, -0.5 * PENETRATION], [0.0, -0.01]]
    )
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
