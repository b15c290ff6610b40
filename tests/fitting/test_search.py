"""Search for primitives: boxes, cylinders, spheres, their quality."""

import math
import os
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.integrate import dblquad

from helpers.commands import run_python
from helpers.robots import arm
from morphgen.errors import FitError
from morphgen.fitting import search
from morphgen.fitting.link_fit import FitOptions, fit_shapes, quality, signed_distance
from morphgen.fitting.replace_collision import fit_robot
from morphgen.fitting.solid import solid_of, solid_of_mesh
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.geometry import (
    IDENTITY,
    Box,
    Capsule,
    Cylinder,
    Mesh,
    Pose,
    Shape,
    Sphere,
    dimensions,
)

TILTED = Pose.from_xyz_rpy((0.1, -0.2, 0.3), (0.4, 0.7, -1.1))
PRIMITIVES = (Box((0.1, 0.2, 0.4)), Cylinder(0.06, 0.3), Sphere(0.1))
ANGLE = (
    Shape(Box((0.1, 0.1, 0.4)), Pose((0, 0, 0.2))),
    Shape(Box((0.3, 0.1, 0.1)), Pose((0.15, 0, 0.05))),
)


def target_of(*shapes, seed=0):
    return search.sample_solid(solid_of(shapes), seed)


def fitted(geometry, pose=TILTED, seed=0):
    """Return the best single primitive of a primitive, its score, and the solid."""
    target = target_of(Shape(geometry, pose), seed=seed)
    fit = search.best_single(target)
    (shape,), score = fit.shapes, fit.iou
    return shape, score, target.solid


def assert_well_formed(shape):
    """Assert positive rounded dimensions, a unit quaternion with w >= 0, and no colour."""
    pose = shape.T_link_shape
    sizes = dimensions(shape.geometry)
    assert min(sizes) > 0
    for value in (*sizes, *pose.position):
        assert type(value) is float
        assert round(value, search.DIGITS) == value
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
    one = search.best_single(target)
    two = search.best_several(target, one, 0)
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
        run_python(FIT, env={**os.environ, **dict.fromkeys(names, threads)}).stdout
        for threads in ("1", "3")
    ]
    assert "Shape" in found[0]
    assert found[0] == found[1]


def test_a_solid_that_fills_almost_none_of_its_bounds_is_an_error():
    frame = [trimesh.creation.box(np.roll((1.0, 0.001, 0.001), i)) for i in range(3)]
    with pytest.raises(FitError, match="too thin") as caught:
        search.sample_solid(solid_of_mesh(trimesh.util.concatenate(frame)), 0)
    assert "%" in str(caught.value)
    assert "\n" not in str(caught.value)
    with pytest.raises(FitError, match="too thin"):
        target_of(Shape(Box((0.4, 0.4, 0.00002)), TILTED))


BALLS = ((0.1, 0.0, 0.0, 0.05), (-0.02, 0.03, 0.0, 0.07), (0.0, -0.04, 0.1, 0.04))
BOX = (0.3, 0.1, 0.08)
BEST_GRID = 2.01  # volume ratio of eight equal balls on the best grid that cover the box


def spheres_of(shapes):
    """Centres and radii, shape (n, 4), sorted by x."""
    rows = [(*shape.T_link_shape.position, shape.geometry.radius) for shape in shapes]
    return np.array(sorted(rows))


def covered_by(spheres, points):
    """Which points are in any sphere, by brute force."""
    distance = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2)
    return (distance <= spheres[:, 3]).any(axis=1)


def volume_of(spheres, rng):
    """Volume of the union, by counting random points."""
    low, high = (spheres[:, :3] - spheres[:, 3:]).min(0), (spheres[:, :3] + spheres[:, 3:]).max(0)
    return covered_by(spheres, rng.uniform(low, high, (200_000, 3))).mean() * np.prod(high - low)


def test_balls_are_found_again():
    shapes = [Shape(Sphere(r), Pose((x, y, z))) for x, y, z, r in BALLS]
    found = search.best_spheres(search.sample_solid(solid_of(shapes), 0), len(BALLS), None, 0)
    assert found.iou > 0.97
    np.testing.assert_allclose(spheres_of(found.shapes), sorted(BALLS), atol=1.5e-3)


@pytest.mark.parametrize("share", [pytest.param(0.98, marks=pytest.mark.slow), 0.995])
def test_spheres_cover_the_share_of_a_box_that_they_must(share):
    fit = fit_shapes([Shape(Box(BOX))], FitOptions(spheres=8, cover=share))
    spheres = spheres_of(fit.primitives)
    assert len(spheres) == 8
    rng = np.random.default_rng(5)
    inside = covered_by(spheres, rng.uniform(-0.5, 0.5, (200_000, 3)) * BOX).mean()
    assert share - 1e-3 < inside < share + (1 - share) / 2
    volume_ratio = volume_of(spheres, rng) / np.prod(BOX)
    assert volume_ratio < 0.9 * BEST_GRID
    assert volume_ratio == pytest.approx(fit.quality.volume_ratio, rel=0.01)
    assert inside == pytest.approx(fit.quality.coverage, abs=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spheres": 0}, "0 spheres: expected 1 to 32"),
        ({"spheres": 4, "max_primitives": 2}, "takes no max_primitives"),
        ({"cover": 0.9}, "cover 0.9: expected a number of spheres"),
        ({"spheres": 4, "cover": 1.0}, "cover 1: expected more than 0, at most 0.9999"),
        ({"spheres": 4, "cover": float("nan")}, "cover nan"),
        ({"max_primitives": 0}, "0 primitives: expected 1 to 32"),
        ({"iou": 1.5}, "IoU 1.5"),
        ({"seed": -1}, "seed -1"),
    ],
)
def test_invalid_options_are_refused(options, message):
    with pytest.raises(FitError, match=message):
        FitOptions(**options)


def test_robots_get_spheres_and_keep_everything_else(tmp_path):
    """A robot of a mesh in millimetres, a rod and a link without shapes."""
    trimesh.creation.box((100.0, 100.0, 40.0)).export(tmp_path / "block.stl")
    block = Shape(Mesh(tmp_path / "block.stl", (1e-3, 1e-3, 1e-3)))
    base, upper, lower, *_ = arm().links
    links = (replace(base, collisions=(block,)), upper, replace(lower, collisions=()))
    meshed = replace(arm(), links=links, joints=arm().joints[:2], frames=(), home=(0.4, 0.5))
    robot = fit_robot(meshed, FitOptions(spheres=3, cover=0.9)).robot
    assert [len(link.collisions) for link in robot.links] == [3, 3, 0]
    for before, after in zip(meshed.links, robot.links, strict=True):
        assert after.inertial.mass == pytest.approx(before.inertial.mass)
        assert len(after.visuals) == len(before.visuals)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3)) * (0.1, 0.1, 0.04)
    assert 0.89 < covered_by(spheres_of(robot.root.collisions), points).mean() < 0.96
    assert fit_robot(robot, FitOptions(spheres=5)).robot.links == robot.links  # they keep spheres
    assert token_shapes(robot) == token_shapes(meshed)


BLOCK = Shape(Box((0.4, 0.2, 0.1)))
UNIT_CUBE = Shape(Box((0.2, 0.2, 0.2)))
TILTED_POSE = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.4, -1.1, 2.0))
DISTANCES = ("protrusion_mean", "protrusion_p95", "gap_mean", "gap_p95", "hausdorff")
SHARES = ("iou", "coverage", "volume_ratio")


def at(x, y=0.0, z=0.0):
    return Pose((x, y, z))


def box(size, pose=IDENTITY):
    return Shape(Box(size), pose)


@pytest.mark.parametrize(
    ("geometry", "point", "expected"),
    [
        (Box((2, 4, 6)), (0, 0, 0), -1),
        (Box((2, 4, 6)), (0.5, 1.9, 0), -0.1),
        (Box((2, 4, 6)), (4, 6, 0), 5),
        (Sphere(2), (0, 3, 4), 3),
        (Sphere(2), (0, 0, 0.5), -1.5),
        (Cylinder(1, 6), (0.6, 0.8, 2), 0),
        (Cylinder(1, 6), (0, 0, 2.5), -0.5),
        (Cylinder(1, 6), (4, 0, -7), 5),
        (Capsule(1, 6), (0, 0, 3.5), -0.5),
        (Capsule(1, 6), (0.25, 0, 1), -0.75),
        (Capsule(1, 6), (3, 0, 7), 4),
    ],
)
@pytest.mark.parametrize("pose", [Pose(), TILTED_POSE])
def test_signed_distances_of_one_primitive_are_exact(geometry, point, expected, pose):
    distances = signed_distance([Shape(geometry, pose)], np.array([pose.apply(point)]))
    assert distances == pytest.approx([expected], abs=1e-12)


def test_the_signed_distance_of_a_union_is_that_of_the_nearest_primitive():
    pair = [box((2, 2, 2), at(-0.5)), box((2, 2, 2), at(0.5))]
    distances = signed_distance(pair, np.array([[3, 0, 0], [-4.5, 0, 5], [0, 0, 0], [0, 0, 0.9]]))
    np.testing.assert_allclose(distances, [1.5, 5, -0.5, -0.1], atol=1e-12)
    crossed = [box((2, 2, 2), at(-0.8)), box((2, 2, 2), at(0.8))]
    assert signed_distance(crossed, np.zeros((1, 3))) == pytest.approx([-0.2])


@pytest.mark.parametrize(
    ("whole", "pieces"),
    [
        *((shape, [shape]) for shape in (BLOCK, UNIT_CUBE, box((0.1, 0.2, 0.3), TILTED_POSE))),
        (box((0.3, 0.2, 0.1)), [box((0.2, 0.2, 0.1), at(x)) for x in (-0.05, 0.05)]),  # overlap
        (box((0.4, 0.2, 0.1)), [box((0.2, 0.2, 0.1), at(x)) for x in (-0.1, 0.1)]),
    ],
)
def test_a_box_is_a_perfect_fit_of_itself_and_of_its_pieces(whole, pieces):
    measures = quality(solid_of([whole]), pieces)
    assert [getattr(measures, name) for name in SHARES] == [1.0, 1.0, 1.0]
    assert max(getattr(measures, name) for name in DISTANCES) < 1e-7


def test_a_box_a_tenth_too_long_protrudes_by_the_excess():
    measures = quality(solid_of([BLOCK]), [Shape(Box((0.44, 0.2, 0.1)), at(0.02))])
    assert measures.iou == pytest.approx(1 / 1.1, abs=1e-4)
    assert measures.coverage == 1
    assert measures.volume_ratio == pytest.approx(1.1, abs=1e-4)
    area = 2 * (0.44 * 0.2 + 0.2 * 0.1 + 0.1 * 0.44)
    end, strips = 0.2 * 0.1 * 0.04, 2 * (0.2 + 0.1) * 0.04 * 0.02
    assert measures.protrusion_mean == pytest.approx((end + strips) / area, rel=5e-3)
    assert measures.protrusion_p95 == pytest.approx(0.04, abs=1e-9)
    assert measures.gap_mean == measures.gap_p95 == 0
    assert measures.hausdorff == pytest.approx(0.04, abs=1e-9)


def test_a_sphere_in_a_cube_does_not_cover_the_corners():
    measures = quality(solid_of([UNIT_CUBE]), [Shape(Sphere(0.1))])
    assert measures.iou == measures.coverage == measures.volume_ratio
    assert measures.iou == pytest.approx(math.pi / 6, abs=1e-3)
    assert measures.protrusion_mean == pytest.approx(0, abs=1e-9)
    away, _ = dblquad(lambda y, x: math.sqrt(1 + x * x + y * y), 0, 1, 0, 1)
    assert measures.gap_mean == pytest.approx(0.1 * (away - 1), rel=0.02)
    assert measures.hausdorff == pytest.approx(0.1 * (math.sqrt(3) - 1), abs=1e-9)


def test_a_cylinder_fits_its_tessellation_up_to_the_sagitta():
    shape = Shape(Cylinder(0.05, 0.2), TILTED_POSE)
    measures = quality(solid_of([shape]), [shape])
    assert measures.iou == pytest.approx(48 / math.tau * math.sin(math.tau / 48), abs=5e-4)
    assert measures.coverage == pytest.approx(1, abs=1e-4)
    sagitta = 0.05 * (1 - math.cos(math.pi / 48))
    assert measures.hausdorff == pytest.approx(sagitta, rel=0.02)
    assert 0 < measures.protrusion_p95 <= sagitta + 1e-9
    assert measures.gap_mean < 1e-9


@pytest.mark.parametrize(
    "idle",
    [Shape(Sphere(0.09)), box((0.2, 0.2, 0.1), at(0, 0, 0.05)), UNIT_CUBE],
    ids=["within", "flush", "equal"],
)
def test_a_primitive_inside_another_changes_nothing(idle):
    small = solid_of([box((0.04, 0.04, 0.04), at(0, 0, -0.06))])
    once = quality(small, [UNIT_CUBE])
    for both in ([UNIT_CUBE, idle], [idle, UNIT_CUBE]):
        measures = quality(small, both)
        for name in SHARES + DISTANCES:
            assert getattr(measures, name) == pytest.approx(getattr(once, name), rel=5e-3, abs=1e-9)


@pytest.mark.parametrize(
    "geometry",
    [Capsule(0.01, 0.03), Capsule(0.001, 0.1), Cylinder(1e-4, 0.1), Cylinder(0.05, 1e-6)],
)
@pytest.mark.parametrize("count", [1, 2])
def test_thin_primitives_are_measured(geometry, count):
    shape = Shape(geometry)
    measures = quality(solid_of([UNIT_CUBE]), [shape] * count)
    corner = signed_distance([shape], np.full((1, 3), 0.1))
    assert measures.hausdorff == pytest.approx(corner[0])
    assert measures.protrusion_share == 0


@pytest.mark.parametrize(
    "primitives",
    [[UNIT_CUBE], [box((0.11, 0.2, 0.2), at(-0.045)), box((0.12, 0.2, 0.2), at(0.04))]],
)
def test_the_hausdorff_distance_of_a_filled_slot_is_its_depth(primitives):
    prongs = [box((0.096, 0.2, 0.2), at(x)) for x in (-0.052, 0.052)]
    measures = quality(solid_of([*prongs, box((0.2, 0.2, 0.02), at(0, 0, -0.09))]), primitives)
    assert measures.iou == pytest.approx(1 - 0.008 * 0.18 / 0.04, abs=1e-3)
    assert measures.protrusion_p95 < 1e-7
    assert measures.protrusion_mean < 1e-4
    assert measures.hausdorff == pytest.approx(0.096, abs=2e-4)


def test_measures_are_reproducible_and_sampling_errors_are_small():
    ball = [Shape(Sphere(0.1))]
    cube = solid_of([UNIT_CUBE])
    assert quality(cube, ball) == quality(cube, ball)
    assert quality(cube, ball).iou == pytest.approx(math.pi / 6, abs=2e-3)


def test_meshes_and_flat_boxes_are_errors(tmp_path):
    cube = solid_of([UNIT_CUBE])
    for wrong in ([UNIT_CUBE, Shape(Mesh(tmp_path / "a.stl"))], [Shape(Box((1, 0, 1)))]):
        with pytest.raises(ValueError, match="primitive"):
            quality(cube, wrong)
        with pytest.raises(ValueError, match="primitive"):
            signed_distance(wrong, np.zeros((1, 3)))
    speck = solid_of([box((1e-3, 1e-3, 1e-3))])
    with pytest.raises(FitError, match="none of 32768 sample points"):
        quality(speck, [Shape(Sphere(10.0), at(5))])
