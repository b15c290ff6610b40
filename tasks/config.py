"""Constants of the tasks, each with its source; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from dataclasses import dataclass

from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP

CONTROL_PERIOD = TIMESTEP * SUBSTEPS
"""Seconds between two actions: 50 Hz."""
BINS = (-1.0, -1 / 2, -1 / 4, -1 / 8, -1 / 16, 0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Discrete actions as shares of a joint's step, exponentially spaced about zero (paper)."""
STEP_TURN, STEP_SLIDE = 0.2, 0.02
"""Largest change of a joint's target in a control step, rad and m, if it is fast enough."""


@dataclass(frozen=True)
class ReachConfig:
    """Bring the tool to a goal and keep it there; the episode does not end early (paper, B.3)."""

    steps: int = 300
    """Control steps of an episode: 6 s."""
    goals: int = 100
    """Configurations of a robot's goal set."""
    near: float = 0.03
    """Distance of tool and goal that counts as success, metres (paper, table of rewards)."""
    obstacles: int = 3
    """Boxes of an obstacle variant."""
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    """Range of their edges, relative to the robot's reach."""
    joint_limit_weight: float = 1.0
    joint_acceleration_weight: float = 1e-5
    distance_weight: float = 1.0
    near_weight: float = 1.0
    """The paper gives the four terms and no weights."""
    score_square: float = 50.0
    score_near: float = 200.0
    """``anybody_score`` of a step: -50 d^2, or +200 where near (the released evaluation)."""


@dataclass(frozen=True)
class PushConfig:
    """Push a block across a line; the episode ends when it is across (paper, B.3)."""

    steps: int = 300
    line: float = 0.2
    """y that the block must cross, metres; in proportion less for bodies that reach under 0.4 m."""
    start: float = -0.15
    """y that the block starts below, scaled likewise."""
    start_depth: float = 0.05
    """How far below at most, scaled likewise; even between (the paper gives no end)."""
    starts: int = 100
    """Starts of a robot's push set, as many as goals of a goal set."""
    arm_x: tuple[float, float] = (0.4, 0.6)
    """Range of x at the start for arms, in effective reach beyond the shoulder."""
    free_x: tuple[float, float] = (-0.2, 0.2)
    """The same for bodies that slide freely over the ground, metres, scaled likewise."""
    block_size: tuple[float, float] = (0.15, 0.2)
    """Range of the block's edge: of an arm's effective reach, or metres for bodies that slide."""
    block_mass: float = 0.1
    friction: float = 1.0
    obstacles: int = 3
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    curriculum_steps: int = 50
    curriculum_start: float = 0.1
    """The line starts at this share of its place; 50 steps over half of the training move it."""
    joint_limit_weight: float = 1.0
    distance_weight: float = 1.0
    success_weight: float = 10.0
    approach_weight: float = 0.5
    """For the distance of tool and block: in the released code, not in the paper; never scored."""
