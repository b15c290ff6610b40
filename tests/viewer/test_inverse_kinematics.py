"""The tool is brought where it can go."""

import numpy as np
import pytest

from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.model.kinematics import bounds, frame_pose
from morphgen.viewer.inverse_kinematics import solve
from robots import arm

LIBRARY = default_library()


def robot_of(words):
    derivation, name = parse_words(words.split(), LIBRARY)
    return compose(derivation, LIBRARY, name)


@pytest.mark.parametrize("seed", range(5))
def test_a_near_pose_is_reached(seed):
    robot = robot_of("arm=ur5 ee=plane")
    rng = np.random.default_rng(seed)
    q = np.array(robot.home)
    goal = frame_pose(robot, q + rng.uniform(-0.4, 0.4, robot.dof))
    found = solve(robot, goal, q)
    assert frame_pose(robot, found) == pytest.approx(goal, abs=2e-3)


def test_what_is_out_of_reach_is_approached_within_the_limits():
    robot = arm()
    goal = np.eye(4)
    goal[:3, 3] = (0.0, 0.0, 5.0)
    found = solve(robot, goal, robot.home, turn=0.0)
    low, high = bounds(robot).T
    assert (found >= low).all()
    assert (found <= high).all()
    assert frame_pose(robot, found)[2, 3] > frame_pose(robot, robot.home)[2, 3]
