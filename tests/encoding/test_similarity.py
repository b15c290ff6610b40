"""Similarity measures, workspaces relative to the shoulder, matrices, distances and maps."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import morphgen
from helpers.robots import arm
from morphgen.encoding.similarity import (
    MEASURES,
    classical_mds,
    cosine,
    density_overlap,
    features,
    shoulder,
    similarity_matrix,
    to_distances,
    tree_distance,
    workspace,
    workspace_overlap,
)
from morphgen.encoding.tokens import pad_tokens, tokens
from morphgen.errors import BenchmarkError, RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.geometry import Mesh, Pose, Shape
from morphgen.model.kinematics import reach
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.model.tree import scale_links
from morphgen.progress import show_progress

REQUESTS = ("arm=lwr ee=plane", "arm=lwr ee=claw", "arm3", "chain beads=2", "cubes")


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


def test_the_cosine_uses_flattened_padded_tokens_without_q():
    robots = [morphgen.compose(request) for request in REQUESTS[:3]]
    tables = [tokens(robot, token_shapes(robot)) for robot in robots]
    flat = [pad_tokens(table, 23)[0][:, :32].ravel() for table in tables]
    for (a, u), (b, v) in itertools.combinations(zip(robots, flat, strict=True), 2):
        expected = u @ v / np.sqrt((u @ u) * (v @ v))
        similarity = cosine(features(a, token_shapes(a)), features(b, token_shapes(b)))
        assert similarity == pytest.approx(expected, abs=1e-12)


def test_home_changes_the_tree_but_not_the_cosine():
    robot = arm()
    shapes = {link.name: link.collisions[0] for link in robot.links}
    bent = replace(robot, home=(1.4, 0.5, 0.01, 0.02))
    a, b = features(robot, shapes), features(bent, shapes)
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


def test_distances_are_zero_on_the_diagonal_and_grow_with_dissimilarity(some):
    for name in MEASURES:
        values = similarity_matrix(some, name)
        apart = to_distances(values, name)
        assert (apart >= 0).all()
        assert not apart.diagonal().any()
        order = np.argsort(values[0, 1:] * (-1 if MEASURES[name].larger_is_more_alike else 1))
        assert (np.diff(apart[0, 1:][order]) >= 0).all()


def test_an_unknown_measure_is_an_error_that_lists_the_valid_ones(some):
    message = r"'cosin'; did you mean 'cosine'\? valid: cosine, tree, workspace"
    with pytest.raises(BenchmarkError, match=message):
        similarity_matrix(some, "cosin")


def test_robots_without_a_movable_tool_are_errors(tmp_path):
    robot = arm()
    with pytest.raises(BenchmarkError, match=r"'arm' has no frame 'tool'.*import FILE --tool LINK"):
        features(replace(robot, frames=()), {})
    with pytest.raises(BenchmarkError, match="unknown link"):
        features(robot, {"nowhere": robot.links[0].collisions[0]})
    with pytest.raises(BenchmarkError, match="a mesh has no token"):
        features(robot, {"base": Shape(Mesh(tmp_path / "a.stl"))})
    flat = replace(robot.joints[0], axis=(0.0, 0.0, 0.0))
    with pytest.raises(RobotError, match="is zero"):
        features(replace(robot, joints=(flat, *robot.joints[1:])), {})


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


def test_the_share_of_the_variation_excludes_further_dimensions():
    box = np.array([[x, y, z] for x in (0, 3) for y in (0, 2) for z in (0, 1)], dtype=float)
    embedding = classical_mds(apart(box))
    assert embedding.kept == pytest.approx((9 + 4) / (9 + 4 + 1))


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


WRONG_VALUES = ([0, 1, 2, 0], [0, -1, -1, 0], [1, 1, 1, 0], [0, np.nan, np.nan, 0])


@pytest.mark.parametrize(
    "wrong",
    [*map(np.zeros, ((2, 3), 4, (0, 0))), *(np.reshape(each, (2, 2)) for each in WRONG_VALUES)],
)
def test_invalid_distances_are_an_error(wrong):
    with pytest.raises(ValueError, match="distances"):
        classical_mds(wrong)


LWR = "arm=lwr ee=plane"


def chain(*joints, tool=(0.0, 0.0, 0.5)):
    """A chain of joints (kind, origin, axis) with a tool."""
    made = [
        Joint(f"j{k}", kind, f"l{k}", f"l{k + 1}", Pose(origin), axis, limits=(-1.0, 1.0))
        for k, (kind, origin, axis) in enumerate(joints)
    ]
    links = tuple(Link(f"l{k}") for k in range(len(made) + 1))
    home = (0.0,) * sum(joint.is_movable for joint in made)
    return Robot("chain", links, tuple(made), (Frame("tool", links[-1].name, Pose(tool)),), home)


def test_the_density_is_normalized_and_reproducible():
    found, again = workspace(arm()), workspace(arm())
    assert found.density.shape == (21, 21, 21)
    assert found.density.sum() == pytest.approx(1)
    assert (found.density >= 0).all()
    np.testing.assert_array_equal(found.density, again.density)
    assert density_overlap(found, again) == pytest.approx(1, abs=1e-12)


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
    large = scale_links(robot, {link.name: factor for link in robot.links})
    assert workspace(large).reach == pytest.approx(factor * workspace(robot).reach)
    assert density_overlap(workspace(robot), workspace(large)) == pytest.approx(1, abs=1e-9)


def test_the_pedestal_does_not_matter():
    robot = workspace(morphgen.compose(LWR))
    raised = workspace(morphgen.compose(f"base=pedestal {LWR}"))
    assert raised.shoulder[2] > robot.shoulder[2] + 0.1
    assert density_overlap(robot, raised) == pytest.approx(1, abs=1e-9)


def test_the_origin_of_a_joint_on_its_axis_does_not_matter():
    robot = morphgen.compose(LWR)
    first = next(k for k in robot.independent_joints)
    child = robot.joints[first].child
    down = Pose(tuple(-0.1 * value for value in robot.joints[first].unit_axis))
    up = down.inverse()
    joints = [
        replace(joint, T_parent_joint=up @ joint.T_parent_joint) if joint.parent == child else joint
        for joint in robot.joints
    ]
    joints[first] = replace(joints[first], T_parent_joint=joints[first].T_parent_joint @ down)
    moved = replace(robot, joints=tuple(joints))
    assert reach(moved) == pytest.approx(reach(robot))
    assert shoulder(moved) == pytest.approx(shoulder(robot))
    assert density_overlap(workspace(moved), workspace(robot)) == pytest.approx(1, abs=1e-9)


def test_the_shoulder_is_the_intersection_of_the_first_two_axes():
    turn = ("revolute", (0.3, 0, 0.1), (0, 0, 1))
    lift = ("revolute", (0.1, 0, 0.4), (0, 1, 0))
    assert shoulder(chain(turn, lift)) == pytest.approx((0.3, 0, 0.5))
    again = ("revolute", (0.2, 0, 0.2), (0, 0, 1))
    assert shoulder(chain(turn, again, lift)) == pytest.approx((0.3, 0, 0.7))
    turn = ("revolute", (0, 0, 0.1), (0, 0, 1))
    oblique = ("revolute", (0.1, 0.8, 0.9), (0, 0.8, 0.6))
    assert shoulder(chain(turn, oblique)) == pytest.approx((0, 0, 0.4))


def test_the_shoulder_of_a_planar_arm_is_in_its_plane():
    turn = ("revolute", (0.3, 0, 0.1), (0, 0, 1))
    assert shoulder(chain(turn, turn, tool=(0.5, 0, 0.4))) == pytest.approx((0.3, 0, 0.6))


def test_the_shoulder_of_prismatic_robots_is_the_middle_of_their_travel():
    slide = ("prismatic", (0.3, 0, 0), (1, 0, 0))
    far = replace(chain(slide, tool=(0, 0, 0)).joints[0], limits=(0.0, 3.0))
    robot = replace(chain(slide, tool=(0, 0, 0)), joints=(far,))
    result = workspace(robot)
    assert result.shoulder == pytest.approx((1.8, 0, 0))
    assert result.reach == pytest.approx(1.5, rel=1e-3)


def test_the_samples_of_an_arm_do_not_depend_on_its_gripper():
    robot = arm()
    links = (robot.root, Link("flap"), *robot.links[1:])
    flap = Joint("flap", "revolute", "base", "flap", limits=(-1.0, 1.0))
    home = (0.0, *robot.home)
    other = replace(robot, links=links, joints=(flap, *robot.joints), home=home)
    assert density_overlap(workspace(robot), workspace(other)) == pytest.approx(1, abs=1e-5)


def test_an_immobile_tool_is_an_error():
    with pytest.raises(BenchmarkError, match="no joint moves its tool, which is on link 'base'"):
        workspace(replace(arm(), frames=(Frame("tool", "base"),)))
    with pytest.raises(BenchmarkError, match="only turns about its own origin"):
        workspace(chain(("revolute", (0, 0, 1), (0, 0, 1))))


@pytest.mark.parametrize("limits", [(0.0, np.inf), (1.0, -1.0), (np.nan, 1.0)])
def test_limits_without_a_range_are_an_error(limits):
    robot = arm()
    joint = replace(robot.joints[1], limits=limits)
    wrong = replace(robot, joints=(robot.joints[0], joint, *robot.joints[2:]))
    with pytest.raises(BenchmarkError, match=r"joint 'elbow': limits .* morphgen check"):
        workspace(wrong)
