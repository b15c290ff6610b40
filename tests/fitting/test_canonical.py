"""Poses of primitives that look alike."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from morphgen.fitting.canonical import canonical
from morphgen.fitting.link_fit import signed_distance
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere

KINDS = [Box((0.3, 0.2, 0.4)), Cylinder(0.15, 0.3), Sphere(0.2), Capsule(0.1, 0.25)]
POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (500, 3))


def turned(geometry, rotation, position=(0.1, -0.05, 0.02)):
    w, x, y, z = rotation.as_quat(scalar_first=True, canonical=True).tolist()
    return Shape(geometry, Pose(position, (w, x, y, z)))


@pytest.mark.parametrize("geometry", KINDS, ids=lambda g: type(g).__name__)
def test_canonicalization_preserves_the_solid_and_is_idempotent(geometry):
    for rotation in Rotation.random(20, random_state=1):
        shape = turned(geometry, rotation)
        first = canonical(shape)
        again = canonical(first)
        before, after = (signed_distance([each], POINTS) for each in (shape, first))
        assert after == pytest.approx(before, abs=1e-9)
        assert again.geometry == first.geometry
        assert again.T_link_shape.matrix == pytest.approx(first.T_link_shape.matrix, abs=1e-9)


def test_equivalent_boxes_have_one_canonical_form():
    R = Rotation.from_rotvec((0.2, 0.1, -0.3))
    shapes = []
    for quarter in Rotation.create_group("O"):
        edges = np.abs(quarter.inv().as_matrix()) @ (0.1, 0.2, 0.4)
        shapes.append(canonical(turned(Box(tuple(edges.round(9).tolist())), R * quarter)))
    for shape in shapes:
        assert shape.geometry == Box((0.1, 0.2, 0.4))
        assert shape.T_link_shape.matrix == pytest.approx(shapes[0].T_link_shape.matrix, abs=1e-9)


def test_equivalent_cylinders_have_one_canonical_form():
    R = Rotation.from_rotvec((0.4, -0.2, 0.3))
    flip = Rotation.from_rotvec((np.pi, 0, 0))
    poses = [
        canonical(turned(Cylinder(0.1, 0.3), R * about * over)).T_link_shape
        for about in Rotation.from_rotvec([(0, 0, a) for a in (0, 1, 2, 3)])
        for over in (Rotation.identity(), flip)
    ]
    for pose in poses:
        assert pose.matrix == pytest.approx(poses[0].matrix, abs=1e-8)
    assert poses[0].quaternion[3] == 0


def test_spheres_have_no_rotation_and_meshes_are_no_primitives(tmp_path):
    R = Rotation.from_rotvec((1.0, 2.0, 0.5))
    assert canonical(turned(Sphere(0.1), R)).T_link_shape == Pose((0.1, -0.05, 0.02))
    mesh = turned(Mesh(tmp_path / "m.stl"), R)
    assert canonical(mesh) is mesh
