"""Constants of control that all tasks share; "paper" is AnyBody, arXiv 2505.14986."""

from __future__ import annotations

from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP

CONTROL_PERIOD = TIMESTEP * SUBSTEPS
"""Seconds between two actions: 50 Hz."""
BINS = (-1.0, -1 / 2, -1 / 4, -1 / 8, -1 / 16, 0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Discrete actions as shares of a joint's step, exponentially spaced about zero (paper)."""
STEP_TURN, STEP_SLIDE = 0.2, 0.02
"""Largest change of a joint's target in a control step, rad and m, if it is fast enough."""
