"""Robots that collide as the primitives of their tokens."""

from dataclasses import replace

import pytest
import torch

from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.fits import has_meshes
from morphgen.grammar.library import default_library
from morphgen.tasks.scenes.make import make_batch, with_geometry
from morphgen.tasks.sim.base import Scene

PANDA = "arm=panda ee=panda_hand"


def test_a_light_robot_has_the_shape_of_each_token_and_the_same_masses():
    full = robot(PANDA)
    scene, same = with_geometry([Scene(full), Scene(full)], "light")
    light = scene.robot
    assert same.robot is light
    shapes = token_shapes(full)
    assert {link.name: len(link.collisions) for link in light.links if link.collisions} == (
        dict.fromkeys(shapes, 1)
    )
    assert sum(len(link.collisions) for link in full.links) > 3 * len(shapes)
    assert [link.inertial for link in light.links] == [link.inertial for link in full.links]
    assert light.joints == full.joints
    assert with_geometry([scene], "primitive") == [scene]


def test_shapes_that_overlap_at_home_do_not_collide():
    """The robot stays where it is, although its shapes overlap."""
    batch = make_batch("reach", [PANDA], 1, sim="mujoco", geometry="light")
    batch.reset()
    q = batch.simulation.q.clone()
    for _ in range(50):
        batch.simulation.step(q)
    assert (batch.simulation.q - q).abs().max() < 0.01


def test_observations_and_goals_are_those_of_the_whole_robot():
    batches = [
        make_batch("push", [PANDA], 2, sim="mujoco", geometry=geometry, seed=4)
        for geometry in ("primitive", "light")
    ]
    first, other = (batch.reset() for batch in batches)
    assert all(torch.equal(first[name], other[name]) for name in first)
    full, light = (batch.simulation.scenes[0].robot for batch in batches)
    assert light.links != full.links
    assert batches[1].specs[0].robot.links == full.links


def test_unknown_and_unused_geometries_are_refused():
    with pytest.raises(TaskError, match="unknown collision geometry 'lite'; did you mean 'light'"):
        make_batch("reach", ["arm3"], 1, sim="mujoco", geometry="lite")
    with pytest.raises(TaskError, match="'light': simulator 'kinematic' has no contacts"):
        make_batch("reach", ["arm3"], 1, sim="kinematic", geometry="light")


def test_convex_robots_collide_as_their_meshes():
    batches = [
        make_batch("push", [PANDA], 2, sim="mujoco", geometry=geometry, seed=4)
        for geometry in ("primitive", "convex")
    ]
    first, other = (batch.reset() for batch in batches)
    assert all(torch.equal(first[name], other[name]) for name in first)
    simulated = batches[1].simulation.scenes[0].robot
    meshed = [link for link in simulated.links if has_meshes(link.collisions)]
    assert len(meshed) == 9  # the Panda's meshes are convex, so each is its own piece
    assert simulated.joints == batches[0].specs[0].robot.joints


def test_convex_pieces_need_the_meshes():
    composed = robot(PANDA)
    stranger = replace(composed, provenance={})
    with pytest.raises(TaskError, match="'convex' needs its meshes"):
        with_geometry([Scene(stranger)], "convex")
    changed = replace(composed.joints[0], name="renamed")
    with pytest.raises(TaskError, match="'convex' needs its meshes"):
        with_geometry(
            [Scene(replace(composed, joints=(changed, *composed.joints[1:])))],
            "convex",
            default_library().folders,
        )
    simple = robot("prims")
    assert with_geometry([Scene(simple)], "convex")[0].robot is simple
