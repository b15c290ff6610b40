"""The tool of one robot is brought to poses."""

import numpy as np

from helpers.scenes import robot
from morphgen.rl.baselines.cartesian import OneTool
from morphgen.tasks.bodies import bodies_of


def test_a_tool_that_is_the_wrong_way_round_turns():
    bodies = bodies_of([robot("arm=panda ee=panda_hand")])
    tool, q = OneTool(bodies, 0), np.array([bodies.robots[0].home])
    position, rotation = tool.poses(q)
    turned = rotation @ np.diag([-1.0, -1.0, 1.0])
    q = tool.brought(q, position, turned, 60)
    reached = tool.poses(q)
    assert np.abs(reached[0] - position).max() < 5e-3
    assert np.abs(reached[1] - turned).max() < 0.02
