"""Searching for primitives that fit a solid: what is found, its score, and the sampled points."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS
from morphgen.fitting.quality import quality
from morphgen.fitting.search import (
    DIGITS,
    MIN_POINTS,
    Candidates,
    Cloud,
    Round,
    ascend,
    best_several,
    best_single,
    by_growth,
    by_pieces,
    covered,
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


@pytest.mark.parametrize("size", [0.01, pytest.param(10.0, marks=pytest.mark.slow)])
def test_the_result_does_not_depend_on_size_or_position(size):
    box = Box((0.5 * size, 0.8 * size, size))
    far = Pose((3.0, -2.0, 1.0), TILTED.quaternion)
    shape, score, solid = fitted(box, far)
    assert isinstance(shape.geometry, Box)
    assert score > 0.97
    assert quality(solid, [shape]).iou > 0.97


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
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


FIT = """
import sys
from morphgen.fitting.link_fit import FitOptions, fit_shapes
from morphgen.model.geometry import Box, Pose, Shape
bar, foot = (Shape(Box(size)) for size in ((0.1, 0.1, 0.4), (0.3, 0.1, 0.12)))
print(fit_shapes([bar, foot], FitOptions(max_primitives=1, seed=3)).primitives)
assert "torch" not in sys.modules  # whose import takes longer than the fit
"""


def test_the_same_seed_gives_the_same_shapes_with_any_number_of_threads():
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    found = [
        subprocess.run(
            [sys.executable, "-c", FIT],
            env={**os.environ, **dict.fromkeys(names, threads)},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for threads in ("1", "3")
    ]
    assert "Shape" in found[0]
    assert found[0] == found[1]


def test_a_solid_that_fills_almost_none_of_its_bounds_is_an_error():
    frame = [trimesh.creation.box(np.roll((1.0, 0.001, 0.001), i)) for i in range(3)]
    with pytest.raises(FitError, match="too thin") as caught:
        sample_solid(solid_of_mesh(trimesh.util.concatenate(frame)), 0)
    assert "%" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(FitError, match="too thin"):
        target_of(Shape(Box((0.4, 0.4, 0.00002)), TILTED))


def test_too_few_points_give_no_further_guess():
    target = target_of(Shape(Box((0.1, 0.2, 0.3))))
    few = replace(target, inside=target.inside & (np.cumsum(target.inside) < MIN_POINTS))
    assert by_pieces(few, 4, [0, 1, 2]) is None
    one = best_single(target)
    assert best_several(few, one, 0) is None
    some = target.take(target.inside & covered(one.candidate, target.points)[0])
    assert by_growth(one.candidate, some, 0) is None


@pytest.mark.parametrize("kind", range(len(KINDS)))
def test_a_point_at_the_centre_has_finite_gradients(kind):
    points = np.vstack([np.zeros((1, 3)), np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))])
    cloud = Cloud(points, (np.abs(points) < 0.2).all(axis=1), np.ones(len(points)))
    arrays = (np.array(each)[None, None] for each in ((0.0,) * 3, (1.0, 0, 0, 0), (0.3, 0.2, 0.1)))
    start = Candidates(np.array([[kind]]), *arrays)
    moved = ascend(start, cloud, Round(None, 501, 5, (0.03, 0.002), (0.01, 0.0005)))
    assert np.isfinite([*moved.centres[0, 0], *moved.quaternions[0, 0]]).all()
    assert (moved.halves > 0).all()
