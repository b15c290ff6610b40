"""Similarity measures, matrices, distances and maps."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import morphgen
from helpers.robots import arm
from morphgen.benchmark import similarity
from morphgen.benchmark.similarity import (
    MEASURES,
    Measure,
    classical_mds,
    cosine,
    features,
    get_measure,
    similarity_matrix,
    to_distances,
    tree_distance,
    workspace_overlap,
)
from morphgen.benchmark.tokens import pad_tokens, tokens
from morphgen.errors import BenchmarkError, RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.geometry import Mesh, Shape
from morphgen.progress import show_progress

REQUESTS = ("arm=lwr ee=plane", "arm=lwr ee=claw", "arm3", "chain beads=2", "cubes")


def featured(request, **options):
    robot = morphgen.compose(request)
    return features(robot, token_shapes(robot), **options)


@pytest.fixture(scope="module")
def some():
    return [featured(request) for request in REQUESTS]


def test_the_measures_are_named():
    assert tuple(MEASURES) == ("cosine", "tree", "workspace")
    assert [measure.larger_is_more_alike for measure in MEASURES.values()] == [True, False, True]
    assert all(name == measure.name for name, measure in MEASURES.items())


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
    flat = [
        pad_tokens(tokens(robot, token_shapes(robot)), 23)[0][:, :32].ravel() for robot in robots
    ]
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
    with pytest.raises(
        BenchmarkError, match=r"25 links, more than max_links 23; make max_links 25"
    ):
        featured("chain beads=7")
    long, short = (featured(f"chain beads={beads}", max_links=25) for beads in (7, 6))
    assert len(long.tokens) == 25
    assert long.tokens[-1, 0] == 1
    assert long.tokens[0, 1] == pytest.approx(-1 / 24)
    assert 0.8 < cosine(long, short) < 1
    np.testing.assert_allclose(long.tokens[:5, :2], short.tokens[:5, :2])


@pytest.mark.parametrize("name", MEASURES)
def test_a_matrix_is_symmetric_and_has_the_values_of_the_measure(some, name):
    values = similarity_matrix(some, name)
    function = MEASURES[name].function
    assert values.shape == (5, 5)
    np.testing.assert_array_equal(values, values.T)
    for i, j in itertools.product(range(5), repeat=2):
        assert values[i, j] == pytest.approx(function(some[i], some[j]), abs=1e-15)


def test_every_pair_is_compared_once(some, monkeypatch):
    asked = []

    def count(a, b):
        asked.append(frozenset((a.name, b.name)))
        return float(len(asked))

    monkeypatch.setattr(similarity, "MEASURES", {"count": Measure("count", count, True, "")})
    told = []
    with show_progress(lambda *now: told.append(now)):
        values = similarity_matrix(some, "count")
    assert len(asked) == len(set(asked)) == 15
    assert told == [(1, 15), (3, 15), (6, 15), (10, 15), (15, 15)]
    np.testing.assert_array_equal(values, values.T)
    assert similarity_matrix([], "count").shape == (0, 0)


def test_distances_are_zero_on_the_diagonal_and_grow_with_dissimilarity(some):
    for name in MEASURES:
        values = similarity_matrix(some, name)
        apart = to_distances(values, name)
        assert (apart >= 0).all()
        assert not apart.diagonal().any()
        order = np.argsort(values[0, 1:] * (-1 if MEASURES[name].larger_is_more_alike else 1))
        assert (np.diff(apart[0, 1:][order]) >= 0).all()


def test_an_unknown_measure_is_an_error_that_lists_the_valid_ones(some):
    for ask in (lambda: similarity_matrix(some, "cosin"), lambda: get_measure("cosin")):
        with pytest.raises(
            BenchmarkError, match=r"'cosin'; did you mean 'cosine'\? valid: cosine, tree, workspace"
        ):
            ask()


def test_robots_without_a_movable_tool_are_errors(tmp_path):
    robot = arm()
    with pytest.raises(BenchmarkError, match="no frame 'tool'"):
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
@settings(deadline=None)
def test_points_of_a_plane_keep_their_distances(points):
    embedding = classical_mds(apart(points))
    np.testing.assert_allclose(apart(embedding.points), apart(points), atol=1e-5)
    assert embedding.kept == pytest.approx(1)
    np.testing.assert_allclose(embedding.points.mean(axis=0), 0, atol=1e-5)


def test_the_first_axis_varies_most_and_its_farthest_point_is_on_the_right():
    embedding = classical_mds(apart(np.array([[0.0, 0.0], [0.0, 1.0], [0.0, 5.0], [0.5, 2.0]])))
    assert np.ptp(embedding.points[:, 0]) > np.ptp(embedding.points[:, 1])
    assert embedding.points[:, 0].argmax() == 2
    np.testing.assert_allclose(
        np.sort(embedding.points[:, 0])[-1], np.abs(embedding.points[:, 0]).max()
    )


def test_the_order_of_robots_only_reorders_the_points():
    points = np.random.default_rng(1).normal(size=(9, 4))
    shuffle = np.random.default_rng(2).permutation(9)
    found, other = classical_mds(apart(points)), classical_mds(apart(points[shuffle]))
    np.testing.assert_allclose(other.points, found.points[shuffle], atol=1e-9)


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


def test_the_distance_of_two_robots_is_exact():
    embedding = classical_mds([[0.0, 0.4], [0.4, 0.0]])
    np.testing.assert_allclose(embedding.points, [[0.2, 0.0], [-0.2, 0.0]], atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        np.zeros((2, 3)),
        np.zeros(4),
        np.zeros((0, 0)),
        [[0, 1], [2, 0]],
        [[0, -1], [-1, 0]],
        [[1, 1], [1, 0]],
        [[0, np.nan], [np.nan, 0]],
    ],
)
def test_invalid_distances_are_an_error(wrong):
    with pytest.raises(ValueError, match="distances"):
        classical_mds(wrong)
