"""Quality measures of fitted primitives, compared with closed forms."""

import math

import numpy as np
import pytest
import trimesh
from scipy.integrate import dblquad

from morphgen.errors import FitError
from morphgen.fitting.quality import Quality, quality, signed_distance
from morphgen.fitting.solid import Solid, solid_of
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import solid_mesh

BLOCK = Shape(Box((0.4, 0.2, 0.1)))
CUBE = Shape(Box((0.2, 0.2, 0.2)))
TILTED = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.4, -1.1, 2.0))
KINDS = [Box((0.3, 0.2, 0.4)), Cylinder(0.15, 0.3), Sphere(0.2), Capsule(0.1, 0.25)]
DISTANCES = ("protrusion_mean", "protrusion_p95", "gap_mean", "gap_p95", "hausdorff")
SHARES = ("iou", "coverage", "volume_ratio")


def at(x: float, y: float = 0.0, z: float = 0.0) -> Pose:
    return Pose((x, y, z))


def solid(*pieces: tuple[Box, Pose]) -> Solid:
    return solid_of([Shape(box, pose) for box, pose in pieces])


def assert_perfect(found: Quality) -> None:
    assert [getattr(found, name) for name in SHARES] == [1.0, 1.0, 1.0]
    assert max(getattr(found, name) for name in DISTANCES) < 1e-7


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
@pytest.mark.parametrize("pose", [Pose(), TILTED])
def test_signed_distances_of_one_primitive_are_exact(geometry, point, expected, pose):
    distances = signed_distance([Shape(geometry, pose)], np.array([pose.apply(point)]))
    assert distances == pytest.approx([expected], abs=1e-12)


def test_the_signed_distance_of_a_union_is_that_of_the_nearest_primitive():
    pair = [Shape(Box((2, 2, 2)), at(-0.5)), Shape(Box((2, 2, 2)), at(0.5))]
    distances = signed_distance(pair, np.array([[3, 0, 0], [-4.5, 0, 5], [0, 0, 0], [0, 0, 0.9]]))
    np.testing.assert_allclose(distances, [1.5, 5, -0.5, -0.1], atol=1e-12)
    crossed = [Shape(Box((2, 2, 2)), at(-0.8)), Shape(Box((2, 2, 2)), at(0.8))]
    assert signed_distance(crossed, np.zeros((1, 3))) == pytest.approx([-0.2])


@pytest.mark.parametrize("shape", [BLOCK, CUBE, Shape(Box((0.1, 0.2, 0.3)), TILTED)])
def test_a_box_is_a_perfect_fit_of_itself(shape):
    assert_perfect(quality(solid_of([shape]), [shape]))


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
    measures = quality(solid_of([CUBE]), [Shape(Sphere(0.1))])
    assert measures.iou == measures.coverage == measures.volume_ratio
    assert measures.iou == pytest.approx(math.pi / 6, abs=1e-3)
    assert measures.protrusion_mean == pytest.approx(0, abs=1e-9)
    away, _ = dblquad(lambda y, x: math.sqrt(1 + x * x + y * y), 0, 1, 0, 1)
    assert measures.gap_mean == pytest.approx(0.1 * (away - 1), rel=0.02)
    assert measures.hausdorff == pytest.approx(0.1 * (math.sqrt(3) - 1), abs=1e-9)


def test_a_cylinder_fits_its_tessellation_up_to_the_sagitta():
    shape = Shape(Cylinder(0.05, 0.2), TILTED)
    measures = quality(solid_of([shape]), [shape])
    assert measures.iou == pytest.approx(48 / math.tau * math.sin(math.tau / 48), abs=5e-4)
    assert measures.coverage == pytest.approx(1, abs=1e-4)
    sagitta = 0.05 * (1 - math.cos(math.pi / 48))
    assert measures.hausdorff == pytest.approx(sagitta, rel=0.02)
    assert 0 < measures.protrusion_p95 <= sagitta + 1e-9
    assert measures.gap_mean < 1e-9


@pytest.mark.parametrize("shift", [0.05, 0.1])
def test_the_overlap_of_two_boxes_is_counted_once(shift):
    pair = [Shape(Box((0.2, 0.2, 0.1)), at(-shift)), Shape(Box((0.2, 0.2, 0.1)), at(shift))]
    assert_perfect(quality(solid((Box((0.2 + 2 * shift, 0.2, 0.1)), Pose())), pair))


@pytest.mark.parametrize(
    "idle",
    [Shape(Sphere(0.09)), Shape(Box((0.2, 0.2, 0.1)), at(0, 0, 0.05)), CUBE],
    ids=["within", "flush", "equal"],
)
def test_a_primitive_inside_another_changes_nothing(idle):
    small = solid((Box((0.04, 0.04, 0.04)), at(0, 0, -0.06)))
    once = quality(small, [CUBE])
    for both in ([CUBE, idle], [idle, CUBE]):
        measures = quality(small, both)
        for name in SHARES + DISTANCES:
            assert getattr(measures, name) == pytest.approx(getattr(once, name), rel=5e-3, abs=1e-9)


def test_protrusion_of_a_thin_skin_equals_its_thickness():
    skin = 1e-4
    pair = [
        Shape(Box((0.3 + skin, 0.2 + 2 * skin, 0.1 + 2 * skin)), at(sign * (0.05 + skin / 2)))
        for sign in (-1, 1)
    ]
    measures = quality(solid_of([BLOCK]), pair)
    assert measures.coverage == 1
    assert measures.protrusion_mean == pytest.approx(skin, rel=0.01)
    assert measures.hausdorff == pytest.approx(math.sqrt(3) * skin, abs=1e-7)


@pytest.mark.parametrize(
    "geometry",
    [Capsule(0.01, 0.03), Capsule(0.001, 0.1), Cylinder(1e-4, 0.1), Cylinder(0.05, 1e-6)],
)
@pytest.mark.parametrize("count", [1, 2])
def test_thin_primitives_are_measured(geometry, count):
    shape = Shape(geometry)
    measures = quality(solid_of([CUBE]), [shape] * count)
    corner = signed_distance([shape], np.full((1, 3), 0.1))
    assert measures.hausdorff == pytest.approx(corner[0])
    assert measures.protrusion_share == 0


def test_disjoint_shapes_have_no_overlap():
    measures = quality(solid_of([CUBE]), [Shape(CUBE.geometry, at(0.5))])
    assert measures.iou == measures.coverage == 0
    assert measures.volume_ratio == pytest.approx(1, rel=1e-3)
    assert measures.hausdorff == pytest.approx(0.5, abs=1e-9)
    assert 0.3 < measures.gap_mean == pytest.approx(measures.protrusion_mean, rel=0.02)


@pytest.mark.parametrize(
    "primitives",
    [[CUBE], [Shape(Box((0.11, 0.2, 0.2)), at(-0.045)), Shape(Box((0.12, 0.2, 0.2)), at(0.04))]],
)
def test_the_hausdorff_distance_of_a_filled_slot_is_its_depth(primitives):
    slotted = solid(
        (Box((0.096, 0.2, 0.2)), at(-0.052)),
        (Box((0.096, 0.2, 0.2)), at(0.052)),
        (Box((0.2, 0.2, 0.02)), at(0, 0, -0.09)),
    )
    measures = quality(slotted, primitives)
    assert measures.iou == pytest.approx(1 - 0.008 * 0.18 / 0.04, abs=1e-3)
    assert measures.protrusion_p95 < 1e-7
    assert measures.protrusion_mean < 1e-4
    assert measures.hausdorff == pytest.approx(0.096, abs=2e-4)


@pytest.mark.parametrize("geometry", KINDS)
def test_surfaces_are_sampled_uniformly(geometry):
    kernel = Shape(Box((0.02, 0.05, 0.01)), TILTED @ at(0.05, 0.02, 0.03))
    small = solid_of([kernel])
    measures = quality(small, [Shape(geometry, TILTED)])
    mesh = solid_mesh(geometry).copy()
    for _ in range(2 if isinstance(geometry, Sphere) else 0):
        mesh = mesh.subdivide()
    mesh.apply_transform(TILTED.matrix)
    points, _ = trimesh.sample.sample_surface(mesh, 40_000, seed=3)
    distance = small.distance(np.asarray(points))
    assert measures.protrusion_mean == pytest.approx(distance.mean(), rel=0.01)
    assert measures.protrusion_p95 == pytest.approx(np.percentile(distance, 95), rel=0.01)
    assert measures.coverage == 1


def test_measures_are_reproducible_and_sampling_errors_are_small():
    ball = [Shape(Sphere(0.1))]
    cube = solid_of([CUBE])
    measures = [quality(cube, ball, seed=seed) for seed in range(8)]
    assert quality(cube, ball, seed=3) == measures[3]
    assert len({each.gap_mean for each in measures}) == len(measures)
    error = np.array([each.iou for each in measures]) - math.pi / 6
    assert np.abs(error).max() < 2e-3
    assert quality(cube, ball, volume_points=1000) == quality(cube, ball, volume_points=1024)


def test_meshes_empty_lists_and_flat_boxes_are_errors(tmp_path):
    cube = solid_of([CUBE])
    for wrong in ([], [CUBE, Shape(Mesh(tmp_path / "a.stl"))], [Shape(Box((1, 0, 1)))]):
        with pytest.raises(ValueError, match="primitive"):
            quality(cube, wrong)
        with pytest.raises(ValueError, match="primitive"):
            signed_distance(wrong, np.zeros((1, 3)))
    speck = solid((Box((1e-3, 1e-3, 1e-3)), Pose()))
    with pytest.raises(FitError, match="none of 64 sample points"):
        quality(speck, [Shape(Sphere(1.0), at(5))], volume_points=64)
