"""Openness of points in hollow meshes, and the filling of tubes."""

import numpy as np
import pytest
import trimesh

from morphgen.fitting.solid import MAX_OPENNESS, Cavities, solid_of
from morphgen.model.geometry import Mesh, Shape

POINTS = np.random.default_rng(0).uniform(-0.6, 0.6, (4000, 3))


def tube(wall=0.01, radius=0.1, length=0.6, closed=False):
    mesh = trimesh.creation.annulus(radius - wall, radius, length)
    if not closed:
        return mesh
    lid = trimesh.creation.cylinder(radius, wall)
    lid.apply_translation((0, 0, -length / 2))
    return trimesh.util.concatenate([mesh, lid])


def solid_from(mesh, tmp_path):
    mesh.export(tmp_path / "mesh.stl")
    return solid_of([Shape(Mesh(tmp_path / "mesh.stl"))])


def test_openness_is_zero_inside_a_box_one_far_away_and_half_on_a_wall():
    around = Cavities(trimesh.creation.box((1, 1, 1)))
    points = np.array([(0.1, 0.2, -0.3), (50.0, 0, 0), (0.5 + 1e-4, 0, 0)])
    inside, outside, wall = around.openness(points)
    assert inside == 0
    assert outside == 1
    assert wall == pytest.approx(0.5, abs=0.02)
    assert around.openness(np.zeros((0, 3))).shape == (0,)


def test_openness_in_a_cup_is_the_solid_angle_of_its_opening():
    cup = trimesh.util.concatenate(
        [
            trimesh.creation.annulus(0.49, 0.5, 1.0, transform=None),
            trimesh.creation.box((1, 1, 0.01)),
        ]
    )
    cup.apply_translation((0, 0, 0))
    # The opening of the upper half as seen from the bottom: radius 0.49 at distance 0.49.
    (openness,) = Cavities(cup).openness(np.array([(0.0, 0.0, 0.01)]))
    assert openness == pytest.approx((1 - np.cos(np.pi / 4)) / 2, abs=0.02)


def test_points_outside_the_convex_hull_are_not_enclosed():
    mesh = tube()
    beyond = POINTS[~np.asarray(trimesh.convex.convex_hull(mesh).contains(POINTS))]
    assert Cavities(mesh).openness(beyond).min() > MAX_OPENNESS


@pytest.mark.parametrize("closed", [False, True])
def test_a_tube_is_filled_except_near_its_opening(tmp_path, closed):
    solid = solid_from(tube(closed=closed), tmp_path)
    assert solid.method == "filled"
    deep, mouth, beside = solid.contains(
        np.array([(0.02, 0.03, -0.1), (0.0, 0.0, 0.299), (0.11, 0.0, 0.0)])
    )
    assert deep
    assert not mouth
    assert not beside


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.annulus(0.4, 0.5, 0.1),
        trimesh.util.concatenate(
            [
                trimesh.creation.box((0.02, 0.1, 0.3), transform=np.eye(4)),
                trimesh.creation.box(bounds=[(0.14, -0.05, -0.15), (0.16, 0.05, 0.15)]),
                trimesh.creation.box(bounds=[(-0.01, -0.05, -0.17), (0.16, 0.05, -0.15)]),
            ]
        ),
        trimesh.creation.box((0.3, 0.2, 0.1)),
    ],
    ids=["ring", "fork", "box"],
)
def test_rings_forks_and_boxes_are_not_filled(tmp_path, mesh):
    assert solid_from(mesh, tmp_path).method != "filled"


def test_the_surface_of_a_filled_tube_is_its_outer_surface(tmp_path):
    solid = solid_from(tube(), tmp_path)
    points = solid.surface(2000, np.random.default_rng(0))
    middle = points[np.abs(points[:, 2]) < 0.15]
    assert len(middle) > 200
    assert np.linalg.norm(middle[:, :2], axis=1).min() > 0.095
