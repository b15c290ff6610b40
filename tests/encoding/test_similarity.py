"""Similarity measures, workspaces relative to the shoulder, matrices, distances and maps."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import morphgen
from helpers.faulty_robots import with_joint
from helpers.robots import arm, shapes_of
from morphgen.encoding.similarity import (
    FIXED,
    MEASURES,
    change_costs,
    classical_mds,
    cosine,
    density_overlap,
    edit_distance,
    features,
    labelled_tree,
    normalised_distance,
    shoulder,
    similarity_matrix,
    tree_distance,
    workspace,
    workspace_overlap,
)
from morphgen.encoding.tokens import pad_tokens, tokens
from morphgen.errors import BenchmarkError, RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import reach_from_root
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.model.tree import rename, scale_links
from morphgen.progress import show_progress

LWR = "arm=lwr ee=plane"
REQUESTS = (LWR, "arm=lwr ee=claw", "arm3", "chain beads=2", "cubes")


def featured(request, **options):
    robot = morphgen.compose(request)
    return features(robot, token_shapes(robot), **options)


@pytest.fixture(scope="module")
def some():
    return [featured(request) for request in REQUESTS]


def test_a_robot_is_most_similar_to_itself(some):
    for one in some:
        assert cosine(one, one) == pytest.approx(1)
        assert tree_distance(one, one) == 0
        assert workspace_overlap(one, one) == pytest.approx(1)
    for one, other in itertools.permutations(some, 2):
        assert -1 <= cosine(one, other) < 0.999
        assert 0 < tree_distance(one, other) <= 1
        assert 0 <= workspace_overlap(one, other) < 0.999


def test_the_cosine_uses_flattened_padded_tokens_without_q(some):
    robots = [morphgen.compose(request) for request in REQUESTS[:3]]
    tables = [tokens(robot, token_shapes(robot)) for robot in robots]
    flat = [pad_tokens(table, 23)[0][:, :32].ravel() for table in tables]
    for i, j in itertools.combinations(range(3), 2):
        expected = flat[i] @ flat[j] / np.sqrt((flat[i] @ flat[i]) * (flat[j] @ flat[j]))
        assert cosine(some[i], some[j]) == pytest.approx(expected, abs=1e-12)


def test_home_changes_the_tree_but_not_the_cosine():
    bent = replace(arm(), home=(1.4, 0.5, 0.01, 0.02))
    a, b = (features(robot, shapes_of(robot)) for robot in (arm(), bent))
    assert cosine(a, b) == pytest.approx(1)
    assert workspace_overlap(a, b) == pytest.approx(1)
    assert tree_distance(a, b) > 0.01


def test_robots_of_more_than_23_links_need_a_common_maximum():
    with pytest.raises(BenchmarkError, match=r"25 links, more than max_links 23; make max_links 2"):
        featured("chain beads=7")
    long, short = (featured(f"chain beads={beads}", max_links=25) for beads in (7, 6))
    assert len(long.tokens) == 25
    assert long.tokens[-1, 0] == 1
    assert long.tokens[0, 1] == pytest.approx(-1 / 24)
    assert 0.8 < cosine(long, short) < 1
    np.testing.assert_allclose(long.tokens[:5, :2], short.tokens[:5, :2])


@pytest.mark.parametrize("name", MEASURES)
def test_a_matrix_is_symmetric_and_has_the_values_of_the_measure(some, name):
    told = []
    with show_progress(lambda *now: told.append(now)):
        values = similarity_matrix(some, name)
    assert told == [(1, 15), (3, 15), (6, 15), (10, 15), (15, 15)]
    function = MEASURES[name].function
    assert values.shape == (5, 5)
    np.testing.assert_array_equal(values, values.T)
    for i, j in itertools.product(range(5), repeat=2):
        assert values[i, j] == pytest.approx(function(some[i], some[j]), abs=1e-15)


def test_robots_without_a_movable_tool_or_with_invalid_shapes_are_errors():
    mesh = {"base": Shape(Mesh("a.stl"))}
    with pytest.raises(BenchmarkError, match=r"'arm' has no frame 'tool'.*import FILE --tool LINK"):
        features(replace(arm(), frames=()), {})
    with pytest.raises(BenchmarkError, match="a mesh has no token"):
        features(arm(), mesh)
    with pytest.raises(ValueError, match="a mesh has no label"):
        labelled_tree(arm(), mesh, 1.0)
    with pytest.raises(RobotError, match="is zero"):
        features(with_joint(arm(), "shoulder", axis=(0.0, 0.0, 0.0)), {})
    with pytest.raises(BenchmarkError, match="no joint moves its tool, which is on link 'base'"):
        workspace(replace(arm(), frames=(Frame("tool", "base"),)))
    with pytest.raises(BenchmarkError, match="only turns about its own origin"):
        workspace(chain(("revolute", (0, 0, 1), (0, 0, 1))))


NUMBERS = st.floats(-10, 10, width=32)
PLANES = st.integers(1, 8).flatmap(lambda n: arrays(np.float64, (n, 2), elements=NUMBERS))


def apart(points):
    return np.linalg.norm(points[:, None] - points, axis=-1)


@given(PLANES)
def test_points_of_a_plane_keep_their_distances(points):
    embedding = classical_mds(apart(points))
    np.testing.assert_allclose(apart(embedding.points), apart(points), atol=1e-5)
    assert embedding.kept == pytest.approx(1)
    np.testing.assert_allclose(embedding.points.mean(axis=0), 0, atol=1e-5)


def test_the_first_axis_varies_most_and_its_farthest_point_is_on_the_right():
    embedding = classical_mds(apart(np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 5.0], [0.5, 2.0]])))
    assert np.ptp(embedding.points[:, 0]) > np.ptp(embedding.points[:, 1])
    assert embedding.points[:, 0].argmax() == 2
    assert embedding.points[:, 0].max() == np.abs(embedding.points[:, 0]).max()


def test_non_euclidean_distances_reduce_the_share():
    star = np.array([[0, 1, 1, 1], [1, 0, 2, 2], [1, 2, 0, 2], [1, 2, 2, 0]], dtype=float)
    values = np.linalg.eigvalsh(-(np.eye(4) - 0.25) @ (star**2) @ (np.eye(4) - 0.25) / 2)
    assert values.min() < -0.1
    embedding = classical_mds(star)
    assert embedding.kept == pytest.approx(np.sort(values)[-2:].sum() / np.abs(values).sum())


@pytest.mark.parametrize("n", [1, 2, 5])
def test_equal_robots_are_one_point(n):
    embedding = classical_mds(np.zeros((n, n)))
    np.testing.assert_array_equal(embedding.points, np.zeros((n, 2)))
    assert embedding.kept == 1.0


def chain(*joints, tool=(0.0, 0.0, 0.5)):
    """A chain of joints (kind, origin, axis) with a tool."""
    made = [
        Joint(f"j{k}", kind, f"l{k}", f"l{k + 1}", Pose(origin), axis, limits=(-1.0, 1.0))
        for k, (kind, origin, axis) in enumerate(joints)
    ]
    links = tuple(Link(f"l{k}") for k in range(len(made) + 1))
    home = (0.0,) * sum(joint.is_movable for joint in made)
    return Robot("chain", links, tuple(made), (Frame("tool", links[-1].name, Pose(tool)),), home)


def test_the_overlap_is_symmetric_and_in_the_unit_interval():
    a, b = (workspace(morphgen.compose(words)) for words in (LWR, "arm3"))
    assert density_overlap(a, b) == density_overlap(b, a)
    assert 0.3 < density_overlap(a, b) < 0.9
    up = workspace(chain(("revolute", (0, 0, 0), (1, 0, 0))))
    flat = workspace(chain(("revolute", (0, 0, 0), (0, 0, 1)), tool=(0.5, 0.0, 0.0)))
    assert density_overlap(up, flat) == 0.0


def test_the_workspace_of_a_revolute_joint_is_a_circle():
    result = workspace(chain(("revolute", (0, 0, 1), (0, 0, 1)), tool=(0.5, 0.0, 0.2)))
    assert result.shoulder == pytest.approx((0, 0, 1.2))
    assert result.reach == pytest.approx(0.5)
    nodes = (np.argwhere(result.density > 0) - 10) / 10
    assert (np.abs(np.linalg.norm(nodes, axis=1) - 1) < 0.15).all()
    assert set(nodes[:, 2]) == {0.0}
    assert nodes[:, 0].min() > 0.4  # limits of one radian


@pytest.mark.parametrize("factor", [0.01, 3.0])
def test_the_scale_of_a_robot_does_not_matter(factor):
    robot = morphgen.compose(LWR)
    large = workspace(scale_links(robot, {link.name: factor for link in robot.links}))
    assert large.reach == pytest.approx(factor * workspace(robot).reach)
    assert density_overlap(workspace(robot), large) == pytest.approx(1, abs=1e-9)


def test_the_pedestal_does_not_matter():
    robot = workspace(morphgen.compose(LWR))
    raised = workspace(morphgen.compose(f"base=pedestal {LWR}"))
    assert raised.shoulder[2] > robot.shoulder[2] + 0.1
    assert density_overlap(robot, raised) == pytest.approx(1, abs=1e-9)


def test_the_origin_of_a_joint_on_its_axis_does_not_matter():
    robot = morphgen.compose(LWR)
    first = robot.joints[robot.independent_joints[0]]
    down = Pose(tuple(-0.1 * value for value in first.unit_axis))
    moved = with_joint(robot, first.name, T_parent_joint=first.T_parent_joint @ down)
    for joint in robot.joints:
        if joint.parent == first.child:
            up = down.inverse() @ joint.T_parent_joint
            moved = with_joint(moved, joint.name, T_parent_joint=up)
    assert reach_from_root(moved) == pytest.approx(reach_from_root(robot))
    assert shoulder(moved) == pytest.approx(shoulder(robot))
    assert density_overlap(workspace(moved), workspace(robot)) == pytest.approx(1, abs=1e-9)


def test_the_shoulder_is_the_intersection_of_the_first_two_axes_or_in_the_plane_of_a_planar_arm():
    turn = ("revolute", (0.3, 0, 0.1), (0, 0, 1))
    lift = ("revolute", (0.1, 0, 0.4), (0, 1, 0))
    again = ("revolute", (0.2, 0, 0.2), (0, 0, 1))
    assert shoulder(chain(turn, lift)) == pytest.approx((0.3, 0, 0.5))
    assert shoulder(chain(turn, again, lift)) == pytest.approx((0.3, 0, 0.7))
    low = ("revolute", (0, 0, 0.1), (0, 0, 1))
    oblique = ("revolute", (0.1, 0.8, 0.9), (0, 0.8, 0.6))
    assert shoulder(chain(low, oblique)) == pytest.approx((0, 0, 0.4))
    assert shoulder(chain(turn, turn, tool=(0.5, 0, 0.4))) == pytest.approx((0.3, 0, 0.6))


def test_the_shoulder_of_prismatic_robots_is_the_middle_of_their_travel():
    robot = chain(("prismatic", (0.3, 0, 0), (1, 0, 0)), tool=(0, 0, 0))
    result = workspace(with_joint(robot, "j0", limits=(0.0, 3.0)))
    assert result.shoulder == pytest.approx((1.8, 0, 0))
    assert result.reach == pytest.approx(1.5, rel=1e-3)


def test_the_samples_of_an_arm_do_not_depend_on_its_gripper():
    robot = arm()
    links = (robot.root, Link("flap"), *robot.links[1:])
    flap = Joint("flap", "revolute", "base", "flap", limits=(-1.0, 1.0))
    home = (0.0, *robot.home)
    other = replace(robot, links=links, joints=(flap, *robot.joints), home=home)
    assert density_overlap(workspace(robot), workspace(other)) == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("limits", [(0.0, np.inf), (1.0, -1.0), (np.nan, 1.0)])
def test_limits_without_a_range_are_an_error(limits):
    with pytest.raises(BenchmarkError, match=r"joint 'elbow': limits .* morphgen check"):
        workspace(with_joint(arm(), "elbow", limits=limits))


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
    best = everything = math.fsum(a.weights) + math.fsum(b.weights)
    for size in range(1, min(len(a.kinds), len(b.kinds)) + 1):
        mappings = itertools.product(
            *(itertools.combinations(range(len(each.kinds)), size) for each in (a, b))
        )
        for mine, yours in mappings:
            if ancestry(a, mine) == ancestry(b, yours):
                kept = a.weights[list(mine)].sum() + b.weights[list(yours)].sum()
                best = min(best, everything - kept + costs[mine, yours].sum())
    return best


def ancestry(tree, nodes):
    return [tree.leftmost[j] <= i < j for i, j in itertools.combinations(nodes, 2)]


@given(trees(4), trees(4))
@settings(max_examples=150)
def test_the_distance_is_the_minimum_over_all_mappings(a, b):
    assert edit_distance(a, b) == pytest.approx(brute_force(a, b), abs=1e-12)


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


def test_names_and_size_do_not_matter():
    robot = morphgen.compose("arm=lwr ee=claw")
    links, joints = (
        {each.name: f"new_{each.name}" for each in kind} for kind in (robot.links, robot.joints)
    )
    assert distance(robot, rename(robot, links, joints)) == 0.0
    for factor in (0.01, 3.0):
        large = scale_links(robot, dict.fromkeys(links, factor))
        a, b = tree(robot, reach=1.2), tree(large, reach=1.2 * factor)
        assert normalised_distance(a, b) == pytest.approx(0, abs=1e-9)
        assert normalised_distance(a, tree(large, reach=1.2)) > 0.01
