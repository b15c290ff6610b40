"""Contacts of a robot with the block, and its overhang."""

import numpy as np
import pytest

from helpers.scenes import ball
from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.robot import Link
from morphgen.rl.baselines.push_planner import find_contacts, overhang
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.sim.base import Block, Scene


def test_contacts_are_found_where_the_robot_touches_the_block():
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    q = np.array([[0.0, -0.5], [0.1, -0.5], [1.5, -0.5]])

    def found(height):
        scene = Scene(ball(height), block=Block((0.4, 0.4, 0.4)), ground=None)
        return find_contacts(FreeSpace(scene), q, block, 0.4)

    low = found(0.2)
    assert low.q.tolist() == q[:2].tolist()
    assert low.gap == pytest.approx(0.2, abs=0.002)
    assert low.offset == pytest.approx([0.0, 0.1], abs=0.05)
    assert low.width == pytest.approx(0.5, abs=0.12)
    assert low.overhang.max() == 0
    assert found(0.35).overhang.min() > 0.5


@pytest.mark.parametrize(("ahead", "over"), [(0.01, 0.025), (0.002, 0.005), (-0.01, 0.0)])
def test_the_overhang_of_a_brim_is_its_lead(ahead, over):
    """A box that touches the block below its middle, and a brim at its upper edge."""
    foot = Shape(Box((0.2, 0.1, 0.1)))
    brim = Shape(Box((0.2, 0.1, 0.02)), Pose((0.0, ahead, 0.3)))
    wide = ball(0.1).with_links([Link("ball", collisions=(foot, brim))])
    scene = Scene(wide, block=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = find_contacts(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.gap[0] == pytest.approx(0.25 - max(ahead, 0), abs=0.002)
    assert found.overhang[0] == pytest.approx(over, abs=0.0035)

    beyond = np.array([[0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]])
    each = overhang(FreeSpace(scene), np.array([[0.0, -0.5]] * 2), beyond, 0.4)
    assert each[0] == found.overhang[0]
    assert each[1] == 0


def test_the_contact_of_a_plate_is_as_wide_as_the_plate():
    plate = Link("ball", collisions=(Shape(Box((0.8, 0.02, 0.3))),))
    wide = ball(0.2).with_links([plate])
    scene = Scene(wide, block=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = find_contacts(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.width[0] == 1
