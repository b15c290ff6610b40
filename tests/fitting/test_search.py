"""Searching for primitives that fit a solid, and the initial guesses of the search."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS
from morphgen.fitting.quality import quality
from morphgen.fitting.search import (
    DIGITS,
    MIN_POINTS,
    Cloud,
    around,
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
    assert quality(solid, [shape]).iou > 0.97
    assert score == pytest.approx(quality(solid, [shape]).iou, abs=0.015)


@pytest.mark.slow
def test_the_axis_of_a_cylinder_is_recovered():
    shape, _, _ = fitted(Cylinder(0.06, 0.3), seed=1)
    found, true = (pose.matrix[:3, 2] for pose in (shape.T_link_shape, TILTED))
    assert abs(found @ true) == pytest.approx(1.0, abs=1e-3)


def test_a_sphere_has_no_rotation():
    shape, _, _ = fitted(Sphere(0.1))
    assert shape.T_link_shape.quaternion == (1.0, 0.0, 0.0, 0.0)


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


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_strut_is_recovered_in_any_orientation(seed):
    shape, _, solid = fitted(Cylinder(0.02, 0.5), TILTED, seed)
    assert quality(solid, [shape]).iou > 0.9


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


@pytest.mark.slow
def test_a_cylinder_and_a_box_are_recovered_together():
    parts = (Shape(Cylinder(0.05, 0.3)), Shape(Box((0.4, 0.2, 0.06)), Pose((0, 0, 0.18))))
    target = target_of(*parts)
    shapes = best_several(target, best_single(target), 0).shapes
    assert sorted(type(shape.geometry).__name__ for shape in shapes) == ["Box", "Cylinder"]
    assert quality(target.solid, shapes).iou > 0.95


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


@pytest.mark.slow
def test_another_seed_gives_nearly_the_same_shape():
    first, second = (fitted(Box((0.1, 0.2, 0.4)), seed=seed)[0] for seed in (0, 1))
    assert first != second
    np.testing.assert_allclose(
        sorted(dimensions(first.geometry)), sorted(dimensions(second.geometry)), rtol=0.02
    )


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
    """This includes the first points alone, because the points are shuffled."""
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
    frame = [
        trimesh.creation.box((0.001, 0.001, 1.0)),
        trimesh.creation.box((0.001, 1.0, 0.001)),
        trimesh.creation.box((1.0, 0.001, 0.001)),
    ]
    with pytest.raises(FitError, match="too thin") as caught:
        sample_solid(solid_of_mesh(trimesh.util.concatenate(frame)), 0)
    assert "%" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(FitError, match="too thin"):
        target_of(Shape(Box((0.4, 0.4, 0.00002)), TILTED))


def cloud(n=2000):
    """Return points in a rotated box with edges 0.4, 0.2, 0.1 [m], and its rotation matrix."""
    R = TILTED.matrix[:3, :3]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (n, 3)) * (0.4, 0.2, 0.1)
    return points @ R.T + (0.1, 0.0, 0.2), R


def test_initial_guesses_are_boxes_cylinders_and_optionally_a_sphere():
    points, _ = cloud()
    quick = around(points, [np.eye(3)])
    thorough = around(points, [np.eye(3), TILTED.matrix[:3, :3]], sphere=True)
    box, cylinder, sphere = (KINDS.index(kind) for kind in ("box", "cylinder", "sphere"))
    assert np.bincount(quick.kinds[:, 0], minlength=3).tolist() == [2, 6, 0]
    counts = np.bincount(thorough.kinds[:, 0], minlength=3)
    assert (counts[box], counts[cylinder], counts[sphere]) == (3, 9, 1)
    for guesses in (quick, thorough):
        assert (guesses.halves > 0).all()
        assert guesses.centres.shape == guesses.halves.shape == (len(guesses.kinds), 1, 3)
        np.testing.assert_allclose(np.linalg.norm(guesses.quaternions, axis=-1), 1)
        np.testing.assert_allclose(
            guesses.centres, np.broadcast_to((0.1, 0, 0.2), guesses.centres.shape), atol=0.02
        )


def test_one_initial_guess_is_near_the_true_primitive():
    points, R = cloud()
    surroundings = np.random.default_rng(1).uniform(-0.4, 0.4, (8000, 3))
    surroundings += (0.1, 0.0, 0.2)
    local = np.abs((surroundings - (0.1, 0.0, 0.2)) @ R)
    inside = (local <= np.array((0.2, 0.1, 0.05))).all(axis=1)
    sample = Cloud(surroundings, inside, np.ones(len(inside)))
    assert overlaps(around(points, [np.eye(3)]), sample).max() > 0.8


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
    scores = overlaps(first, target)
    assert scores.max() > 0.6


def test_a_solid_with_few_points_is_not_split():
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))
    few = np.arange(500) < 3 * MIN_POINTS
    assert by_pieces(Cloud(points, few, np.ones(500)), 4, [0, 1, 2]) is None


def test_too_few_points_give_no_further_primitives():
    target = target_of(Shape(Cylinder(0.02, 0.5), TILTED))
    one = best_single(target)
    few = replace(target, inside=target.inside & (np.cumsum(target.inside) < MIN_POINTS))
    assert best_several(few, one, 0) is None


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


def test_a_fully_covered_solid_gives_no_further_guess():
    target = target_of(Shape(Box((0.1, 0.2, 0.3))))
    one = best_single(target)
    some = target.take(target.inside & covered(one.candidate, target.points)[0])
    assert by_growth(one.candidate, some, 0) is None


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_thin_tilted_solids_are_sampled_and_fitted(seed):
    rod = Shape(Cylinder(0.005, 0.3), TILTED)
    plate = Shape(Box((0.3, 0.3, 0.006)), TILTED)
    for shape in (rod, plate):
        fit = best_single(target_of(shape, seed=seed))
        assert fit.iou > 0.85
        assert type(fit.shapes[0].geometry) is type(shape.geometry)
