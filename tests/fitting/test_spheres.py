"""Fits with spheres alone: the search, robots with spheres, and their cache."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from helpers.robots import arm
from morphgen.errors import FitError, FormatError
from morphgen.fitting.link_fit import FitOptions, fit_shapes
from morphgen.fitting.quality import quality
from morphgen.fitting.replace_collision import as_spheres, has_only_spheres, link_spheres
from morphgen.fitting.search import best_spheres, sample_solid
from morphgen.fitting.solid import solid_of
from morphgen.fitting.token_shapes import token_shapes
from morphgen.model.geometry import Box, Mesh, Pose, Shape, Sphere

BALLS = ((0.1, 0.0, 0.0, 0.05), (-0.02, 0.03, 0.0, 0.07), (0.0, -0.04, 0.1, 0.04))
BOX = (0.3, 0.1, 0.08)
BEST_GRID = 2.01  # volume ratio of eight equal balls on the best grid that cover the box


def spheres_of(shapes):
    """Centres and radii, shape (n, 4), sorted by x."""
    rows = [(*shape.T_link_shape.position, shape.geometry.radius) for shape in shapes]
    return np.array(sorted(rows))


def covered(spheres, points):
    """Which points are in any sphere, by brute force."""
    distance = np.linalg.norm(points[:, None] - spheres[None, :, :3], axis=2)
    return (distance <= spheres[:, 3]).any(axis=1)


def volume_of(spheres, rng):
    """Volume of the union, by counting random points."""
    low, high = (spheres[:, :3] - spheres[:, 3:]).min(0), (spheres[:, :3] + spheres[:, 3:]).max(0)
    return covered(spheres, rng.uniform(low, high, (200_000, 3))).mean() * np.prod(high - low)


def test_balls_are_found_again():
    shapes = [Shape(Sphere(r), Pose((x, y, z))) for x, y, z, r in BALLS]
    found = best_spheres(sample_solid(solid_of(shapes), 0), len(BALLS), None, 0)
    assert found.iou > 0.97
    np.testing.assert_allclose(spheres_of(found.shapes), sorted(BALLS), atol=1.5e-3)


@pytest.mark.parametrize("share", [pytest.param(0.98, marks=pytest.mark.slow), 0.995])
def test_spheres_cover_the_share_of_a_box_that_they_must(share):
    fit = fit_shapes([Shape(Box(BOX))], FitOptions(spheres=8, cover=share))
    spheres = spheres_of(fit.primitives)
    assert len(spheres) == 8
    rng = np.random.default_rng(5)
    inside = covered(spheres, rng.uniform(-0.5, 0.5, (200_000, 3)) * BOX).mean()
    assert share - 1e-3 < inside < share + (1 - share) / 2
    volume_ratio = volume_of(spheres, rng) / np.prod(BOX)
    assert volume_ratio < 0.9 * BEST_GRID
    assert volume_ratio == pytest.approx(fit.quality.volume_ratio, rel=0.01)
    assert inside == pytest.approx(fit.quality.coverage, abs=1e-3)


def test_protruding_share_of_a_ball_around_a_cube():
    """A sphere of radius r around a cube of edge 2a has six caps of height r - a outside of it."""
    a, r = 0.05, 0.06
    measured = quality(solid_of([Shape(Box((2 * a,) * 3))]), [Shape(Sphere(r))])
    assert measured.protrusion_share == pytest.approx(6 * (r - a) / (2 * r), rel=0.01)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spheres": 0}, "0 spheres: expected 1 to 32"),
        ({"spheres": 4, "enclose": True}, "neither max_primitives nor enclose"),
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


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A robot of a mesh in millimetres, a rod and a link without shapes, and its spheres."""
    folder = tmp_path_factory.mktemp("spheres")
    trimesh.creation.box((100.0, 100.0, 40.0)).export(folder / "block.stl")
    block = Shape(Mesh(folder / "block.stl", (1e-3, 1e-3, 1e-3)))
    base, upper, lower, *_ = arm().links
    links = (replace(base, collisions=(block,)), upper, replace(lower, collisions=()))
    robot = replace(arm(), links=links, joints=arm().joints[:2], frames=(), home=(0.4, 0.5))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield robot, as_spheres(robot, spheres=3, cover=0.9)


@pytest.fixture
def no_search(monkeypatch):
    def forbidden(*_, **__):
        raise AssertionError("links were fitted again")

    monkeypatch.setattr("morphgen.fitting.robot_fit.fit_links", forbidden)


def test_robots_get_spheres_and_keep_everything_else(made):
    meshed, robot = made
    assert [len(link.collisions) for link in robot.links] == [3, 3, 0]
    assert all(has_only_spheres(link.collisions) for link in robot.links[:2])
    assert [spheres.link for spheres in link_spheres(robot)] == ["base", "upper"]
    for before, after in zip(meshed.links, robot.links, strict=True):
        assert after.inertial.mass == pytest.approx(before.inertial.mass)
        assert len(after.visuals) == len(before.visuals)
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (20_000, 3)) * (0.1, 0.1, 0.04)
    assert 0.89 < covered(spheres_of(robot.root.collisions), points).mean() < 0.96


def test_spheres_are_fitted_once(made, no_search):
    meshed, robot = made
    again = as_spheres(meshed, spheres=3, cover=0.9)
    assert again.ignore_pairs == robot.ignore_pairs
    for kept in (again, as_spheres(robot, spheres=5)):  # links of spheres keep them
        assert [link.collisions for link in kept.links] == [link.collisions for link in robot.links]
    for other in ({"spheres": 3}, {"spheres": 2, "cover": 0.9}, {"spheres": 3, "cover": 0.8}):
        with pytest.raises(AssertionError, match="again"):
            as_spheres(meshed, **other)


def test_tokens_of_a_robot_with_spheres_are_those_of_its_shapes(made):
    meshed, robot = made
    tokens = token_shapes(meshed)
    assert token_shapes(robot) == tokens
    assert token_shapes(as_spheres(robot)) == tokens


def test_faults_of_the_cache_are_reported(made, tmp_path, monkeypatch, caplog):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    robot = replace(made[0], links=made[0].links[:1], joints=(), home=())
    as_spheres(robot, spheres=1)
    (path,) = tmp_path.rglob("spheres*/*.json")
    path.write_text("{")
    with pytest.raises(FormatError, match="delete the file"):
        as_spheres(robot, spheres=1)
    monkeypatch.setenv("XDG_CACHE_HOME", str(path))
    as_spheres(robot, spheres=1)
    assert f"cannot keep fits in {path}/morphgen/" in caplog.text
