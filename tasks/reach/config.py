"""Constants of reach, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from morphgen.errors import TaskError
from morphgen.tasks.task import require_task_config


@dataclass(frozen=True)
class ReachConfig:
    """Bring the tool to a goal and keep it there; the episode does not end early (paper, B.3)."""

    task: ClassVar[str] = "reach"
    file_keys: ClassVar[dict[str, str]] = {"max_episode_steps": "steps", "num_goals": "goals"}
    """Keys in files of the fields that have another name there."""

    max_episode_steps: int = 300
    """Duration of an episode, 6 s [control steps]."""
    num_goals: int = 100
    """Number of configurations in a robot's goal set."""
    near: float = 0.03
    """Distance between tool and goal that counts as success (paper, table of rewards) [m]."""
    obstacles: int = 3
    """Number of boxes if obstacles are requested."""
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    """Range of the edge lengths of these boxes, relative to the robot's reach."""
    joint_limit_weight: float = 1.0
    joint_acceleration_weight: float = 1e-5
    distance_weight: float = 1.0
    near_weight: float = 1.0
    """Reward for being near. The paper gives the four reward terms and no weights."""
    score_square: float = 50.0
    """Factor c of the score -c d^2 of a step at distance d from the goal (released evaluation)."""
    score_near: float = 200.0
    """Score of a step near the goal (released evaluation)."""

    def __post_init__(self) -> None:
        """Require constants that describe a reach.

        Raises:
            TaskError: If a constant is out of its range.
        """
        require_task_config(self)
        if not self.near > 0:
            raise TaskError(f"near {self.near:g}: expected a positive distance [m]")
