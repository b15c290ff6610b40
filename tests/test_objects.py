"""The articulated objects: over the ranges of their parameters, alone and pushed in a scene."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.grammars import LIBRARY
from morphgen.checks import check
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import CompositionError
from morphgen.fitting.quality import signed_distance
from morphgen.formats.urdf.read import read_urdf
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.request import parse_request, parse_words
from morphgen.model.geometry import Cylinder, Pose, Shape
from morphgen.model.inertia import bounding_box
from morphgen.model.robot import Inertial, Joint, Link, Robot
from morphgen.model.rotation import from_rpy
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.articulated import ArticulatedObject, ObjectJoints
from morphgen.tasks.sim.base import Scene

OBJECTS = LIBRARY.names("object")


def corners(name):
    """Return values of parameters: the defaults, all smallest, all largest, and random corners."""
    parameters = LIBRARY.manifest(name).parameters
    ends = np.random.default_rng(0).integers(2, size=(6, len(parameters)))
    return [
        {},
        *(
            {
                key: each.maximum if end else each.minimum
                for (key, each), end in zip(parameters.items(), row, strict=True)
            }
            for row in ([0] * len(parameters), [1] * len(parameters), *ends.tolist())
        ),
    ]


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
    before, after = (
        robot.joints[robot.movable_joints[0]] for robot in (body, read_urdf(tmp_path / "a.urdf"))
    )
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
