"""Constants of the tasks, each with its source; "paper" is AnyBody, arXiv 2505.14986.

Those of tasks with articulated objects are ours, as AnyBody has no such task.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from morphgen.errors import TaskError, nearest
from morphgen.tasks.registry import GOAL_KINDS
from morphgen.tasks.task import ObjectTaskConfig, TaskConfig


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


@dataclass(frozen=True)
class ArticulatedConfig(ObjectTaskConfig):
    """Move the joint of an object by a distance or an angle, to the side that the start says.

    The episode ends when it is there.
    """

    file_keys: ClassVar[dict[str, str]] = {"max_episode_steps": "steps", "num_goals": "starts"}

    max_episode_steps: int = 300
    """Time limit of an episode, 6 s as for push [control steps]."""
    num_goals: int = 100
    """Number of starts in a robot's set."""
    object: str = "drawer"
    """Part of kind ``object``: one of morphgen's, or of a folder of ``MORPHGEN_LIBRARY``."""
    travel: float = 0.12
    """Change of the joint's position that is a success [m or rad]; in metres it is scaled down for
    robots that reach less than 0.4 m."""
    size: tuple[float, float] = (0.15, 0.2)
    """Range of the object's ``size``, as of push's block: relative to an arm's effective reach, or
    for robots that slide in metres."""
    arm_x: tuple[float, float] = (0.4, 0.6)
    """Range of the contact point's x for arms, in effective reaches beyond the shoulder."""
    free_x: tuple[float, float] = (-0.2, 0.2)
    """The same range for robots that slide freely over the ground, scaled as ``travel`` [m]."""
    y: tuple[float, float] = (-0.15, 0.15)
    """Range of the contact point's y, scaled likewise [m]."""
    friction: float = 1.0
    """Friction coefficient of the object's surfaces, as of push's block."""
    curriculum_steps: int = 50
    """Number of equal steps in which the travel grows during the first half of the training."""
    curriculum_start: float = 0.1
    """Travel at the start of the training, relative to its final value."""
    joint_limit_weight: float = 1.0
    distance_weight: float = 1.0
    success_weight: float = 10.0
    approach_weight: float = 0.5
    """Weights of the reward terms, those of push."""

    def __post_init__(self) -> None:
        super().__post_init__()
        low, high = self.size
        if not (self.travel > 0 and 0 < low <= high and self.friction >= 0):
            raise TaskError(
                f"{type(self).__name__}: an object of {low:g} to {high:g} with friction "
                f"{self.friction:g}, to be moved by {self.travel:g}: expected positive numbers"
            )
        for name in ("arm_x", "free_x", "y"):
            least, most = getattr(self, name)
            if least > most:
                raise TaskError(f"{type(self).__name__}: {name} ({least:g}, {most:g}) is no range")


@dataclass(frozen=True)
class DrawerConfig(ArticulatedConfig):
    """A tray on a rail with a bar handle, to be pulled or pushed."""

    task: ClassVar[str] = "drawer"


@dataclass(frozen=True)
class DoorConfig(ArticulatedConfig):
    """A panel on a vertical hinge, to be turned by 45 degrees to either side."""

    task: ClassVar[str] = "door"
    object: str = "door"
    travel: float = math.pi / 4


@dataclass(frozen=True)
class DialConfig(ArticulatedConfig):
    """A disc that lies on the ground, to be turned by 90 degrees with its peg."""

    task: ClassVar[str] = "dial"
    object: str = "dial"
    travel: float = math.pi / 2
