"""The tool of one robot is brought to poses."""

import numpy as np

from helpers.scenes import robot
from morphgen.rl.baselines.cartesian import OneTool
from morphgen.tasks.robot_tables import build_robot_tables


def test_a_tool_that_is_the_wrong_way_round_turns():
    robot_tables = build_robot_tables([robot("arm=panda ee=panda_hand")])
    tool, q = OneTool(robot_tables, 0), np.array([robot_tables.robots[0].home])
    position, rotation = tool.poses(q)
    turned = rotation @ np.diag([-1.0, -1.0, 1.0])
    q = tool.brought(q, position, turned, 60)
    reached = tool.poses(q)
    assert np.abs(reached[0] - position).max() < 5e-3
    assert np.abs(reached[1] - turned).max() < 0.02
