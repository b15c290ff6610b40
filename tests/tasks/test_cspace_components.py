"""Connected components of free configuration space, and goals in the largest one."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from helpers.goal_sets import draw_goals
from helpers.scenes import ball, robot
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Box, Pose, Shape, Sphere
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Link
from morphgen.tasks.free_space import FreeSpace, cspace_components, in_other_component
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.task import REACH
from morphgen.tasks.sim.base import Scene

ACROSS = ((0.5, 0.0), (0.12, 6.0))
GAP = (((0.5, -1.2), (0.1, 2.0)), ((0.5, 1.2), (0.1, 2.0)))
HERE, THERE = np.array([-1.5, 1.0]), np.array([1.5, 1.0])


def walled(*walls):
    """A ball on slides, among walls: (x, y) of their middles and edges.

    The cart has a shape, far above, lest ball and base are neighbours, which may touch.
    """
    shapes = tuple(Shape(Box((*edges, 0.4)), Pose((*middle, 0.2))) for middle, edges in walls)
    above = Shape(Sphere(0.01), Pose((0.0, 0.0, 5.0)))
    links = [Link("base", collisions=shapes), Link("cart", collisions=(above,))]
    return ball(0.2).with_links(links)


def hinged(kind, *walls):
    """The same robot with a hinge as first joint, so that the ball circles the origin."""
    body = walled(*walls)
    first, second = body.joints
    limits = None if kind == "continuous" else (-2 * math.pi, 2 * math.pi)
    turning = replace(first, kind=kind, axis=(0.0, 0.0, 1.0), limits=limits)
    sliding = replace(second, axis=(1.0, 0.0, 0.0), limits=(0.6, 1.2))
    return replace(body, joints=(turning, sliding), home=(0.0, 0.9))


def test_wall_splits_the_joint_range():
    body = walled(ACROSS)
    (component,) = cspace_components(body)
    assert component.pairs == (("ball", "base"),)
    assert component.joints == (0, 1)
    assert in_other_component([component], THERE).tolist() == [True]
    assert in_other_component([component], HERE).tolist() == [False]
    for x, far in ((0.33, False), (0.67, True)):
        assert FreeSpace(Scene(body)).free([[x, 0.0]])[0]
        assert in_other_component([component], np.array([x, 0.0]))[0] == far


@pytest.mark.parametrize("walls", [(), GAP])
def test_passable_obstacle_does_not_split_the_range(walls):
    assert cspace_components(walled(*walls)) == ()


def test_continuous_joint_wraps_around():
    """Two walls split a continuous joint; with joint limits one wall is enough."""
    left, right = ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0))
    assert cspace_components(hinged("continuous", left)) == ()
    body = hinged("continuous", left, right)
    components = cspace_components(body)
    assert in_other_component(components, np.array([math.pi - 0.1, 0.9])).all()
    assert in_other_component(components, np.array([0.1 - math.pi, 0.9])).all()
    assert not in_other_component(components, np.array([0.5, 0.9])).any()


def test_ranges_of_full_turns_are_not_split():
    """For a hinge with two turns, the angle matters and not the turn."""
    body = hinged("revolute", ((-0.3, 0.9), (0.1, 1.0)), ((-0.3, -0.9), (0.1, 1.0)))
    found = cspace_components(body)
    for turns in (-1, 0):
        assert not in_other_component(found, np.array([0.5 + 2 * math.pi * turns, 0.9])).any()
    assert in_other_component(found, np.array([math.pi, 0.9])).all()


@pytest.mark.parametrize("words", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"])
def test_library_robots_have_one_component(words):
    assert cspace_components(robot(words)) == ()


def test_goals_are_in_the_larger_component(tmp_path):
    body = walled(ACROSS)
    both, _ = FreeSpace(Scene(body)).sample(40, np.random.default_rng(0))
    assert 5 < (both[:, 0] > 0.5).sum() < 35
    goals = draw_goals(body, ReachConfig(num_goals=40), obstacles=False, seed=0, cache=tmp_path)
    assert (goals.q[:, 0] < 0.5).all()
    assert goals.accepted == 40 < goals.tried
    few = draw_goals(body, ReachConfig(num_goals=7), obstacles=False, seed=0, cache=tmp_path)
    assert (few.q == goals.q[:7]).all()
    assert REACH.certify(goals, body, Scene(body)) == []


def test_too_few_goals_error_counts_the_unreachable_ones():
    space = FreeSpace(Scene(walled(ACROSS)))
    with pytest.raises(BenchmarkError) as caught:
        space.sample(1, np.random.default_rng(0), lambda q: False)
    said = re.search(
        r"only 0 of 1,000 .* free of collisions and (\d+) more are, but cut", str(caught.value)
    )
    q = random_configurations(space.scene.robot, 1000, np.random.default_rng(0))
    assert int(said[1]) == space.free(q).sum() > 100


def test_certificate_detects_goals_in_another_component(tmp_path):
    goals = draw_goals(
        ball(0.2), ReachConfig(num_goals=12), obstacles=False, seed=0, cache=tmp_path
    )
    body = walled(ACROSS)
    lines = REACH.certify(goals, body, Scene(body))
    there = [i for i, q in enumerate(goals.q) if q[0] > 0.65]
    assert there
    said = "'ball' and 'base' touch on every path to most others"
    assert [line for line in lines if "touch" in line] == [f"goal {i}: {said}" for i in there]


def test_joints_that_do_not_move_the_tool_are_not_split():
    body = walled(ACROSS)
    (frame,) = body.frames
    assert cspace_components(replace(body, frames=(replace(frame, link="cart"),))) == ()
