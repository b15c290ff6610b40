"""The primitive that represents each link in the tokens."""

import json

import pytest
import trimesh

import morphgen
from morphgen.errors import FormatError
from morphgen.fitting import token_shapes as module
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Joint, Link, Robot

FOLDERS = default_library(()).folders


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    folder = tmp_path / "cache"
    monkeypatch.setattr(module, "user_cache_path", lambda name: folder / name)
    return folder


@pytest.fixture
def no_search(monkeypatch):
    def search(shapes):
        raise AssertionError("a fit was searched for")

    monkeypatch.setattr(module, "fit_primitive", search)


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


@pytest.mark.parametrize("words", ["prims", "stick", "chain", "tongs"])
def test_rails_and_masts_without_collision_shapes_have_no_primitive(words):
    robot = morphgen.compose(words)
    shapes = token_shapes(robot)
    seen = {link.name for link in robot.links if link.visuals and not link.collisions}
    assert seen
    assert shapes.keys() == {link.name for link in robot.links if link.collisions}


def test_a_dominant_primitive_represents_the_link(no_search):
    disc, lug = Shape(Cylinder(0.07, 0.05)), Shape(Box((0.02, 0.005, 0.03)), Pose((0.0, 0.0, 0.02)))
    assert token_shapes(robot_of(lug, disc)) == {"body": disc}
    with pytest.raises(AssertionError, match="searched for"):
        token_shapes(robot_of(disc, Shape(Sphere(0.08), Pose((0.05, 0.0, 0.0)))))


def test_library_meshes_need_no_search_even_if_scaled(no_search):
    arm = morphgen.compose("arm=panda")
    larger = morphgen.compose("arm=panda_scaled arm.scale3=1.4")
    plain, scaled = (token_shapes(robot, FOLDERS) for robot in (arm, larger))
    assert len(plain) == len(scaled) > 7
    same, other = (
        [name for name in plain if (plain[name] != scaled[name]) == changed]
        for changed in (False, True)
    )
    assert len(other) == 1
    assert "link2" in other[0]
    assert same
    assert scaled[other[0]] == morphgen.model.geometry.scale_shape(plain[other[0]], 1.4)


def test_a_new_mesh_is_searched_once(monkeypatch, cache):
    shapes = [Shape(Box((0.1, 0.1, 0.4))), Shape(Box((0.1, 0.1, 0.38)), Pose((0.0, 0.0, 0.02)))]
    first = token_shapes(robot_of(*shapes))
    assert isinstance(first["body"].geometry, Box)
    assert max(first["body"].geometry.size) == pytest.approx(0.405, abs=0.01)
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched again"))
    assert token_shapes(robot_of(*shapes)) == first


def test_a_flat_link_has_no_primitive_and_the_result_is_cached(tmp_path, monkeypatch):
    flat = trimesh.Trimesh([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)])
    flat.export(tmp_path / "flat.stl")
    robot = robot_of(Shape(Mesh(tmp_path / "flat.stl")))
    assert token_shapes(robot) == {}
    monkeypatch.setattr(module, "fit_primitive", lambda shapes: pytest.fail("searched again"))
    assert token_shapes(robot) == {}


def test_a_broken_cache_is_an_error(cache):
    shapes = [Shape(Sphere(0.1)), Shape(Sphere(0.1), Pose((0.05, 0.0, 0.0)))]
    token_shapes(robot_of(*shapes))
    (path,) = cache.rglob("*.json")
    path.write_text(json.dumps({"box": [1, 2]}))
    with pytest.raises(FormatError, match=path.name):
        token_shapes(robot_of(*shapes))


def test_a_cache_that_cannot_be_written_is_reported_once(cache, caplog):
    cache.write_text("a file")
    shapes = [Shape(Sphere(0.1)), Shape(Sphere(0.1), Pose((0.05, 0.0, 0.0)))]
    assert token_shapes(robot_of(*shapes))
    assert token_shapes(robot_of(*shapes))
    messages = [record.getMessage() for record in caplog.records]
    assert [f"cannot keep fits in {cache}/morphgen/" in text for text in messages] == [True]
