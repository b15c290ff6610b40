"""Searching for primitives that fit a solid: guesses, overlaps, gradient ascent, and results."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS
from morphgen.fitting.quality import quality
from morphgen.fitting.search import (
    DIGITS,
    MIN_POINTS,
    Candidates,
    Cloud,
    around,
    ascend,
    best_several,
    best_single,
    by_growth,
    by_pieces,
    covered,
    overlaps,
    sample_solid,
)
from morphgen.fitting.solid import solid_of, solid_of_mesh
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere, dimensions

TILTED = Pose.from_xyz_rpy((0.1, -0.2, 0.3), (0.4, 0.7, -1.1))
PRIMITIVES = (Box((0.1, 0.2, 0.4)), Cylinder(0.06, 0.3), Sphere(0.1))
ANGLE = (
    Shape(Box((0.1, 0.1, 0.4)), Pose((0, 0, 0.2))),
    Shape(Box((0.3, 0.1, 0.1)), Pose((0.15, 0, 0.05))),
)


def target_of(*shapes, seed=0):
    return sample_solid(solid_of(shapes), seed)


def fitted(geometry, pose=TILTED, seed=0):
    """Return the best single primitive of a primitive, its score, and the solid."""
    target = target_of(Shape(geometry, pose), seed=seed)
    fit = best_single(target)
    (shape,), score = fit.shapes, fit.iou
    return shape, score, target.solid


def assert_well_formed(shape):
    """Assert positive rounded dimensions, a unit quaternion with w >= 0, and no colour."""
    pose = shape.T_link_shape
    sizes = dimensions(shape.geometry)
    assert min(sizes) > 0
    for value in (*sizes, *pose.position):
        assert type(value) is float
        assert round(value, DIGITS) == value
    assert np.linalg.norm(pose.quaternion) == pytest.approx(1.0, abs=1e-12)
    assert pose.quaternion[0] >= 0
    assert shape.rgba is None


@pytest.mark.slow
@pytest.mark.parametrize("geometry", PRIMITIVES, ids=lambda geometry: type(geometry).__name__)
def test_a_rotated_primitive_is_recovered(geometry):
    shape, score, solid = fitted(geometry)
    assert type(shape.geometry) is type(geometry)
    assert_well_formed(shape)
    found, true = sorted(dimensions(shape.geometry)), sorted(dimensions(geometry))
    np.testing.assert_allclose(found, true, rtol=0.02)
    np.testing.assert_allclose(shape.T_link_shape.position, TILTED.position, atol=2e-3)
    if isinstance(geometry, Cylinder):
        axes = (pose.matrix[:3, 2] for pose in (shape.T_link_shape, TILTED))
        assert abs(np.dot(*axes)) == pytest.approx(1.0, abs=1e-3)
    if isinstance(geometry, Sphere):
        assert shape.T_link_shape.quaternion == (1.0, 0.0, 0.0, 0.0)
    assert quality(solid, [shape]).iou > 0.97
    assert score == pytest.approx(quality(solid, [shape]).iou, abs=0.015)


@pytest.mark.parametrize("size", [0.01, 10.0])
def test_the_result_does_not_depend_on_size_or_position(size):
    box = Box((0.5 * size, 0.8 * size, size))
    far = Pose((3.0, -2.0, 1.0), TILTED.quaternion)
    shape, score, solid = fitted(box, far)
    assert isinstance(shape.geometry, Box)
    assert score > 0.97
    assert quality(solid, [shape]).iou > 0.97


@pytest.mark.parametrize("seed", [0, 1])
def test_a_thin_plate_is_recovered(seed):
    """Volume of a primitive outside the sampled region must count as an error."""
    shape, score, solid = fitted(Box((0.3, 0.2, 0.006)), Pose(), seed)
    iou = quality(solid, [shape]).iou
    assert score == pytest.approx(iou, abs=0.03)
    assert isinstance(shape.geometry, Box)
    assert iou > 0.9


def test_an_l_shape_is_fitted_by_two_boxes():
    target = target_of(*ANGLE)
    one = best_single(target)
    two = best_several(target, one, 0)
    shapes = two.shapes
    assert len(shapes) == 2
    for shape in shapes:
        assert isinstance(shape.geometry, Box)
        assert_well_formed(shape)
    iou = quality(target.solid, shapes).iou
    assert iou > 0.95
    assert two.iou == pytest.approx(iou, abs=0.015)
    assert one.iou < 0.8
    assert quality(target.solid, one.shapes).iou == pytest.approx(one.iou, abs=0.03)


@pytest.fixture
def threads():
    """Set torch's number of threads, until the test is over."""
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.slow
def test_the_same_seed_gives_the_same_shapes_with_any_number_of_threads(threads):
    found = []
    for n in (1, 3):
        threads(n)
        target = target_of(*ANGLE, seed=3)
        one = best_single(target)
        two = best_several(target, one, 3)
        found.append((one.shapes, one.iou, two.shapes, two.iou))
        assert torch.get_num_threads() == n
    assert found[0] == found[1]


def test_sample_points_cover_the_solid_and_its_surroundings():
    shape = Shape(Box((0.1, 0.2, 0.4)), Pose((1.0, 2.0, 3.0)))
    target = target_of(shape)
    size = math.hypot(0.1, 0.2, 0.4)
    np.testing.assert_allclose(target.centre, (1.0, 2.0, 3.0), atol=1e-9)
    placed = target.points * size + target.centre
    np.testing.assert_array_equal(target.inside, target.solid.contains(placed))
    assert (target.points.max(axis=0) > np.array((0.05, 0.1, 0.2)) / size + 0.1).all()
    assert (target.weights > 0).all()
    assert target.weights.mean() == pytest.approx(1.0)
    again = target_of(shape)
    np.testing.assert_array_equal(target.points, again.points)
    np.testing.assert_array_equal(target.weights, again.weights)
    assert not np.array_equal(target.points, target_of(shape, seed=1).points)


@pytest.mark.parametrize("count", [None, 4096])
def test_sample_weights_are_volumes(count):
    target = target_of(Shape(Box((0.1, 0.2, 0.4))))
    points, inside, weights = (
        array[:count] for array in (target.points, target.inside, target.weights)
    )
    for factor in (0.5, 1.0, 1.2, 1.5):
        half = np.array((0.05, 0.1, 0.2)) * factor / target.solid.size
        within = (np.abs(points) <= half).all(axis=1)
        ratio = weights[within].sum() / weights[inside].sum()
        assert ratio == pytest.approx(factor**3, rel=0.1 if count else 0.03)


def test_a_solid_that_fills_almost_none_of_its_bounds_is_an_error():
    frame = [trimesh.creation.box(np.roll((1.0, 0.001, 0.001), i)) for i in range(3)]
    with pytest.raises(FitError, match="too thin") as caught:
        sample_solid(solid_of_mesh(trimesh.util.concatenate(frame)), 0)
    assert "%" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(FitError, match="too thin"):
        target_of(Shape(Box((0.4, 0.4, 0.00002)), TILTED))


def test_initial_guesses_are_boxes_cylinders_and_optionally_a_sphere():
    R = TILTED.matrix[:3, :3]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)) * (0.4, 0.2, 0.1)
    points = points @ R.T + (0.1, 0.0, 0.2)
    quick = around(points, [np.eye(3)])
    thorough = around(points, [np.eye(3), R], sphere=True)
    box, cylinder, sphere = (KINDS.index(kind) for kind in ("box", "cylinder", "sphere"))
    assert np.bincount(quick.kinds[:, 0], minlength=3).tolist() == [2, 6, 0]
    counts = np.bincount(thorough.kinds[:, 0], minlength=3)
    assert (counts[box], counts[cylinder], counts[sphere]) == (3, 9, 1)
    for guesses in (quick, thorough):
        assert (guesses.halves > 0).all()
        assert guesses.centres.shape == guesses.halves.shape == (len(guesses.kinds), 1, 3)
        np.testing.assert_allclose(np.linalg.norm(guesses.quaternions, axis=-1), 1)
        np.testing.assert_allclose(guesses.centres - (0.1, 0, 0.2), 0, atol=0.02)


def test_the_guessed_sphere_matches_points_in_a_ball():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (20000, 3))
    guesses = around(points[np.linalg.norm(points, axis=1) < 0.3] + (1, 2, 3), [], sphere=True)
    sphere = int(np.flatnonzero(guesses.kinds[:, 0] == KINDS.index("sphere"))[0])
    assert guesses.halves[sphere, 0, 0] == pytest.approx(0.3, rel=0.02)
    np.testing.assert_allclose(guesses.centres[sphere, 0], (1, 2, 3), atol=0.01)


def test_pieces_give_three_reproducible_guesses_per_clustering():
    target = target_of(*ANGLE)
    first, second = (by_pieces(target, 2, [5, 6]) for _ in range(2))
    assert first is not None
    assert first.kinds.shape == (6, 2)
    assert (first.halves > 0).all()
    box, cylinder = KINDS.index("box"), KINDS.index("cylinder")
    assert first.kinds[1::3].tolist() == [[box, box]] * 2
    assert first.kinds[2::3].tolist() == [[cylinder, cylinder]] * 2
    for name in ("kinds", "centres", "quaternions", "halves"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert overlaps(first, target).max() > 0.6


def test_too_few_points_give_no_further_guess():
    target = target_of(Shape(Box((0.1, 0.2, 0.3))))
    few = replace(target, inside=target.inside & (np.cumsum(target.inside) < MIN_POINTS))
    assert by_pieces(few, 4, [0, 1, 2]) is None
    one = best_single(target)
    assert best_several(few, one, 0) is None
    some = target.take(target.inside & covered(one.candidate, target.points)[0])
    assert by_growth(one.candidate, some, 0) is None


@pytest.mark.slow
def test_an_added_primitive_starts_at_the_uncovered_part_of_the_solid():
    arms = [Shape(Box((0.5, 0.1, 0.1)), Pose((0.0, y, 0.0))) for y in (-0.4, 0.0, 0.4)]
    spine = Shape(Box((0.1, 0.9, 0.1)), Pose((-0.2, 0.0, 0.0)))
    target = target_of(spine, *arms)
    fit = best_single(target)
    for _ in range(3):
        fit = best_several(target, fit, 0)
    assert len(fit.shapes) == 4
    assert quality(target.solid, fit.shapes).iou > 0.93


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_thin_tilted_solids_are_sampled_and_fitted(seed):
    rod = Shape(Cylinder(0.005, 0.3), TILTED)
    plate = Shape(Box((0.3, 0.3, 0.006)), TILTED)
    for shape in (rod, plate):
        fit = best_single(target_of(shape, seed=seed))
        assert fit.iou > 0.85
        assert type(fit.shapes[0].geometry) is type(shape.geometry)


BOX, CYLINDER, SPHERE = map(KINDS.index, ("box", "cylinder", "sphere"))
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
TURNED = (0.8, 0.2, -0.4, 0.4)
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
@pytest.mark.parametrize("quaternion", [UPRIGHT, TURNED])
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


def test_the_overlap_of_concentric_primitives_is_their_volume_ratio():
    ball = within(SPHERE, GRID, (0.45,))
    scores = overlap(primitive(SPHERE, halves=(0.36, 1, 1)), GRID, ball)
    assert scores == pytest.approx(0.8**3, rel=0.02)
    can = within(CYLINDER, GRID, (0.4, 0.4, 0.4))
    scores = overlap(primitive(CYLINDER, halves=(0.3, 9.0, 0.2)), GRID, can)
    assert scores == pytest.approx((0.3 / 0.4) ** 2 / 2, rel=0.03)
    scores = overlap(primitive(CYLINDER, (0, 0, 0.1), halves=(0.4, 9.0, 0.4)), GRID, can)
    assert scores == pytest.approx(0.7 / 0.9, abs=1e-6)


def test_points_are_weighted():
    left = primitive(BOX, (-0.15, 0, 0), halves=(0.15, 0.2, 0.1))
    inside = within(BOX, GRID, HALVES)
    weights = np.where(GRID[:, 0] < 0, 3.0, 1.0)
    assert overlap(left, GRID, inside) == pytest.approx(1 / 2, abs=1e-6)
    assert overlap(left, GRID, inside, weights) == pytest.approx(3 / 4, abs=1e-6)
    assert overlap(left, GRID, inside, 7 * weights) == pytest.approx(3 / 4, abs=1e-6)
    outside = GRID[:, 0] < -0.1
    assert overlap(left, GRID, outside, (~outside).astype(float)).tolist() == [0.0]
    assert overlap(primitive(BOX, (9, 9, 9)), GRID, inside).tolist() == [0.0]
    assert overlap(primitive(BOX), GRID, np.zeros_like(inside)).tolist() == [0.0]


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


def test_overlapping_primitives_are_counted_once():
    halves = [primitive(BOX, (x, 0, 0), halves=(0.2, 0.2, 0.1)) for x in (-0.1, 0.1)]
    inside = within(BOX, GRID, HALVES)
    assert overlap(Candidates.join(halves), GRID, inside) == pytest.approx(1.0)
    assert overlap(Candidates.join([halves[0]] * 2), GRID, inside) == pytest.approx(2 / 3)


TRUE = (0.35, 0.25, 0.15)


@pytest.mark.parametrize(
    ("kind", "true", "quaternion", "begin"),
    [
        (BOX, TRUE, UPRIGHT, UPRIGHT),
        (BOX, TRUE, TURNED, TURNED),
        (BOX, TRUE, UPRIGHT, (1.0, 0.1, -0.05, 0.15)),
        (CYLINDER, (0.3, 0.3, 0.4), UPRIGHT, UPRIGHT),
        (SPHERE, (0.4,) * 3, UPRIGHT, UPRIGHT),
    ],
)
def test_ascent_recovers_a_shifted_shrunk_and_tilted_primitive(kind, true, quaternion, begin):
    inside = within(kind, turned(POINTS, quaternion), true)
    start = primitive(kind, (0.05, -0.04, 0.03), begin, tuple(0.75 * half for half in true))
    assert overlap(start, POINTS, inside)[0] < 0.55
    moved = climb(start, POINTS, inside)
    assert overlap(moved, GRID, within(kind, turned(GRID, quaternion), true))[0] > 0.97
    np.testing.assert_allclose(moved.centres[0, 0], 0, atol=0.01)
    assert moved.halves[0, 0, 0] == pytest.approx(true[0], abs=0.01)
    assert np.linalg.norm(moved.quaternions) == pytest.approx(1.0)


def test_ascent_of_several_candidates_with_several_primitives():
    left, right = (np.array((x, 0, 0)) for x in (-0.25, 0.25))
    inside = within(BOX, POINTS - left, (0.15, 0.3, 0.2)) | within(SPHERE, POINTS - right, (0.2,))
    box = primitive(BOX, (-0.2, 0.05, 0), halves=(0.12, 0.25, 0.15))
    ball = primitive(SPHERE, (0.2, -0.05, 0.05), halves=(0.15,) * 3)
    both_orders = [Candidates.join(pair) for pair in ([box, ball], [ball, box])]
    moved = climb(Candidates.stack(both_orders), POINTS, inside)
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
    inside = within(BOX, turned(POINTS, TURNED), TRUE)
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
    assert np.isfinite([*moved.centres[0, 0], *moved.quaternions[0, 0]]).all()
    assert (moved.halves > 0).all()
