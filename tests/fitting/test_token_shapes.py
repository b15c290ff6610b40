"""The primitive that represents a link in the tokens, its fit to several, and canonical poses."""

import math
from functools import lru_cache

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import morphgen
from morphgen.errors import FormatError
from morphgen.fitting import token_shapes as module
from morphgen.fitting.canonical import canonical
from morphgen.fitting.link_fit import quality, signed_distance
from morphgen.fitting.solid import solid_of
from morphgen.fitting.token_shapes import fit_composite, token_shapes
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere, scale_shape
from morphgen.model.robot import Joint, Link, Robot

FOLDERS = default_library(()).folders


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setattr(module, "user_cache_path", lambda name: folder / name)
    return folder


@pytest.fixture
def no_search(monkeypatch):
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched for"))


def robot_of(*shapes):
    links = (Link("base"), Link("body", collisions=tuple(shapes)))
    return Robot("r", links, (Joint("j", "fixed", "base", "body"),))


def test_a_link_of_one_primitive_keeps_it(no_search):
    can = Shape(Cylinder(0.1, 0.2), Pose((0.1, 0.0, 0.0)), rgba=(1.0, 0.0, 0.0, 1.0))
    assert token_shapes(robot_of(can)) == {"body": Shape(can.geometry, can.T_link_shape)}


def test_a_link_without_collision_shapes_has_no_primitive(no_search):
    can = Shape(Cylinder(0.1, 0.2))
    links = (Link("base", visuals=(can,)), Link("body", visuals=(can,), collisions=(can,)))
    robot = Robot("r", links, (Joint("j", "fixed", "base", "body"),))
    assert token_shapes(robot).keys() == {"body"}


def test_a_dominant_primitive_represents_the_link(no_search):
    disc, lug = Shape(Cylinder(0.07, 0.05)), Shape(Box((0.02, 0.005, 0.03)), Pose((0.0, 0.0, 0.02)))
    assert token_shapes(robot_of(lug, disc)) == {"body": disc}
    with pytest.raises(pytest.fail.Exception, match="searched for"):
        token_shapes(robot_of(disc, Shape(Sphere(0.08), Pose((0.05, 0.0, 0.0)))))


def test_library_meshes_need_no_search_even_if_scaled(no_search):
    arm = morphgen.compose("arm=panda")
    larger = morphgen.compose("arm=panda_scaled arm.scale3=1.4")
    plain, scaled = (token_shapes(robot, FOLDERS) for robot in (arm, larger))
    assert len(plain) == len(scaled) > 7
    (other,) = (name for name in plain if plain[name] != scaled[name])
    assert "link2" in other
    assert scaled[other] == scale_shape(plain[other], 1.4)


def test_new_shapes_are_searched_once(monkeypatch, cache):
    shapes = [Shape(Sphere(0.1)), Shape(Sphere(0.1), Pose((0.05, 0.0, 0.0)))]
    first = token_shapes(robot_of(*shapes))
    assert first["body"].T_link_shape.position == (0.025, 0.0, 0.0)  # between them
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched again"))
    assert token_shapes(robot_of(*shapes)) == first
    (path,) = cache.rglob("*.json")
    path.write_text('{"box": [1, 2]}')
    with pytest.raises(FormatError, match=path.name):
        token_shapes(robot_of(*shapes))


def test_a_flat_link_has_no_primitive_and_the_result_is_cached(tmp_path, monkeypatch):
    flat = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    flat.export(tmp_path / "flat.stl")
    robot = robot_of(Shape(Mesh(tmp_path / "flat.stl")))
    assert token_shapes(robot) == {}
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched again"))
    assert token_shapes(robot) == {}


def test_a_cache_that_cannot_be_written_is_reported_once(cache, caplog):
    cache.write_text("a file")
    shapes = [Shape(Sphere(0.1)), Shape(Sphere(0.1), Pose((0.05, 0.0, 0.0)))]
    assert token_shapes(robot_of(*shapes))
    assert token_shapes(robot_of(*shapes))
    messages = [record.getMessage() for record in caplog.records]
    assert [f"cannot keep fits in {cache}/morphgen/" in text for text in messages] == [True]


SEEDS = [1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (0, 2, 3, 4, 5))]
"""Links of two and of three primitives; more of the same are slow."""


def drawn(seed, noise=0.0):
    """Return two or three overlapping rotated primitives."""
    rng = np.random.default_rng(seed)
    shapes = []
    for _ in range(2 + seed % 2):
        a, b, c = rng.uniform(0.05, 0.2, 3).tolist()
        geometry = [Box((a, b, c)), Cylinder(a / 2, 2 * b), Sphere(a)][rng.integers(3)]
        xyz = rng.uniform(-0.08, 0.08, 3)
        rpy = rng.uniform(-1, 1, 3)
        xyz, rpy = (each * (1 + noise) for each in (xyz, rpy))
        shapes.append(Shape(geometry, Pose.from_xyz_rpy(tuple(xyz), tuple(rpy))))
    return shapes


@lru_cache
def fitted(seed):
    return fit_composite(drawn(seed))


def overlap(shapes, *found):
    return quality(solid_of(shapes), found).iou


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_the_fit_overlaps_at_least_as_well_as_any_primitive_of_the_link(seed):
    shapes = drawn(seed)
    best_overlap = max(overlap(shapes, shape) for shape in shapes)
    assert overlap(shapes, fitted(seed)) > best_overlap - 0.01


@pytest.mark.parametrize("seed", SEEDS)
def test_the_last_bits_of_numbers_do_not_change_the_fit(seed):
    assert fitted(seed) == fit_composite(drawn(seed, noise=3e-16))


def test_two_rails_are_fitted_by_one_of_them():
    rails = [Shape(Box((1.1, 0.03, 0.03)), Pose((0.0, y, 1.05))) for y in (0.6, -0.6)]
    assert fit_composite(rails) == rails[0]


def test_the_sides_of_the_fit_are_flush_with_the_link():
    prongs = [Shape(Box((0.02, 0.01, 0.04)), Pose((0.0, y, 0.02))) for y in (0.02, -0.02)]
    bridge = Shape(Box((0.02, 0.03, 0.01)), Pose((0.0, 0.0, 0.035)))
    fit = fit_composite([*prongs, bridge])
    assert fit == Shape(Box((0.02, 0.05, 0.04)), Pose((0.0, 0.0, 0.02)))


@pytest.mark.slow
def test_mirrored_fingers_have_mirrored_primitives():
    def finger(side):
        blocks = [
            ((0.022, 0.015, 0.02), (0.0, 0.0185, 0.011), 0.0),
            ((0.0175, 0.007, 0.0235), (0.0, 0.0159, 0.02835), math.pi / 6),
            ((0.0175, 0.0152, 0.0185), (0.0, 0.00758, 0.04525), 0.0),
        ]
        return [
            Shape(Box(size), Pose.from_xyz_rpy((x, side * y, z), (side * roll, 0.0, 0.0)))
            for size, (x, y, z), roll in blocks
        ]

    left, right = (fit_composite(finger(side)) for side in (1, -1))
    assert right.geometry.size == pytest.approx(left.geometry.size, abs=3e-4)
    mirror = np.array([1, -1, 1])
    position = mirror * right.T_link_shape.position
    assert position == pytest.approx(left.T_link_shape.position, abs=3e-4)
    assert overlap(finger(1), left) > 0.6


def test_empty_and_flat_links_have_no_fit():
    assert fit_composite([]) is None
    assert fit_composite([Shape(Box((0.1, 0.1, 0.0)))]) is None
    with pytest.raises(TypeError, match="Capsule"):
        fit_composite([Shape(Capsule(0.1, 0.2))])


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
