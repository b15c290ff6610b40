"""The edit distance of kinematic trees is minimal, a metric, and independent of the file."""

import itertools
import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import morphgen
from helpers.robots import arm
from morphgen.encoding.similarity import (
    FIXED,
    change_costs,
    edit_distance,
    labelled_tree,
    normalised_distance,
)
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Joint, Link, Robot
from morphgen.model.tree import rename, scale_links

BLOCK = Shape(Box((0.1, 0.2, 0.3)))
AXES = ((0, 0, 1), (0, 1, 0), (1, 0, 0), (0, 0, -1), (0, 0.6, 0.8))
GEOMETRIES = (Box((0.1, 0.2, 0.3)), Sphere(0.05), Cylinder(0.02, 0.4), Capsule(0.02, 0.2))


def body(*joints, shapes=(), home=None):
    """A robot with joints (kind, parent, axis, offset) and root link0."""
    made = [
        Joint(f"joint{k}", kind, f"link{parent}", f"link{k}", Pose((offset, 0.0, 0.0)), axis)
        for k, (kind, parent, axis, offset) in enumerate(joints, 1)
    ]
    links = tuple(
        Link(f"link{k}", collisions=(shape,) if shape else ())
        for k, shape in itertools.zip_longest(range(len(made) + 1), shapes)
    )
    moving = sum(joint.is_movable for joint in made)
    return Robot("body", links, tuple(made), home=home or (0.0,) * moving)


def tree(robot, reach=1.0):
    shapes = {link.name: link.collisions[0] for link in robot.links if link.collisions}
    return labelled_tree(robot, shapes, reach)


def distance(a, b):
    return normalised_distance(tree(a), tree(b))


@st.composite
def trees(draw, most=5):
    n = draw(st.integers(0, most))
    joints = [
        (
            draw(st.sampled_from(["fixed", "prismatic", "revolute", "continuous"])),
            draw(st.integers(0, k)),
            draw(st.sampled_from(AXES)),
            draw(st.sampled_from([0.0, 0.1, 0.25, 1.0])),
        )
        for k in range(n)
    ]
    shape = st.none() | st.sampled_from(GEOMETRIES).map(Shape)
    return tree(body(*joints, shapes=[draw(shape) for _ in range(n + 1)]))


def brute_force(a, b):
    """Minimum cost over all mappings that keep order and ancestry."""
    costs = change_costs(a, b)
    everything = math.fsum(a.weights) + math.fsum(b.weights)
    best = everything
    for size in range(1, min(len(a.kinds), len(b.kinds)) + 1):
        for mine in itertools.combinations(range(len(a.kinds)), size):
            for yours in itertools.combinations(range(len(b.kinds)), size):
                if all(
                    is_below(a, mine[s], mine[t]) == is_below(b, yours[s], yours[t])
                    for s, t in itertools.combinations(range(size), 2)
                ):
                    kept = a.weights[list(mine)].sum() + b.weights[list(yours)].sum()
                    best = min(best, everything - kept + costs[mine, yours].sum())
    return best


def is_below(tree, lower, upper):
    return tree.leftmost[upper] <= lower < upper


@given(trees(4), trees(4))
@settings(max_examples=150)
def test_the_distance_is_the_minimum_over_all_mappings(a, b):
    assert edit_distance(a, b) == pytest.approx(brute_force(a, b), abs=1e-12)


@given(trees(), trees())
def test_the_distance_is_symmetric_and_zero_on_the_diagonal(a, b):
    assert normalised_distance(a, b) == normalised_distance(b, a)
    assert normalised_distance(a, a) == 0.0
    assert 0.0 <= normalised_distance(a, b) <= 1.0


@pytest.mark.slow
@given(trees(), trees(), trees())
@settings(max_examples=300)
def test_the_triangle_inequality(a, b, c):
    for measured in (edit_distance, normalised_distance):
        assert measured(a, c) <= measured(a, b) + measured(b, c) + 1e-12


def test_the_distance_is_one_without_common_parts_and_zero_between_empty_trees():
    hinge = body(("revolute", 0, (0, 0, 1), 0.1))
    assert distance(body(), hinge) == 1.0
    assert distance(body(), body()) == 0.0


@pytest.mark.parametrize(
    ("change", "cost"),
    [
        (("prismatic", 0, (0, 0, 1), 0.2), 1 / 2),
        (("revolute", 0, (0, 1, 0), 0.2), 1 / 4),
        (("revolute", 0, (0, 1, 1), 0.2), 1 / 8),
        (("revolute", 0, (0, 0, -2), 0.2), 0.0),
        (("continuous", 0, (0, 0, 1), 0.2), 0.0),
        (("prismatic", 0, (1, 0, 0), 0.2), 3 / 4),
        (("fixed", 0, (0, 0, 1), 0.2), 3 / 4),
        (("revolute", 0, (0, 0, 1), 0.45), 1 / 8 * 0.25 / 0.7),
    ],
)
def test_costs_of_changed_joints(change, cost):
    hinge = body(("revolute", 0, (0, 0, 1), 0.2), shapes=[None, BLOCK])
    other = body(change, shapes=[None, BLOCK])
    assert edit_distance(tree(hinge), tree(other)) == pytest.approx(cost, abs=1e-12)


@pytest.mark.parametrize(
    ("other", "cost"),
    [
        (Sphere(0.1), 1 / 16),
        (Cylinder(0.1, 0.2), 1 / 16),
        (Box((0.2,) * 3), 0.0),
        (Box((0.3, 0.1, 0.6)), 1 / 16 * (0.1 / 0.35 + 0.1 / 0.55 + 0.4 / 0.85) / 3),
    ],
)
def test_cost_of_a_changed_shape(other, cost):
    cube, changed = (
        body(("prismatic", 0, (0, 0, 1), 0.2), shapes=[None, Shape(geometry)])
        for geometry in (Box((0.2, 0.2, 0.2)), other)
    )
    assert edit_distance(tree(cube), tree(changed)) == pytest.approx(cost)


def test_a_capsule_costs_the_same_as_a_cylinder_and_a_missing_shape_costs_more():
    joint = ("prismatic", 0, (0, 0, 1), 0.2)
    capsule, cylinder = Shape(Capsule(0.1, 0.3)), Shape(Cylinder(0.1, 0.5))
    a, b = (tree(body(joint, shapes=[None, shape])) for shape in (capsule, cylinder))
    assert edit_distance(a, b) == pytest.approx(0, abs=1e-12)
    assert edit_distance(a, tree(body(joint))) > 1 / 16
    with pytest.raises(ValueError, match="a mesh has no label"):
        labelled_tree(body(), {"link0": Shape(Mesh(Path("a.stl")))}, 1.0)


def test_costs_of_insertions():
    hinge = ("revolute", 0, (0, 0, 1), 0.2)
    one = tree(body(hinge))
    two = tree(body(hinge, ("revolute", 1, (0, 1, 0), 0.3)))
    rigid = tree(body(hinge, ("fixed", 1, (1, 0, 0), 0.3), shapes=[None, None, BLOCK]))
    assert edit_distance(one, two) == 1.0
    assert edit_distance(one, rigid) == FIXED
    assert normalised_distance(one, two) == 2 / (1 + 2 + 1)


def test_axes_are_compared_at_home():
    bent = body(("revolute", 0, (0, 0, 1), 0.0), ("revolute", 1, (1, 0, 0), 0.1))
    turned = replace(bent, home=(math.pi / 2, 0.0))
    along_y = body(("revolute", 0, (0, 0, 1), 0.0), ("revolute", 1, (0, 1, 0), 0.1))
    assert edit_distance(tree(bent), tree(turned)) == pytest.approx(1 / 4)
    assert edit_distance(tree(turned), tree(along_y)) == pytest.approx(0, abs=1e-12)


def test_empty_links_do_not_change_the_distance():
    plain = body(("revolute", 0, (0, 0, 1), 0.3), ("revolute", 1, (0, 1, 0), 0.2))
    framed = body(
        ("fixed", 0, (1, 0, 0), 0.1),
        ("revolute", 1, (0, 0, 1), 0.2),
        ("fixed", 2, (1, 0, 0), -0.1),
        ("fixed", 3, (1, 0, 0), 0.3),
        ("revolute", 4, (0, 1, 0), 0.0),
        ("fixed", 5, (1, 0, 0), 0.7),
    )
    assert distance(plain, framed) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("order", list(itertools.permutations(range(4))))
def test_the_order_of_siblings_and_the_sign_of_axes_do_not_matter(order):
    fingers = [
        ("revolute", 0, (0, 0, 1), 0.1),
        ("revolute", 0, (0, 0.6, 0.8), 0.1),
        ("revolute", 0, (0, 0, 1), 0.3),
        ("prismatic", 0, (1, 0, 0), 0.1),
    ]
    pads = [BLOCK, BLOCK, None, BLOCK]
    hand = body(*fingers, shapes=[None, *pads])
    other = [
        (kind, parent, tuple(-x for x in axis) if k % 2 else axis, offset)
        for k, (kind, parent, axis, offset) in enumerate(fingers)
    ]
    shuffled = body(*(other[k] for k in order), shapes=[None, *(pads[k] for k in order)])
    assert distance(hand, shuffled) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("factor", [0.01, 3.0])
def test_size_does_not_matter(factor):
    robot = morphgen.compose("arm=lwr ee=claw")
    large = scale_links(robot, {link.name: factor for link in robot.links})
    a, b = tree(robot, reach=1.2), tree(large, reach=1.2 * factor)
    assert normalised_distance(a, b) == pytest.approx(0, abs=1e-9)
    assert normalised_distance(a, tree(large, reach=1.2)) > 0.01


def test_names_do_not_matter():
    robot = arm()
    links, joints = (
        {each.name: f"new_{each.name}" for each in kind} for kind in (robot.links, robot.joints)
    )
    assert distance(robot, rename(robot, links, joints)) == 0.0
