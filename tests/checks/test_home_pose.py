"""Gaps between the visual shapes of links at home."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh

from helpers.faulty_robots import hinge, valid_robot, with_end, with_link
from morphgen.checks import check, rules
from morphgen.checks.rules import MAX_GAP, check_links_apart
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Joint, Link, Robot
from morphgen.model.tree import scale_links


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


@pytest.mark.slow
def test_distances_of_dense_meshes_do_not_depend_on_the_coarse_test(tmp_path, monkeypatch):
    ball = mesh(tmp_path, "ball.stl", trimesh.creation.icosphere(5, radius=0.1))
    turned = Pose.from_xyz_rpy((0.0, 0.12, 0.16), (0.3, 0.2, 0.1))
    for few in (5, 500, 10**6):
        monkeypatch.setattr(rules, "_COARSE_TRIANGLES", few)
        assert gap_findings(pair(ball, ball, Pose((0.0, 0.12, 0.16)))) == []
        assert gap_findings(pair(ball, Sphere(0.1), turned)) == []
        (where_why,) = gap_findings(pair(ball, ball, replace(turned, position=(0.0, 0.138, 0.184))))
        assert "30.1 mm" in where_why[1] or "30 mm" in where_why[1]


@pytest.mark.parametrize("seed", range(4))
def test_distances_of_primitives_agree_with_their_triangles(seed):
    rng = np.random.default_rng(seed)
    kinds = (Box((0.1, 0.2, 0.05)), Sphere(0.05), Cylinder(0.03, 0.2), Capsule(0.03, 0.1))
    for a in kinds:
        for b in kinds:
            rpy = tuple(rng.choice([0.0, np.pi / 2, 0.7], 3))
            direction = rng.choice([-1.0, 0.0, 1.0], 3)
            direction[rng.integers(3)] = 1.0
            way = direction / np.linalg.norm(direction)
            touching = [
                not gap_findings(pair(a, b, Pose.from_xyz_rpy(tuple(far * way), rpy)))
                for far in (0.0, 0.02, 0.35)
            ]
            assert touching == [True, True, False]


def test_unreadable_shapes_and_invalid_joints_are_left_to_other_checks(tmp_path):
    (tmp_path / "bad.stl").write_text("no mesh")
    gone = pair(Mesh(tmp_path / "gone.stl"), Sphere(0.1), Pose((1.0, 0.0, 0.0)))
    broken = pair(Mesh(tmp_path / "bad.stl"), Sphere(0.1), Pose((1.0, 0.0, 0.0)))
    flat = pair(Box((0.0, 0.1, 0.1)), Sphere(0.1), Pose((1.0, 0.0, 0.0)))
    scale = pair(Mesh(tmp_path / "bad.stl", (0.0, 1.0, 1.0)), Sphere(0.1), Pose((1.0, 0.0, 0.0)))
    lost = replace(valid_robot(), home=(float("nan"), *valid_robot().home[1:]))
    for robot in (gone, broken, flat, scale, lost):
        assert gap_findings(robot) == []


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
