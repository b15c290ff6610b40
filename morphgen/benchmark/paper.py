"""What AnyBody (arXiv 2505.14986) says of its train sets, to put ours beside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

SOURCE = "AnyBody (arXiv 2505.14986), table 'Statistics about benchmark tasks'"


@dataclass(frozen=True)
class Figures:
    """A row of the paper's table: means over the train robots."""

    title: str
    """As the paper calls the set."""
    links: float
    movable: float
    movable_to_tool: float | None
    """None where the paper has a dash."""
    cosine: float
    """Mean over test and train robots."""


PAPER: Mapping[str, Figures] = MappingProxyType(
    {
        "interpolation/arm3": Figures("Arm-3", 10, 9, 4, 0.80),
        "interpolation/panda": Figures("Panda", 11, 9, 7, 0.76),
        "composition/ee-arm": Figures("EE Arm", 8.5, 5.9, 5.6, 0.47),
        "composition/ee-task": Figures("EE-Task", 7.75, 5.25, None, 0.49),
        "extrapolation/primitives": Figures("Primitives", 6.60, 4.60, 4.60, 0.45),
        "extrapolation/arms": Figures("Robot Arms", 14.70, 8.5, 6.6, 0.42),
    }
)
"""The paper's figures by the set of robots: a scenario's name without its task."""


def figures_of(split: str) -> Figures | None:
    """The paper's figures for a scenario, such as ``extrapolation/arms/reach``; None if none."""
    return PAPER.get(robot_set(split))


def robot_set(split: str) -> str:
    """The robots of a scenario: its name without the task, which other tasks share."""
    return "/".join(split.split("/")[:2])
