"""The tool is brought where it can go."""

import numpy as np
import pytest

from morphgen.grammar.compose import compose
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.model.kinematics import bounds, frame_pose
from morphgen.viewer.inverse_kinematics import frame_jacobian, solve
from robots import arm

LIBRARY = default_library()


def robot_of(words):
    derivation, name = parse_words(words.split(), LIBRARY)
    return compose(derivation, LIBRARY, name)


@pytest.mark.parametrize("words", ["arm=ur5 ee=plane", "base=gantry ee=stick", "arm=panda"])
def test_the_jacobian_is_the_derivative(words):
    robot = robot_of(words)
    q = np.array(robot.home) * 0.9
    T, jacobian = frame_jacobian(robot, q)
    assert pytest.approx(frame_pose(robot, q)) == T
    for k in range(robot.dof):
        step = np.zeros(robot.dof)
        step[k] = 1e-6
        moved = (frame_pose(robot, q + step) - frame_pose(robot, q - step)) / 2e-6
        spin = moved[:3, :3] @ T[:3, :3].T
        assert jacobian[:3, k] == pytest.approx(moved[:3, 3], abs=1e-6)
        assert jacobian[3:, k] == pytest.approx([spin[2, 1], spin[0, 2], spin[1, 0]], abs=1e-6)


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
