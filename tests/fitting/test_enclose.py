"""The smallest box, cylinder or sphere that encloses a set of points."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, Kind
from morphgen.fitting.enclose import enclose
from morphgen.fitting.quality import signed_distance
from morphgen.fitting.solid import solid_of
from morphgen.grammar.library import default_library
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Box, Cylinder, Shape, Sphere, dimensions, volume
from morphgen.typing import Array

GEOMETRY: dict[Kind, type] = {"box": Box, "cylinder": Cylinder, "sphere": Sphere}
CUBE = np.array(list(itertools.product((0.0, 0.1), repeat=3)))
ROUNDING = 1.001


def outside(shape: Shape, points: Array) -> float:
    """Return the largest signed distance of points to a shape [m]."""
    return float(signed_distance([shape], points).max())


def size(shape: Shape) -> float:
    assert isinstance(shape.geometry, (Box, Cylinder, Sphere))
    return volume(shape.geometry)


def surface(kind: Kind, rng: np.random.Generator) -> tuple[Array, float]:
    """Points of a randomly placed primitive of random size, and its volume."""
    a, b, c = np.exp(rng.uniform(-3, -0.5, 3))
    if kind == "box":
        mesh, truth = trimesh.creation.box((a, b, c)).subdivide(), a * b * c
    elif kind == "cylinder":
        mesh, truth = trimesh.creation.cylinder(a, b, sections=60), math.pi * a**2 * b
    else:
        mesh, truth = trimesh.creation.icosphere(2, a), 4 / 3 * math.pi * a**3
    turn = Rotation.from_rotvec(rng.uniform(-3, 3, 3)).as_matrix()
    return mesh.vertices @ turn.T + rng.uniform(-1, 1, 3), truth


def cloud(rng: np.random.Generator, n: int = 40) -> Array:
    stretched = rng.normal(size=(n, 3)) * np.exp(rng.uniform(-3, 0, 3))
    turn = Rotation.from_rotvec(rng.uniform(-3, 3, 3)).as_matrix()
    return np.asarray(stretched @ turn.T + rng.uniform(-2, 2, 3))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_turned_primitive_is_recovered(kind: Kind, seed: int) -> None:
    points, truth = surface(kind, np.random.default_rng(seed))
    shape = enclose(points)
    assert isinstance(shape.geometry, GEOMETRY[kind])
    assert size(shape) == pytest.approx(truth, rel=5e-3)
    assert outside(shape, points) <= 1e-9


def test_a_primitive_aligned_with_the_link_axes_stays_aligned() -> None:
    centre = np.array([0.5, 0.0, -0.2])
    box = enclose(np.asarray(trimesh.creation.box((0.1, 0.2, 0.3)).vertices) + centre)
    assert box.geometry == Box((0.1, 0.2, 0.3))
    assert box.T_link_shape.position == (0.5, 0.0, -0.2)
    assert box.T_link_shape.quaternion == (1.0, 0.0, 0.0, 0.0)
    points = np.asarray(trimesh.creation.box((0.1, 0.2, 0.3)).subdivide().vertices)
    noise = np.random.default_rng(0).uniform(-1e-7, 1e-7, points.shape)
    assert enclose(points + noise).T_link_shape.quaternion == (1.0, 0.0, 0.0, 0.0)

    upright = np.asarray(trimesh.creation.cylinder(0.1, 0.5).vertices)
    cylinder = enclose(upright + centre)
    assert cylinder.geometry == Cylinder(0.1, 0.5)
    assert cylinder.T_link_shape == box.T_link_shape
    half = math.sqrt(0.5)
    lying = enclose(upright[:, [2, 0, 1]] + centre)
    assert lying.geometry == Cylinder(0.1, 0.5)
    assert lying.T_link_shape.quaternion == pytest.approx((half, 0.0, half, 0.0))

    sphere = enclose(np.asarray(trimesh.creation.icosphere(2, 0.1).vertices) + centre)
    assert sphere == Shape(Sphere(0.1), box.T_link_shape)


@pytest.mark.parametrize(("seed", "scale"), [(0, 1.0), (3, 1e-4)])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_encloses_all_points_after_rounding(kind: Kind, seed: int, scale: float) -> None:
    points = scale * cloud(np.random.default_rng(seed))
    shape = enclose(points, [kind])
    assert isinstance(shape.geometry, GEOMETRY[kind])
    assert outside(shape, points) <= 1e-9
    assert outside(shape, points) > -3e-6, "a point must touch it"
    pose = shape.T_link_shape
    for value in (*dimensions(shape.geometry), *pose.position):
        assert value == round(value, 6)
    assert np.linalg.norm(pose.quaternion) == pytest.approx(1.0, abs=1e-15)
    assert pose.quaternion == pytest.approx(np.round(pose.quaternion, 9), abs=2e-9)
    assert pose.quaternion[0] >= 0


def test_enclosures_of_links_are_not_larger_than_those_of_trimesh() -> None:
    arm = load_part(default_library(()).manifest("panda")).fragment
    for name in ("panda_link3", "panda_link4"):  # whose trimesh cylinder is a sixth too large
        mesh = solid_of(arm.link(name).collisions).mesh
        _, extents = trimesh.bounds.oriented_bounds(mesh)
        cylinder = trimesh.bounds.minimum_cylinder(mesh)
        _, radius = trimesh.nsphere.minimum_nsphere(mesh)
        tightest = min(
            volume(Box(tuple(extents))),
            volume(Cylinder(cylinder["radius"], cylinder["height"])),
            volume(Sphere(radius)),
        )
        shape = enclose(mesh.vertices)
        assert size(shape) <= tightest * ROUNDING
        assert outside(shape, np.asarray(mesh.vertices)) <= 1e-9


def test_the_smallest_box_of_a_regular_tetrahedron_is_a_cube() -> None:
    corners = CUBE[[0, 3, 5, 6]]
    turn = Rotation.from_rotvec([0.3, 1.1, -0.4]).as_matrix()
    assert size(enclose(corners @ turn.T, ["box"])) == pytest.approx(1e-3, rel=1e-3)
    sphere = enclose(corners @ turn.T, ["sphere"]).geometry
    assert isinstance(sphere, Sphere)
    assert sphere.radius == pytest.approx(0.05 * math.sqrt(3), abs=2e-6)


def smallest_sphere(points: Array) -> float:
    """Return the radius by enumerating all spheres through two to four points."""
    radii = []
    for n in (2, 3, 4):
        for some in itertools.combinations(range(len(points)), n):
            spokes = points[list(some[1:])] - points[some[0]]
            weights = np.linalg.lstsq(spokes @ spokes.T, (spokes**2).sum(axis=1) / 2, rcond=None)[0]
            centre = points[some[0]] + weights @ spokes
            radii.append(np.linalg.norm(points - centre, axis=1).max())
    return float(min(radii))


@pytest.mark.parametrize("seed", range(6))
def test_the_sphere_is_the_minimum_enclosing_sphere(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(8, 3))
    if seed % 3 == 1:
        points = points.round()
    if seed % 3 == 2:
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    sphere = enclose(points, ["sphere"]).geometry
    assert isinstance(sphere, Sphere)
    assert sphere.radius == pytest.approx(smallest_sphere(points), abs=3e-6)


def test_the_smallest_of_several_kinds_is_returned() -> None:
    points = cloud(np.random.default_rng(7))
    alone = {kind: enclose(points, [kind]) for kind in KINDS}
    assert enclose(points) == min(alone.values(), key=size)
    rest = ("sphere", "box")
    assert enclose(points, rest) == min((alone[kind] for kind in rest), key=size)


def test_the_result_is_deterministic_and_independent_of_interior_points() -> None:
    rng = np.random.default_rng(8)
    points = cloud(rng)
    shape = enclose(points)
    assert enclose(points.copy()) == shape
    inner = rng.dirichlet(np.ones(len(points)), 500) @ points
    assert enclose(np.concatenate([points, inner, points])) == shape


def test_a_dense_round_hull_is_enclosed_tightly() -> None:
    egg = np.asarray(trimesh.creation.icosphere(5).vertices) * (0.3, 0.2, 0.1)
    assert len(egg) > 10_000
    turn = Rotation.from_rotvec([0.5, 0.2, 1.0]).as_matrix()
    shape = enclose(egg @ turn.T, ["box"])
    assert outside(shape, egg @ turn.T) <= 1e-9
    assert size(shape) <= 0.6 * 0.4 * 0.2 * ROUNDING


@pytest.mark.parametrize(
    ("points", "reason"),
    [
        (np.zeros((0, 3)), "0 points"),
        (np.ones((9, 3)), "1 points are distinct"),
        (np.eye(3)[[0, 1, 2, 0, 1, 2]], "3 points are distinct"),
        (np.stack([np.arange(5.0)] * 3, axis=1), "flat"),
        (np.insert(np.random.default_rng(0).normal(size=(50, 2)), 1, 3.0, axis=1), "flat"),
        (np.vstack([CUBE, [0.0, 0.0, np.nan]]), "not finite"),
    ],
)
def test_points_without_volume_are_an_error(points: Array, reason: str) -> None:
    with pytest.raises(FitError, match=reason):
        enclose(points)
    with pytest.raises(ValueError, match=r"\(8, 2\); expected \(n, 3\)"):
        enclose(CUBE[:, :2])
