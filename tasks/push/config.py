"""Constants of push, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from morphgen.errors import TaskError
from morphgen.tasks.task import ObjectTaskConfig


@dataclass(frozen=True)
class PushConfig(ObjectTaskConfig):
    """Push a block across a line; the episode ends when it is across (paper, B.3)."""

    task: ClassVar[str] = "push"
    file_keys: ClassVar[dict[str, str]] = {"max_episode_steps": "steps", "num_goals": "starts"}

    max_episode_steps: int = 300
    """Time limit of an episode, 6 s [control steps]."""
    line: float = 0.2
    """y that the block must cross, scaled down for robots that reach less than 0.4 m [m]."""
    start: float = -0.15
    """Largest y of the block at the start, scaled likewise [m]."""
    start_depth: float = 0.05
    """Extent of the range of y below ``start``, scaled likewise (not given in the paper) [m]."""
    num_goals: int = 100
    """Number of starts in a robot's push set, as many as goals in a goal set of reach."""
    arm_x: tuple[float, float] = (0.4, 0.6)
    """Range of the block's x at the start for arms, in effective reaches beyond the shoulder."""
    free_x: tuple[float, float] = (-0.2, 0.2)
    """The same range for robots that slide freely over the ground, scaled likewise [m]."""
    block_size: tuple[float, float] = (0.15, 0.2)
    """Range of the block's edge length: relative to an arm's effective reach, or for robots that
    slide in metres."""
    block_mass: float = 0.1
    """Mass of the block [kg]."""
    friction: float = 1.0
    """Friction coefficient of the block."""
    obstacles: int = 3
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    train_layouts: int = 20
    eval_layouts: int = 10
    curriculum_steps: int = 50
    """Number of equal steps in which the line moves during the first half of the training."""
    curriculum_start: float = 0.1
    """Position of the line at the start of the training, relative to its final position."""
    joint_limit_weight: float = 1.0
    distance_weight: float = 1.0
    success_weight: float = 10.0
    approach_weight: float = 0.5
    """Weight of the distance between tool and block: in the released code, not in the paper; never
    part of the score."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.block_size
        if not (self.block_mass > 0 and self.friction >= 0):
            raise TaskError(
                f"a block of {self.block_mass:g} kg with friction {self.friction:g}: expected a "
                "positive mass and no negative friction"
            )
        nearest_line = min(self.line, self.line * self.curriculum_start)
        if not (0 < low <= high < math.inf and self.start < nearest_line and self.start_depth >= 0):
            raise TaskError(
                f"a block of {low:g} to {high:g} that starts {self.start_depth:g} below "
                f"{self.start:g} and is to cross {self.line:g}: sizes must be positive, and the "
                "start before the line"
            )
