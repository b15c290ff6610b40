"""Ways to name a robot, and error messages for unknown names."""

from pathlib import Path

import pytest

import morphgen
from helpers.robots import arm
from morphgen.benchmark.robot_hash import robot_hash
from morphgen.errors import CompositionError, FormatError, PartError
from morphgen.formats.urdf.write import urdf_text
from morphgen.model.geometry import Mesh
from morphgen.tasks.scenes.env_specs import load_robot


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("gantry-cube", "base=gantry ee=cube"),
        ("arm3-stick", "arm=arm3 ee=stick"),
        ("pedestal-arm3-stick", "base=pedestal arm=arm3 ee=stick"),
        ("z1", "arm=z1"),
        ("prims", "prims"),
        ("chain beads=4", "chain beads=4"),
        ("arm=arm3 ee=stick ee.length=0.3", "arm=arm3 ee=stick ee.length=0.3"),
    ],
)
def test_names_are_compose_arguments(given, words):
    expected = morphgen.compose(words, geometry="primitive")
    assert load_robot(given).name == expected.name
    assert robot_hash(load_robot(given)) == robot_hash(expected)


def test_loaded_robot_differs_only_in_collision_shapes():
    robot = morphgen.compose("arm=ur5 ee=plane")
    assert load_robot(robot, geometry="mesh") is robot
    assert robot_hash(load_robot(robot)) == robot_hash(load_robot("arm=ur5 ee=plane"))


def test_collision_shapes_are_primitives_by_default():
    def has_meshes(robot):
        shapes = (shape for link in robot.links for shape in link.collisions)
        return any(isinstance(shape.geometry, Mesh) for shape in shapes)

    assert not has_meshes(load_robot("ur5-plane"))
    assert has_meshes(load_robot("ur5-plane", geometry="mesh"))


def test_robot_files_are_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    folder = morphgen.write(arm(), "bundles", picture=False)
    Path("own.urdf").write_text(urdf_text(arm(), str))
    for given in (folder, str(folder), "bundles/arm", "own.urdf", Path("own.urdf")):
        assert load_robot(given).dof == arm().dof
        assert load_robot(given).frame("tool")
    Path("lr=3").mkdir()
    Path("own.urdf").rename("lr=3/own.urdf")
    assert load_robot("lr=3/own.urdf").dof == arm().dof


def test_folder_that_is_not_a_bundle_does_not_hide_a_grammar(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("prims").mkdir()
    assert load_robot("prims").name == "prims"


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ("ur5-plain", CompositionError, "'plain' is not a part; did you mean 'plane'?"),
        ("prismz", CompositionError, "did you mean 'prims'?"),
        ("chian beads=4", CompositionError, "did you mean 'chain'?"),
        ("bead", CompositionError, "'bead' is a segment, which only a grammar can use"),
        ("ur5-ur10", CompositionError, "arm is given twice: ur5 and ur10"),
        ("arm=ur5 ee=plain", PartError, "did you mean 'plane'?"),
        ("robots/missing", FormatError, "robots/missing: no such file"),
        ("missing.urdf", FormatError, "missing.urdf: no such file"),
        (Path("missing"), FormatError, "missing: no such file"),
        (" ", CompositionError, "no robot is named"),
    ],
)
def test_unknown_name_suggests_the_nearest(given, error, says):
    with pytest.raises(error) as caught:
        load_robot(given)
    assert says in str(caught.value)
