"""Constants of reach, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar


@dataclass(frozen=True)
class ReachConfig:
    """Bring the tool to a goal and keep it there; the episode does not end early (paper, B.3)."""

    task: ClassVar[str] = "reach"

    steps: int = 300
    """Control steps of an episode: 6 s."""
    goals: int = 100
    """Number of configurations in a robot's goal set."""
    near: float = 0.03
    """Distance of tool and goal that counts as success, metres (paper, table of rewards)."""
    obstacles: int = 3
    """Number of boxes if obstacles are asked for."""
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    """Range of the edges of these boxes, relative to the robot's reach."""
    joint_limit_weight: float = 1.0
    joint_acceleration_weight: float = 1e-5
    distance_weight: float = 1.0
    near_weight: float = 1.0
    """Weight of being near. The paper gives the four reward terms and no weights."""
    score_square: float = 50.0
    score_near: float = 200.0
    """``anybody_score`` of a step: -50 d^2, or +200 where near (the released evaluation)."""

    @property
    def num_goals(self) -> int:
        """Number of goals in a robot's goal set."""
        return self.goals

    def with_num_goals(self, num_goals: int) -> ReachConfig:
        """Return the same constants with another number of goals."""
        return replace(self, goals=num_goals)
