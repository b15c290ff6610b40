"""Constants of tasks with articulated objects; all are ours, as AnyBody has no such task."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from morphgen.errors import TaskError
from morphgen.tasks.task import ObjectTaskConfig


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
