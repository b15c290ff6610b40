"""MuJoCo's forward kinematics of a robot, to verify ``morphgen.model.kinematics``."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from morphgen.formats.mjcf.write import to_spec
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array


class MujocoKinematics:
    """The kinematic tree of a robot in MuJoCo, without shapes.

    Attributes:
        model: The compiled model; bodies have the names of links, sites those of frames.
        data: The state of the model at the last configuration.
    """

    def __init__(self, robot: Robot) -> None:
        """Compile a robot."""
        bare = [replace(link, visuals=(), collisions=()) for link in robot.links]
        self._robot = robot
        self.model = to_spec(robot.with_links(bare)).compile()
        self.data = mujoco.MjData(self.model)
        names = (robot.joints[k].name for k in robot.movable_joints)
        self._address = [self.model.joint(name).qposadr[0] for name in names]

    def frame_pose(self, q: Array, frame: str = TOOL) -> Array:
        """Return ``T_root_frame`` at configurations (n, dof), shape (n, 4, 4)."""
        return self._poses(q, self.data.site(frame))

    def link_pose(self, q: Array, link: str) -> Array:
        """Return ``T_root_link`` at configurations (n, dof), shape (n, 4, 4)."""
        return self._poses(q, self.data.body(link))

    def _poses(self, q: Array, view: mujoco.MjData) -> Array:
        T = np.tile(np.eye(4), (len(q), 1, 1))
        for T_root_frame, positions in zip(T, movable_positions(self._robot, q), strict=True):
            self.data.qpos[self._address] = positions
            mujoco.mj_kinematics(self.model, self.data)
            T_root_frame[:3, :3] = view.xmat.reshape(3, 3)
            T_root_frame[:3, 3] = view.xpos
        return T
