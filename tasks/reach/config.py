"""Constants of reach, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from morphgen.errors import TaskError, nearest
from morphgen.tasks.reach import GOAL_KINDS
from morphgen.tasks.task import TaskConfig


@dataclass(frozen=True)
class ReachConfig(TaskConfig):
    """Bring the tool to a goal and keep it there; the episode does not end early (paper, B.3)."""

    task: ClassVar[str] = "reach"
    file_keys: ClassVar[dict[str, str]] = {"max_episode_steps": "steps", "num_goals": "goals"}

    max_episode_steps: int = 300
    """Duration of an episode, 6 s [control steps]."""
    num_goals: int = 100
    """Number of configurations in a robot's goal set."""
    near: float = 0.03
    """Distance between tool and goal that counts as success (paper, table of rewards) [m]."""
    obstacles: int = 3
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    train_layouts: int = 20
    eval_layouts: int = 10
    joint_limit_weight: float = 1.0
    joint_acceleration_weight: float = 1e-5
    distance_weight: float = 1.0
    near_weight: float = 1.0
    """Reward for being near. The paper gives the four reward terms and no weights."""
    score_square: float = 50.0
    """Factor c of the score -c d^2 of a step at distance d from the goal (released evaluation)."""
    score_near: float = 200.0
    """Score of a step near the goal (released evaluation)."""
    goal: str = "position"
    """Kind of the goal, of ``GOAL_KINDS``: a position (paper) or a pose for the tool to reach. The
    goal sets are the same: each goal is a full pose, which a configuration reaches."""
    near_angle: float = math.radians(10)
    """With goal ``pose``: angle between tool and goal that counts as success, together with
    ``near`` (ours) [rad]."""
    rotation_weight: float = 1.0
    """With goal ``pose``: weight of the angle between tool and goal, which is converted to a
    distance by ``metres_per_radian`` (ours)."""

    @property
    def metres_per_radian(self) -> float:
        """Distance that weighs as much as an angle of 1 rad: both tolerances weigh the same [m]."""
        return self.near / self.near_angle

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.near > 0:
            raise TaskError(f"near {self.near:g}: expected a positive distance [m]")
        if self.goal not in GOAL_KINDS:
            raise TaskError(f"unknown goal of reach {self.goal!r}{nearest(self.goal, GOAL_KINDS)}")
        if not 0 < self.near_angle <= math.pi:
            raise TaskError(f"near_angle {self.near_angle:g}: expected more than 0, up to pi [rad]")
