"""Convex pieces of collision meshes: what they cover, their cache, bundles and errors."""

import dataclasses

import numpy as np
import pytest
import trimesh

import morphgen
from helpers.robots import chain
from morphgen.errors import FitError, MeshError
from morphgen.fitting import replace_collision as module
from morphgen.fitting.replace_collision import MAX_PIECES, as_convex, as_primitives, decompose
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.fits import shapes_key
from morphgen.model.geometry import Box, Mesh, Pose, Shape, StoredFit
from morphgen.model.inertia import link_frame_mesh
from morphgen.model.robot import Link

pytest.importorskip("coacd")

NOTCH = np.array([0.15, 0.0, 0.15])
"""A point in the notch of the bracket and in its convex hull [m]."""


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "user_cache_path", lambda name: tmp_path / "cache" / name)
    return tmp_path / "cache"


@pytest.fixture
def bracket(tmp_path):
    """Return an L of two bars as a mesh file."""
    flat = trimesh.creation.box(bounds=[(0, -0.05, 0), (0.3, 0.05, 0.1)])
    upright = trimesh.creation.box(bounds=[(0, -0.05, 0), (0.1, 0.05, 0.3)])
    path = tmp_path / "bracket.stl"
    trimesh.boolean.union([flat, upright], engine="manifold").export(path)
    return Mesh(path)


def robot_of(*meshes, scale=1.0):
    """Return a chain of links with one mesh each and revolute joints."""
    scaled = (dataclasses.replace(mesh, scale=(scale,) * 3) for mesh in meshes)
    shapes = (Shape(mesh, Pose((0.1 * scale, 0.0, 0.0))) for mesh in scaled)
    links = (Link(f"l{i}", collisions=(shape,)) for i, shape in enumerate(shapes))
    return chain(*links, step=(0.0, 0.2, 0.0))


def test_pieces_cover_a_concave_mesh_and_leave_its_notch_free(bracket):
    pieces = decompose(bracket)
    assert 2 <= len(pieces) <= MAX_PIECES
    assert all(piece.is_watertight and piece.is_convex for piece in pieces)
    points = np.random.default_rng(0).uniform((0, -0.05, 0), (0.3, 0.05, 0.3), (4000, 3))
    inside = (points[:, 0] < 0.1) | (points[:, 2] < 0.1)
    covered = np.any([piece.contains(points) for piece in pieces], axis=0)
    assert (covered == inside).mean() > 0.98
    assert not any(piece.contains(NOTCH[None]).any() for piece in pieces)


def test_decomposition_reproduces_to_the_byte(bracket, monkeypatch):
    first = [piece.vertices.tobytes() for piece in decompose(bracket)]
    monkeypatch.setenv("OMP_NUM_THREADS", "4")
    assert [piece.vertices.tobytes() for piece in decompose(bracket)] == first


def test_the_cache_serves_every_scale_and_another_path(bracket, tmp_path, monkeypatch):
    large = as_convex(robot_of(bracket))
    copy = Mesh(bracket.path.rename(tmp_path / "renamed.stl"))
    monkeypatch.setattr(module, "decompose", lambda mesh: pytest.fail("decomposed again"))
    small = as_convex(robot_of(copy, scale=0.5))
    for one, other in zip(small.links[0].collisions, large.links[0].collisions, strict=True):
        assert link_frame_mesh(one).bounds == pytest.approx(link_frame_mesh(other).bounds / 2)


def test_bundles_and_repetition_keep_the_pieces(bracket, tmp_path):
    robot = robot_of(bracket, bracket)
    convex = as_convex(robot)
    assert as_convex(convex) == convex
    back = read_bundle(write_bundle(convex, tmp_path / "robots" / convex.name, picture=False))
    assert as_convex(back) == back
    counts = [[len(link.collisions) for link in each.links] for each in (back, convex)]
    assert counts[0] == counts[1]
    assert back.provenance["convex"] == convex.provenance["convex"]


def test_fits_of_primitives_stay(bracket, tmp_path):
    robot = robot_of(bracket, scale=0.5)
    token, bar = Shape(Box((0.3, 0.1, 0.2))), Shape(Box((0.3, 0.1, 0.1)))
    fit = StoredFit("l0", token, (bar,), 0.5, 0.6)
    key = shapes_key(robot.links[0].collisions)
    robot = dataclasses.replace(robot, fits={key: fit})
    convex = as_convex(robot)
    back = read_bundle(write_bundle(convex, tmp_path / "robots" / convex.name, picture=False))
    for each in (convex, back):
        assert token_shapes(each) == token_shapes(robot)
        assert as_primitives(each, ()).links == as_primitives(robot, ()).links


def test_convex_meshes_and_primitives_stay(tmp_path, monkeypatch):
    path = tmp_path / "ball.stl"
    trimesh.creation.icosphere(2, 0.1).export(path)
    monkeypatch.setattr(module, "decompose", lambda mesh: pytest.fail("decomposed"))
    robot = robot_of(Mesh(path))
    assert as_convex(robot) == robot
    primitive = morphgen.compose("prims", geometry="primitive")
    assert as_convex(primitive) == primitive


def test_meshes_without_pieces_are_errors(bracket, tmp_path, monkeypatch, cache):
    flat = tmp_path / "flat.stl"
    trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (1, 1, 0)], [(0, 1, 2)]).export(flat)
    with pytest.raises(MeshError, match=r"flat\.stl: is flat"):
        as_convex(robot_of(Mesh(flat)))
    monkeypatch.setattr(module, "MAX_SECONDS", 0.01)
    with pytest.raises(FitError, match=r"bracket\.stl: CoACD takes longer than 0\.01 s for .* use"):
        as_convex(robot_of(bracket))
    monkeypatch.setattr(module, "MAX_SECONDS", 60)
    monkeypatch.setattr(module, "SETTINGS", {**module.SETTINGS, "no_such_setting": 1})
    with pytest.raises(FitError, match=r"bracket\.stl: CoACD fails on this mesh: .*no_such_sett"):
        as_convex(robot_of(bracket))
    assert not [path for path in cache.rglob("*") if path.is_file()]


def test_a_mesh_on_which_coacd_aborts_is_remeshed(bracket, monkeypatch):
    run, modes = module._run_coacd, []

    def abort_at_first(mesh, settings):
        modes.append(settings["preprocess_mode"])
        return run(mesh, settings) if len(modes) > 1 else (None, "aborted")

    monkeypatch.setattr(module, "_run_coacd", abort_at_first)
    assert not any(piece.contains(NOTCH[None]).any() for piece in decompose(bracket))
    assert modes == ["auto", "on"]
