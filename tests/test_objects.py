"""Hashes and errors of objects, tables, and hints for unknown names."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.grammars import LIBRARY
from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import CompositionError, nearest
from morphgen.fitting.link_fit import signed_distance
from morphgen.formats.urdf.read import read_urdf
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.compose import compose
from morphgen.grammar.request import parse_request, parse_words
from morphgen.grammar.syntax import Derivation
from morphgen.model.geometry import Cylinder, Pose, Shape
from morphgen.model.inertia import bounding_box
from morphgen.model.robot import Inertial, Joint, Link, Robot
from morphgen.model.rotation import from_rpy
from morphgen.tables import fitted, table
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.articulated import ArticulatedObject, ObjectJoints
from morphgen.tasks.sim.base import Scene

OBJECTS = LIBRARY.names("object")


def corners(name):
    """Return values of parameters: the defaults, all smallest, all largest, and random corners."""
    parameters = LIBRARY.manifest(name).parameters
    ranges = np.array([(each.minimum, each.maximum) for each in parameters.values()])
    drawn = np.random.default_rng(0).integers(2, size=(6, len(ranges)))
    ends = [np.zeros_like(drawn[0]), np.ones_like(drawn[0]), *drawn]
    values = [ranges[np.arange(len(ranges)), row].tolist() for row in ends]
    return [{}, *(dict(zip(parameters, row, strict=True)) for row in values)]


def composed(name, values):
    parameters = LIBRARY.manifest(name).parameters
    complete = {key: values.get(key, each.default) for key, each in parameters.items()}
    return compose(Derivation("object", name, tuple(complete.items())), LIBRARY, name), complete


@pytest.mark.parametrize("name", OBJECTS)
def test_object_is_sound_over_the_ranges_of_its_parameters(name):
    for corner in corners(name):
        body, values = composed(name, corner)
        assert {finding.severity for finding in check(body)} == {"info"}, corner
        thing = ArticulatedObject(body)
        joint, size = thing.joint, values["size"]
        assert joint.effort == 0  # no motor
        assert joint.friction == pytest.approx(values["resistance"] * thing.lever)
        assert joint.damping == pytest.approx(values["damping"] * thing.lever**2)
        low, high = joint.limits
        assert low <= body.home[0] <= high
        # Its links have no contact anywhere, although neighbours are tested by no simulator.
        positions = np.linspace(low, high, 40)[:, None]
        assert not any(SelfCollisionChecker(body, ignore=()).penetrations(positions)), corner
        # The frame is in the shape that is pushed, between faces across its motion.
        assert signed_distance(thing.contact_shapes, np.zeros((1, 3)))[0] < -0.02 * size
        assert thing.extent(np.array([-1.0])) == pytest.approx(thing.extent(np.array([1.0])))
        box, centre = np.array(thing.contact_box) / size
        height = thing.contact[2] / size + centre[2] + np.array([-0.5, 0.5]) * box[2]
        assert height[0] <= 0.46
        assert 0.85 <= height[1] <= 1.0
        assert bounding_box(thing.base_shapes)[0][2] == pytest.approx(0, abs=1e-9)  # the ground


@pytest.mark.parametrize("name", OBJECTS)
def test_urdf_of_an_object_keeps_its_joint(name, tmp_path):
    body, _ = composed(name, {})
    (tmp_path / "a.urdf").write_text(urdf_text(body, str))
    robots = (body, read_urdf(tmp_path / "a.urdf"))
    before, after = (robot.joints[robot.movable_joints[0]] for robot in robots)
    for key in ("limits", "effort", "velocity", "damping", "friction"):
        assert getattr(after, key) == pytest.approx(getattr(before, key)), key


def pushed(thing, sign, size):
    """Return a scene with an upright stick, before it the object, whose joint moves by the sign."""
    yaw = sign * np.pi / 2 - np.arctan2(thing.direction[1], thing.direction[0])
    pose = Pose(quaternion=from_rpy((0.0, 0.0, float(yaw))))
    x, y, height = (pose @ Pose(thing.contact)).position
    placed = ArticulatedObject(thing.body, replace(pose, position=(-x, -y, 0.0)))
    stick = Shape(Cylinder(0.05 * size, 0.4 * size))
    tip = Link("tip", Inertial(0.5, inertia=(0.01, 0, 0, 0.01, 0, 0.01)), collisions=(stick,))
    joint = Joint("y", "prismatic", "base", "tip", Pose((0.0, 0.0, height)), (0.0, 1.0, 0.0))
    joint = replace(joint, limits=(-2 * size, 2 * size), effort=100.0, velocity=2.0)
    return Scene(Robot("stick", (Link("base"), tip), (joint,), home=(-size,)), object=placed)


def test_pushed_objects_move_and_stop_when_they_are_released():
    size = 0.15
    things = [
        (ArticulatedObject(composed(name, {**values, "size": size})[0]), sign)
        for name in OBJECTS
        for values in corners(name)[:3]
        for sign in ((1,) if name == "drawer" else (1, -1))
    ]
    scenes = [pushed(thing, sign, size) for thing, sign in things]
    objects = [scene.object for scene in scenes]
    simulation = SIMULATORS["mujoco"].load(scenes, None, 1, torch.device("cpu"))

    def positions_after(target, steps):
        for _ in range(steps):
            assert not simulation.step(torch.full((len(scenes), 1), target)).any()
        return ObjectJoints(objects).positions(simulation.object_pose.double().numpy())

    assert positions_after(-size, 10) == pytest.approx(0, abs=1e-6)
    moved = positions_after(0.4 * size, 50)
    released = positions_after(-size, 50)
    assert (moved * [sign for _, sign in things] > 0.009).all()
    assert positions_after(-size, 25) == pytest.approx(released, abs=1e-4)
    simulation.close()


@pytest.mark.parametrize("words", [["object=dial", "object.peg=0.1"], ["dial"]])
def test_requests_name_an_object_alone(words):
    derivation, name = parse_words(words, LIBRARY)
    assert str(derivation).startswith("object=dial(size=0.15, ")
    assert name.startswith("dial")
    with pytest.raises(CompositionError, match="an object is no part of a robot"):
        parse_request(["object=dial", "arm=ur5"], LIBRARY)


HEADERS = ("name", "dof", "source", "summary")
ROWS = [("ur5", 6, "rtb-data", "a long arm of six joints"), ("z1", 6, "other", "short")]


@pytest.mark.parametrize("formats", [None, "g"])
def test_a_narrow_table_leaves_columns_out_and_names_them(formats):
    whole = table(ROWS, HEADERS, formats=formats)
    with fitted(1000):
        assert table(ROWS, HEADERS, formats=formats) == whole
    with fitted(30):
        *lines, last = table(ROWS, HEADERS, formats=formats).splitlines()
    for line, narrow in zip(whole.splitlines(), lines, strict=True):
        assert line.startswith(narrow.rstrip())
    assert lines[0].split() == ["name", "dof", "source"]
    assert last == "(--wide shows summary)"
    assert table(ROWS, HEADERS, formats=formats) == whole


def test_a_text_is_shortened_where_that_keeps_its_column():
    with fitted(41):
        lines = table(ROWS, HEADERS).splitlines()
    assert lines[2].split("  ")[-1] == "a long arm of..."
    assert lines[3].split("  ")[-1].strip() == "short"
    assert max(map(len, lines)) <= 41
    assert "--wide" not in lines[-1]


def test_less_important_columns_go_first():
    with fitted(30):
        lines = table(ROWS, HEADERS, last=["dof", "source"]).splitlines()
    assert lines[0].split() == ["name", "summary"]
    assert lines[-1] == "(--wide shows dof, source)"


def test_one_column_remains_and_markdown_is_whole():
    with fitted(12):
        assert len(table(ROWS, HEADERS[::-1])) > 0
        lines = table([row[::-1] for row in ROWS], HEADERS[::-1]).splitlines()
        assert lines[2] == "a l..."
        assert table(ROWS, HEADERS, style="github").count("|") == 4 * 5


def test_long_texts_do_not_take_the_place_of_all_other_columns():
    rows = [("a" * 100, "b" * 100, 1.0, 2.0)]
    with fitted(80):
        lines = table(rows, ("method", "words", "score", "success")).splitlines()
    assert lines[2].split() == ["a" * 37 + "...", "b" * 35 + "..."]
    assert lines[3] == "(--wide shows score, success)"
    with fitted(80):
        lines = table(rows, ("method", "words", "score", "success"), last=["words"]).splitlines()
    assert lines[2].split() == ["a" * 37 + "...", "b" * 15 + "...", "1.0", "2.0"]


def test_titles_of_plain_tables_are_a_row():
    lines = table(ROWS, HEADERS, style="plain").splitlines()
    assert [line.split()[:2] for line in lines] == [["name", "dof"], ["ur5", "6"], ["z1", "6"]]


ARMS = ["jaco2", "jaco2_6dof", "kinova_gen3", "mico", "panda", "ur10", "ur3", "ur5"]
MANY = [*ARMS, *(f"z{number:02}" for number in range(30))]


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("UR5", "; did you mean 'ur5'? nearest of 38: ur10, ur3, ur5"),
        ("pnada", "; did you mean 'panda'?"),
        ("jaco", "; did you mean 'jaco2'? nearest of 38: jaco2, jaco2_6dof"),
        ("gen3", "; did you mean 'kinova_gen3'?"),
        ("NONSENSE", f"; 38 are valid, such as {', '.join(ARMS)}"),
        ("x" * 201, "; 38 are valid"),
    ],
)
def test_a_long_list_shows_only_near_names(name, hint):
    assert nearest(name, MANY) == hint


@pytest.mark.parametrize(
    ("name", "valid", "hint"),
    [
        ("nonsense", ["tongs", "prims"], "; valid: prims, tongs"),
        ("gltf", ["usd", "glb"], "; did you mean 'glb'? valid: glb, usd"),
        ("ur5-plne", ["cartpole"], "; valid: cartpole"),
        ("any", [], "; valid: (none)"),
    ],
)
def test_a_short_list_is_complete(name, valid, hint):
    assert nearest(name, valid) == hint


def test_the_closest_name_may_be_unlisted():
    hint = "; did you mean 'ee.size'? valid: arm, ee"
    assert nearest("ee_size", ["arm", "ee"], ["ee.size"]) == hint
