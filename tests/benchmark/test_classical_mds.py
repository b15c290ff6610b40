"""Classical multidimensional scaling recovers planar points and reports its share."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from morphgen.benchmark.similarity import classical_mds

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
