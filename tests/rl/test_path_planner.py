"""Ways between configurations that touch nothing, and which of them are taken."""

from itertools import pairwise

import numpy as np
import pytest

from helpers.scenes import ball
from morphgen.model.geometry import Pose
from morphgen.rl.baselines.path_planner import STRIDE, FreeWays, Price
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.sim.base import Block, Scene

NO_HURRY = np.array([np.inf, np.inf])
UR5, PANDA = "arm=ur5 ee=plane", "arm=panda ee=panda_hand"


def test_ways_go_round_what_is_in_between():
    wall = Block((0.2, 2.0, 0.4), Pose((0.0, -1.0, 0.2)))
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=(wall,))
    space, step = FreeSpace(scene), np.array([0.02, 0.02])
    ways = FreeWays(space, step, np.random.default_rng(0))
    start, ends = np.array([-0.5, -0.5]), np.array([[0.5, -0.5], [-0.5, 0.5]])
    block = np.array([1.5, 1.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert ways.steps(start, ends) == pytest.approx([50, 50])
    nearest = ways.find(start, ends, block=block)
    assert nearest.end == 1
    assert len(nearest.points) == 1
    over = ways.find(start, ends[:1], vias=np.array([[0.5, 0.5]]), block=block)
    assert over.end == 0
    assert len(over.points) >= 2
    for a, b in zip((start, *over.points), over.points, strict=False):
        between = a + np.linspace(0, 1, 99)[:, None] * (b - a)
        assert space.free(between).all()
    inside = np.array([[0.0, -0.5]])
    assert ways.find(start, inside, block=block) is None
    on_the_end = np.array([-0.5, 0.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert ways.find(start, ends[1:], block=on_the_end) is None
    assert ways.find(start, ends[1:]).points[-1].tolist() == ends[1].tolist()


def test_a_way_round_about_is_found_where_no_simple_one_is():
    """Out of a pocket that is open to the other side, to the nearer of two ends that is free."""
    walls = (
        Block((0.1, 1.2, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, 0.6, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, -0.6, 0.2))),
    )
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=walls)
    space = FreeSpace(scene)
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    start, ends = np.array([0.2, 0.0]), np.array([[0.5, 0.0], [1.0, 0.0]])
    found = ways.find_round_about(start, ends)
    assert found.end == 1
    assert found.points[-1].tolist() == [1.0, 0.0]
    for a, b in pairwise((start, *found.points)):
        assert space.free(a + np.linspace(0, 1, 199)[:, None] * (b - a)).all()
    again = ways.find_round_about(start, ends)
    assert all((a == b).all() for a, b in zip(found.points, again.points, strict=True))
    assert ways.find_round_about(start, ends[:1]) is None
    assert ways.find_round_about(start, ends[:0]) is None


def test_ends_are_got_to_along_a_tree_if_it_grows_there():
    """Of two ends the cheaper is behind a wall without a gap."""
    walls = (
        Block((0.1, 4.5, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((0.1, 1.0, 0.4), Pose((-0.3, 0.0, 0.2))),
    )
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=walls)
    space = FreeSpace(scene)
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    start, ends = np.array([0.0, 0.0]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    tree = ways.explored(start, 400, block=block)
    assert max(q[0] for q in tree.nodes) < 0.5
    price = Price(np.array([0.0, 500.0]), NO_HURRY)
    found = ways.find_along(tree, ends, vias=ends, price=price, block=block)
    assert found.end == 1
    assert found.points[-1].tolist() == [-1.0, 0.0]
    for a, b in pairwise((start, *found.points)):
        assert space.free(a + np.linspace(0, 1, 199)[:, None] * (b - a)).mean() > 0.95
    assert ways.length(start, found) >= 50
    one = Price(np.zeros(1), NO_HURRY[:1])
    assert ways.find_along(tree, ends[:1], vias=ends, price=one, block=block) is None
    none = np.zeros((0, 2))
    nothing = Price(np.zeros(0), np.zeros(0))
    assert ways.find_along(tree, none, vias=none, price=nothing, block=block) is None


def test_of_the_ways_along_a_tree_it_is_the_one_that_costs_least():
    """Not the one to the end that costs least itself, which is far."""
    space = FreeSpace(Scene(ball(0.2), block=Block((0.1, 0.1, 0.1))))
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    tree = ways.explored(np.array([0.0, 0.0]), 400, block=block)
    ends, costs = np.array([[1.8, 1.8], [0.3, 0.0]]), np.array([0.0, 40.0])

    def end(costs, left):
        return ways.find_along(tree, ends, vias=ends, price=Price(costs, left), block=block).end

    assert end(costs, NO_HURRY) == 1
    assert end(3 * costs, NO_HURRY) == 0
    assert end(3 * costs, np.array([70.0, 70.0])) == 1, "the other is too far for what is left"


def test_ways_that_take_longer_than_there_is_time_come_last():
    space = FreeSpace(Scene(ball(0.2), block=Block((0.1, 0.1, 0.1))))
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    start, ends = np.array([0.0, 0.0]), np.array([[1.0, 0.0], [0.3, 0.0]])

    def end(left):
        price = Price(np.array([0.0, 100.0]), np.array(left))
        return ways.find(start, ends, price=price, block=block).end

    assert end([np.inf, np.inf]) == 0
    assert end([51.0, 0.0]) == 0
    assert end([40.0, 40.0]) == 1
    assert end([-30.0, -30.0]) == 0, "both are far too late"


@pytest.mark.parametrize("far", [0.0, 0.03, 0.0501, 0.0999, 0.1499, 0.52, 0.999])
def test_no_two_configurations_that_are_tested_are_farther_apart_than_the_stride(far):
    class Noting(FreeSpace):
        tested = None

        def free(self, q, blocks=None):
            self.tested = np.array(q)
            return super().free(q, blocks)

    space = Noting(Scene(ball(0.2), block=Block((0.1, 0.1, 0.1))))
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    start = np.array([-0.5, -0.5])
    end = start + np.array([far, far / 3])
    assert ways.find(start, end[None]) is not None
    assert space.tested[[0, -1]] == pytest.approx(np.array([end, start]))
    assert np.abs(np.diff(space.tested, axis=0)).max() <= STRIDE + 1e-12
