"""Constants of push, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar


@dataclass(frozen=True)
class PushConfig:
    """Push a block across a line; the episode ends when it is across (paper, B.3)."""

    task: ClassVar[str] = "push"

    steps: int = 300
    """Control steps of an episode at most: 6 s."""
    line: float = 0.2
    """y that the block must cross, metres; scaled down for robots that reach less than 0.4 m."""
    start: float = -0.15
    """y that the block starts below, metres; scaled likewise."""
    start_depth: float = 0.05
    """How far below that at most, uniformly drawn, metres; scaled likewise (the paper gives no
    lower end)."""
    starts: int = 100
    """Number of starts in a robot's push set, as many as goals in a goal set of reach."""
    arm_x: tuple[float, float] = (0.4, 0.6)
    """Range of the block's x at the start for arms, in effective reach beyond the shoulder."""
    free_x: tuple[float, float] = (-0.2, 0.2)
    """The same range for robots that slide freely over the ground, metres; scaled likewise."""
    block_size: tuple[float, float] = (0.15, 0.2)
    """Range of the block's edge: relative to an arm's effective reach, or metres for robots that
    slide."""
    block_mass: float = 0.1
    friction: float = 1.0
    obstacles: int = 3
    """Number of boxes if obstacles are asked for."""
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    """Range of the edges of these boxes, relative to the robot's reach."""
    curriculum_steps: int = 50
    """Number of equal steps in which the line moves during the first half of the training."""
    curriculum_start: float = 0.1
    """Position of the line at the start of the training, relative to its final position."""
    joint_limit_weight: float = 1.0
    distance_weight: float = 1.0
    success_weight: float = 10.0
    approach_weight: float = 0.5
    """Weight of the distance of tool and block: in the released code, not in the paper; never
    scored."""

    @property
    def num_goals(self) -> int:
        """Number of starts in a robot's push set."""
        return self.starts

    def with_num_goals(self, num_goals: int) -> PushConfig:
        """Return the same constants with another number of starts."""
        return replace(self, starts=num_goals)
