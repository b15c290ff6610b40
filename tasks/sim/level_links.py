"""Links that no joint raises, lowers or tilts: they meet the ground as at first, whatever happens.

A contact of such a link with the ground is one that no force can change, and simulators cope badly.
PyBullet makes one within 2 cm already, and light joints farther along the arm are then tenths of a
radian off, with any number of iterations. MuJoCo (4.0) takes an upright cylinder whose axis is a
few last bits longer than one for one that is a radius deep in the plane. So neither tests them
against the ground.
"""

from __future__ import annotations

import numpy as np

from morphgen.model.geometry import Pose
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot

_UPRIGHT = 1e-6
"""How far the vertical part of an axis may be from 0 or 1 that is horizontal or vertical."""


def level_links(robot: Robot, T_world_root: Pose) -> frozenset[str]:
    """The root, and links that turn about vertical axes and slide along horizontal ones at most.

    Args:
        robot: The body.
        T_world_root: Where it stands; the world's z is up.
    """
    T_world_link = T_world_root.matrix @ forward_kinematics(robot, np.array(robot.home))
    level = {robot.root.name}
    for k, joint in enumerate(robot.joints):
        if joint.is_movable:
            upward = abs(float(T_world_link[k + 1, 2, :3] @ np.array(joint.unit_axis)))
            steady = upward < _UPRIGHT if joint.kind == "prismatic" else upward > 1 - _UPRIGHT
        else:
            steady = True
        if steady and joint.parent in level:
            level.add(joint.child)
    return frozenset(level)
