"""Robots that hold their home, and step from it, in environments of the simulators.

``morphgen.checks.hold`` measures the same with the files of a bundle. The controllers of the tasks
are in this package, which the checks cannot import.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch

from morphgen.checks.hold import HoldRow, SimulatedRobot, hold_row, with_causes
from morphgen.errors import SimulationError
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.base import CONTROL_PERIOD, Scene
from morphgen.typing import Array


def hold_in_environment(robot: Robot, simulator: str) -> HoldRow:
    """Hold a robot at home and step its joints in an environment; see ``hold_row``."""
    name = f"{simulator} (environment)"
    margin = SIMULATORS[simulator].contact_margin

    def hold(robot: Robot) -> HoldRow:
        return hold_row(name, simulator, robot, lambda: _simulated(robot, simulator), margin)

    return with_causes(hold(robot), robot, hold)


@contextmanager
def _simulated(robot: Robot, name: str) -> Iterator[SimulatedRobot]:
    simulation = SIMULATORS[name].load([Scene(robot, ground=None)], None, 1, torch.device("cpu"))

    def follow(_: int) -> Array:
        return movable_positions(robot, simulation.q[0].numpy().astype(np.float64))

    # Others have no positions of mimic joints, which then are where their leaders put them.
    movable_q = getattr(simulation, "movable_q", follow)

    def run(targets: Array) -> Iterator[Array]:
        home = torch.tensor([robot.home], dtype=torch.float32)
        goal = torch.tensor(targets[None], dtype=torch.float32)
        simulation.reset(torch.ones(1, dtype=torch.bool), home, torch.zeros(1, 7))
        while True:
            if simulation.step(goal).any():
                raise SimulationError(simulation.faults()[0])
            yield movable_q(0)

    try:
        yield SimulatedRobot(CONTROL_PERIOD, run)
    finally:
        simulation.close()
