"""Robots that collide as the convex pieces of their meshes."""

from dataclasses import replace

import pytest
import torch

from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.formats.fits import has_meshes
from morphgen.grammar.library import default_library
from morphgen.tasks.scenes.make import make_batch, with_geometry
from morphgen.tasks.sim.base import Scene

PANDA = "arm=panda ee=panda_hand"


def test_unknown_and_unused_geometries_are_refused():
    with pytest.raises(TaskError, match="geometry 'hull'; valid: convex, primitive"):
        make_batch("reach", ["arm3"], 1, sim="mujoco", geometry="hull")
    with pytest.raises(TaskError, match="'convex': simulator 'kinematic' has no contacts"):
        make_batch("reach", ["arm3"], 1, sim="kinematic", geometry="convex")


def test_convex_robots_collide_as_their_meshes():
    batches = [
        make_batch("push", [PANDA], 2, sim="mujoco", geometry=geometry, seed=4)
        for geometry in ("primitive", "convex")
    ]
    first, other = (batch.reset() for batch in batches)
    assert all(torch.equal(first[name], other[name]) for name in first)
    simulated = batches[1].simulation.scenes[0].robot
    assert batches[1].specs[0].robot.links == batches[0].specs[0].robot.links != simulated.links
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
