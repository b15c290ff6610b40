"""Mass properties: textbook formulas, and overlaps counted once."""

import math

import numpy as np
import pytest

from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box, inertial_from_density, solid_mesh

DENSITY = 700.0


def test_cylinder_and_sphere_have_the_textbook_inertia():
    r, length = 0.05, 0.4
    cylinder = inertial_from_density([Shape(Cylinder(r, length))], DENSITY)
    mass = DENSITY * math.pi * r * r * length
    assert cylinder.inertia[0] == pytest.approx(mass * (3 * r * r + length**2) / 12)
    assert cylinder.inertia[5] == pytest.approx(mass * r * r / 2)
    sphere = inertial_from_density([Shape(Sphere(r))], DENSITY)
    assert sphere.inertia[0] == pytest.approx(0.4 * sphere.mass * r * r)
    assert inertial_from_density([], DENSITY).mass == 0.0


@pytest.mark.parametrize(
    "shape", [Capsule(0.05, 0.3), Cylinder(0.05, 0.3), Sphere(0.1), Box((0.1, 0.2, 0.3))]
)
def test_closed_form_agrees_with_the_tessellation(shape):
    mesh = solid_mesh(shape)
    body = inertial_from_density([Shape(shape)], 1.0)
    assert body.mass == pytest.approx(mesh.volume, rel=0.02)
    np.testing.assert_allclose(np.diag(body.matrix), np.diag(mesh.moment_inertia), rtol=0.03)


def test_a_transformed_shape_has_the_transformed_inertia():
    T = Pose.from_xyz_rpy((0.3, -0.1, 0.2), (0.4, 1.0, -0.7))
    still = inertial_from_density([Shape(Box((0.1, 0.2, 0.3)))], DENSITY)
    moved = inertial_from_density([Shape(Box((0.1, 0.2, 0.3)), T)], DENSITY)
    np.testing.assert_allclose(moved.com, T.position, atol=1e-12)
    R = T.matrix[:3, :3]
    np.testing.assert_allclose(moved.matrix, R @ still.matrix @ R.T, atol=1e-12)


def test_overlap_is_counted_once():
    half = Pose((0.05, 0.0, 0.0))
    body = inertial_from_density(
        [Shape(Box((0.1, 0.1, 0.1))), Shape(Box((0.1, 0.1, 0.1)), half)], DENSITY
    )
    whole = inertial_from_density([Shape(Box((0.15, 0.1, 0.1)), Pose((0.025, 0.0, 0.0)))], DENSITY)
    assert body.mass == pytest.approx(whole.mass)
    np.testing.assert_allclose(body.com, whole.com, atol=1e-12)
    np.testing.assert_allclose(body.matrix, whole.matrix, atol=1e-12)


def test_separate_shapes_use_the_closed_forms():
    far = Pose((1.0, 0.0, 0.0))
    body = inertial_from_density([Shape(Sphere(0.1)), Shape(Sphere(0.1), far)], DENSITY)
    one = inertial_from_density([Shape(Sphere(0.1))], DENSITY)
    assert body.mass == pytest.approx(2 * one.mass, rel=1e-14)
    assert body.inertia[3] == pytest.approx(2 * (one.inertia[3] + one.mass * 0.25))


def test_bounding_box_contains_a_rotated_box():
    T = Pose.from_xyz_rpy((0, 0, 0), (0, 0, math.pi / 4))
    low, high = bounding_box([Shape(Box((1.0, 1.0, 0.2)), T)])
    np.testing.assert_allclose(high, [math.sqrt(0.5), math.sqrt(0.5), 0.1], atol=1e-12)
    np.testing.assert_allclose(low, -high, atol=1e-12)
