"""The soft overlap of primitives and points: closed forms and gradient ascent."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import qmc

from morphgen.fitting.canonical import KINDS
from morphgen.fitting.search import Candidates, Cloud, ascend, overlaps

BOX, CYLINDER, SPHERE = map(KINDS.index, ("box", "cylinder", "sphere"))
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
TILTED = (0.8, 0.2, -0.4, 0.4)
HALVES = (0.3, 0.2, 0.1)
EDGE = (np.arange(40) + 0.5) / 40 - 0.5
GRID = np.stack(np.meshgrid(EDGE, EDGE, EDGE, indexing="ij"), axis=-1).reshape(-1, 3)
"""Middles of cells of 0.025 in the unit cube; boxes of whole cells are counted exactly."""
POINTS = qmc.Sobol(3, rng=np.random.default_rng(0)).random(2**11) - 0.5


def cloud(points, inside, weights=None):
    return Cloud(points, inside, np.ones(len(points)) if weights is None else weights)


def overlap(candidates, *sample):
    """Return the IoU of each candidate with points, inside or not, and perhaps their weights."""
    return overlaps(candidates, cloud(*sample))


def climb(start, *sample, num_steps=80):
    """Return the candidates after a gradient ascent with such points."""
    tau, rate = (0.03, 0.002), (0.01, 0.0005)
    return ascend(start, cloud(*sample), num_steps=num_steps, tau=tau, rate=rate)


def primitive(kind, centre=(0.0, 0.0, 0.0), quaternion=UPRIGHT, halves=HALVES):
    """Return candidates with one guess of one primitive."""
    arrays = (np.array(value, float)[None, None] for value in (centre, quaternion, halves))
    return Candidates(np.array([[kind]]), *arrays)


def turned(points, quaternion):
    """Return points in the frame of a unit quaternion."""
    w, *axis = quaternion
    return points - 2 * w * np.cross(axis, points) + 2 * np.cross(axis, np.cross(axis, points))


def within(kind, points, halves):
    """Return which points are in a primitive at the origin, from its definition."""
    x, y, z = np.abs(points).T
    if kind == BOX:
        return (x <= halves[0]) & (y <= halves[1]) & (z <= halves[2])
    if kind == CYLINDER:
        return (np.hypot(x, y) <= halves[0]) & (z <= halves[2])
    return np.linalg.norm(points, axis=1) <= halves[0]


def iou(first, second):
    return (first & second).sum() / (first | second).sum()


@pytest.mark.parametrize("scale", [1.0, 3.0])
@pytest.mark.parametrize("quaternion", [UPRIGHT, TILTED])
@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE])
def test_a_primitive_overlaps_itself_completely(kind, quaternion, scale):
    inside = within(kind, turned(GRID, quaternion), HALVES)
    assert inside.sum() > 400
    again = primitive(kind, quaternion=tuple(scale * q for q in quaternion))
    np.testing.assert_allclose(overlap(again, GRID, inside), [1.0], atol=1e-3)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("shift", [0.05, 0.1])
def test_the_overlap_of_shifted_boxes_matches_the_closed_form(axis, shift):
    inside = within(BOX, GRID, HALVES)
    centre = np.eye(3)[axis] * shift
    edge = 2 * HALVES[axis]
    expected = (edge - shift) / (edge + shift)
    assert overlap(primitive(BOX, centre), GRID, inside) == pytest.approx(expected, abs=1e-6)


def test_a_box_rotated_by_90_degrees_has_swapped_edges():
    inside = within(BOX, GRID, (0.2, 0.3, 0.1))
    quarter = (math.sqrt(0.5), 0, 0, math.sqrt(0.5))
    assert overlap(primitive(BOX, quaternion=quarter), GRID, inside) == pytest.approx(1.0)
    assert overlap(primitive(BOX), GRID, inside) == pytest.approx(0.04 / 0.08, abs=1e-6)


def test_the_overlap_of_concentric_primitives_is_their_volume_ratio():
    ball = within(SPHERE, GRID, (0.45,))
    scores = overlap(primitive(SPHERE, halves=(0.36, 1, 1)), GRID, ball)
    assert scores == pytest.approx(0.8**3, rel=0.02)
    can = within(CYLINDER, GRID, (0.4, 0.4, 0.4))
    scores = overlap(primitive(CYLINDER, halves=(0.3, 9.0, 0.2)), GRID, can)
    assert scores == pytest.approx((0.3 / 0.4) ** 2 / 2, rel=0.03)
    scores = overlap(primitive(CYLINDER, (0, 0, 0.1), halves=(0.4, 9.0, 0.4)), GRID, can)
    assert scores == pytest.approx(0.7 / 0.9, abs=1e-6)


def test_disjoint_primitives_and_empty_targets_have_zero_overlap():
    nothing = np.zeros(len(GRID), dtype=bool)
    assert overlap(primitive(BOX), GRID, nothing).tolist() == [0.0]
    assert overlap(primitive(BOX, (9, 9, 9)), GRID, nothing).tolist() == [0.0]
    assert overlap(primitive(BOX, (9, 9, 9)), GRID, ~nothing).tolist() == [0.0]


def test_points_are_weighted():
    left = primitive(BOX, (-0.15, 0, 0), halves=(0.15, 0.2, 0.1))
    inside = within(BOX, GRID, HALVES)
    weights = np.where(GRID[:, 0] < 0, 3.0, 1.0)
    assert overlap(left, GRID, inside) == pytest.approx(1 / 2, abs=1e-6)
    assert overlap(left, GRID, inside, weights) == pytest.approx(3 / 4, abs=1e-6)
    assert overlap(left, GRID, inside, 7 * weights) == pytest.approx(3 / 4, abs=1e-6)
    outside = GRID[:, 0] < -0.1
    assert overlap(left, GRID, outside, (~outside).astype(float)).tolist() == [0.0]


PARTS = (
    (BOX, (-0.3, 0.0, 0.0), (0.1, 0.2, 0.3)),
    (CYLINDER, (0.0, 0.1, 0.1), (0.15, 0.15, 0.2)),
    (SPHERE, (0.25, -0.1, 0.0), (0.2, 0.2, 0.2)),
)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_the_order_of_kinds_in_a_row_does_not_matter(order):
    union = np.zeros(len(GRID), dtype=bool)
    for kind, centre, halves in PARTS:
        union |= within(kind, GRID - np.array(centre), halves)
    rows = [primitive(kind, centre, halves=halves) for kind, centre, halves in PARTS]
    row = Candidates.join([rows[i] for i in order])
    assert row.kinds.tolist() == [list(order)]
    assert overlap(row, GRID, union) == pytest.approx(1.0, abs=1e-3)
    inside = within(BOX, GRID, HALVES)
    assert overlap(row, GRID, inside) == pytest.approx(iou(union, inside), abs=1e-3)


def test_candidates_of_different_kinds_are_independent():
    rows = [primitive(kind, centre, TILTED, halves) for kind, centre, halves in PARTS]
    inside = within(BOX, GRID, HALVES)
    alone = [overlap(row, GRID, inside)[0] for row in rows]
    assert len(set(alone)) == 3
    for order in ([0, 1, 2], [2, 0, 1, 1], [1, 2, 0]):
        stacked = Candidates.stack([rows[i] for i in order])
        np.testing.assert_array_equal(overlap(stacked, GRID, inside), [alone[i] for i in order])


def test_overlapping_primitives_are_counted_once():
    halves = [primitive(BOX, (x, 0, 0), halves=(0.2, 0.2, 0.1)) for x in (-0.1, 0.1)]
    inside = within(BOX, GRID, HALVES)
    assert overlap(Candidates.join(halves), GRID, inside) == pytest.approx(1.0)
    assert overlap(Candidates.join([halves[0]] * 2), GRID, inside) == pytest.approx(2 / 3)


def test_evaluation_in_batches_does_not_change_the_result():
    rng = np.random.default_rng(0)
    n = 200
    many = Candidates(
        rng.integers(0, 3, (n, 2)),
        rng.uniform(-0.3, 0.3, (n, 2, 3)),
        rng.normal(size=(n, 2, 4)),
        rng.uniform(0.05, 0.3, (n, 2, 3)),
    )
    inside = within(BOX, POINTS, HALVES)
    together = overlap(many, POINTS, inside)
    assert together.shape == (n,)
    for i in (0, 11, 12, n - 1):
        np.testing.assert_allclose(
            overlap(many.take(np.array([i])), POINTS, inside), together[i : i + 1]
        )


TRUE = (0.35, 0.25, 0.15)


@pytest.mark.parametrize(
    ("quaternion", "begin"),
    [(UPRIGHT, UPRIGHT), (TILTED, TILTED), (UPRIGHT, (1.0, 0.1, -0.05, 0.15))],
)
def test_ascent_recovers_a_shifted_shrunk_and_tilted_box(quaternion, begin):
    inside = within(BOX, turned(POINTS, quaternion), TRUE)
    halves = tuple(0.8 * half for half in TRUE)
    start = primitive(BOX, (0.05, -0.04, 0.03), begin, halves)
    assert overlap(start, POINTS, inside)[0] < 0.55
    moved = climb(start, POINTS, inside)
    assert overlap(moved, GRID, within(BOX, turned(GRID, quaternion), TRUE))[0] > 0.97
    np.testing.assert_allclose(moved.centres[0, 0], 0, atol=0.01)
    np.testing.assert_allclose(moved.halves[0, 0], TRUE, atol=0.01)
    assert np.linalg.norm(moved.quaternions) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("kind", "true", "start"),
    [(CYLINDER, (0.3, 0.3, 0.4), (0.2, 0.2, 0.3)), (SPHERE, (0.4,) * 3, (0.25,) * 3)],
)
def test_ascent_recovers_cylinders_and_spheres(kind, true, start):
    inside = within(kind, POINTS, true)
    moved = climb(primitive(kind, (0.05, 0.05, -0.05), halves=start), POINTS, inside)
    assert overlap(moved, GRID, within(kind, GRID, true))[0] > 0.97
    assert moved.halves[0, 0, 0] == pytest.approx(true[0], abs=0.01)


def test_ascent_of_several_candidates_with_several_primitives():
    left, right = (np.array((x, 0, 0)) for x in (-0.25, 0.25))
    inside = within(BOX, POINTS - left, (0.15, 0.3, 0.2)) | within(SPHERE, POINTS - right, (0.2,))
    pair = Candidates.join(
        [
            primitive(BOX, (-0.2, 0.05, 0), halves=(0.12, 0.25, 0.15)),
            primitive(SPHERE, (0.2, -0.05, 0.05), halves=(0.15,) * 3),
        ]
    )
    swapped = Candidates(
        pair.kinds[:, ::-1], pair.centres[:, ::-1], pair.quaternions[:, ::-1], pair.halves[:, ::-1]
    )
    moved = climb(Candidates.stack([pair, swapped]), POINTS, inside)
    fresh = within(BOX, GRID - left, (0.15, 0.3, 0.2)) | within(SPHERE, GRID - right, (0.2,))
    assert overlap(moved, GRID, fresh).min() > 0.96
    assert moved.kinds.tolist() == [[BOX, SPHERE], [SPHERE, BOX]]
    np.testing.assert_allclose(moved.centres[0], moved.centres[1, ::-1], atol=1e-3)


def test_points_with_zero_weight_are_ignored():
    """The solid is two boxes; a candidate covers both, or the one with nonzero weights."""
    halves = (0.125, 0.3, 0.2)
    boxes = [within(BOX, POINTS - np.array((x, 0, 0)), halves) for x in (-0.25, 0.25)]
    starts = [primitive(BOX, (x, 0, 0), halves=(0.2, 0.2, 0.15)) for x in (-0.05, 0.05, 0.0)]
    care = np.stack([~boxes[1], ~boxes[0], np.ones(len(POINTS), bool)]).astype(float)
    solid = boxes[0] | boxes[1]
    moved = climb(Candidates.stack(starts), POINTS, solid, care)
    np.testing.assert_allclose(moved.centres[:, 0, 0], (-0.25, 0.25, 0), atol=0.01)
    np.testing.assert_allclose(moved.halves[:, 0, 0], (0.125, 0.125, 0.375), atol=0.01)
    np.testing.assert_allclose(moved.halves[:, 0, 1:], [halves[1:]] * 3, atol=0.01)
    plain = climb(Candidates.stack(starts), POINTS, solid)
    np.testing.assert_allclose(plain.halves[:, 0, 0], 0.375, atol=0.01)


def test_ascent_is_deterministic_and_does_not_modify_its_start():
    inside = within(BOX, turned(POINTS, TILTED), TRUE)
    start = Candidates.stack([primitive(kind, (0.02, 0, 0)) for kind in (SPHERE, BOX, CYLINDER)])
    before = [array.copy() for array in (start.centres, start.quaternions, start.halves)]
    first, second = (climb(start, POINTS, inside) for _ in range(2))
    for name, was in zip(("centres", "quaternions", "halves"), before, strict=True):
        np.testing.assert_array_equal(getattr(start, name), was)
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
        assert not np.array_equal(getattr(first, name), was)
    np.testing.assert_array_equal(first.kinds, start.kinds)


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE])
def test_a_point_at_the_centre_has_finite_gradients(kind):
    points = np.concatenate([np.zeros((1, 3)), POINTS[:500]])
    moved = climb(primitive(kind), points, within(BOX, points, TRUE), num_steps=5)
    assert all(
        np.isfinite(array).all() for array in (moved.centres, moved.quaternions, moved.halves)
    )
    assert (moved.halves > 0).all()
