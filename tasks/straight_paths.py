"""Straight paths of the joints that hit nothing, in the current scenes of a batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from morphgen.tasks.episode_layouts import EpisodeLayouts
from morphgen.tasks.free_space import FreeSpace
from morphgen.typing import Array

SAME = 0.02
"""Largest difference of joints between configurations that count as the same [rad or m]."""
COMPARED = 12
"""Number of different configurations whose paths are tested."""


class StraightPaths:
    """Finds the first configuration that a robot reaches on a straight path without a collision.

    Links, the ground and the obstacles of the running episode count; see ``FreeSpace``.
    """

    def __init__(self, layouts: EpisodeLayouts, env_robot_index: torch.Tensor) -> None:
        """Prepare tests in all environments; a robot's scene is compiled when it is first used.

        Args:
            layouts: Scenes of the environments.
            env_robot_index: Robot of each environment, shape (n,), int64.
        """
        self._layouts, self._robots = layouts, env_robot_index.tolist()
        self._spaces: dict[int, FreeSpace] = {}

    def __call__(self, env: int, start: Array, ends: Array) -> int | None:
        """Return the index of the first end with a free path, or None.

        Args:
            env: The environment.
            start: Configuration, shape (J,) [rad or m], with padding.
            ends: Configurations in the order of preference, shape (k, J).
        """
        space = self.space(env)
        dof = space.scene.robot.dof
        tested: list[Array] = []
        for i, end in enumerate(ends[:, :dof]):
            if any(np.abs(end - other).max() < SAME for other in tested):
                continue
            if space.free_fraction(start[:dof], end) == 1:
                return i
            tested.append(end)
            if len(tested) == COMPARED:
                break
        return None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, which compiles the scenes again."""
        return vars(self) | {"_spaces": {}}

    def space(self, env: int) -> FreeSpace:
        """Return the scene of an environment, with its obstacles at their current poses."""
        robot = self._robots[env]
        if robot not in self._spaces:
            self._spaces[robot] = FreeSpace(self._layouts.scene(env))
        elif obstacles := self._layouts.obstacles(env):
            self._spaces[robot].place_obstacles([obstacle.pose for obstacle in obstacles])
        return self._spaces[robot]
