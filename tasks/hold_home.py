"""Drift of a robot that holds its home configuration in environments of the simulators.

``morphgen.checks.hold`` measures the same with the files of a bundle. The controllers of the tasks
are in this package, which the checks cannot import.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from morphgen.checks.hold import HOLD_S, HoldRow, hold_row
from morphgen.checks.home_pose import home_penetrations
from morphgen.errors import SimulationError
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.base import CONTROL_PERIOD, Scene
from morphgen.typing import Array

BULLET_MARGIN = 1e-3
"""Distance by which PyBullet enlarges convex meshes of a URDF: links that touch at home push each
other away [m]."""


def hold_in_environment(robot: Robot, simulator: str) -> HoldRow:
    """Hold a robot at home in an environment without ground, for ``HOLD_S``.

    The row has independent joints and, with their targets, the mimic joints that follow them.

    Args:
        robot: The robot.
        simulator: Name of a simulator of ``SIMULATORS``, also that of its library.
    """
    name = f"{simulator} (environment)"
    row = hold_row(name, simulator, robot, lambda: _hold(robot, simulator))
    if row.passed is not False or simulator != "pybullet":
        return row
    touching = [
        f"{a}, {b} are {-1000 * depth:.2g} mm apart at home, within PyBullet's collision margin"
        for (a, b), depth in sorted(home_penetrations(robot, BULLET_MARGIN).items())
        if depth < 0
    ]
    return replace(row, message="; ".join((row.message, *touching)))


def _hold(robot: Robot, name: str) -> Iterator[Array]:
    home = torch.tensor([robot.home], dtype=torch.float32)
    simulation = SIMULATORS[name].load([Scene(robot, ground=None)], None, 1, torch.device("cpu"))
    try:
        simulation.reset(torch.ones(1, dtype=torch.bool), home, torch.zeros(1, 7))
        for _ in range(round(HOLD_S / CONTROL_PERIOD)):
            if simulation.step(home).any():
                raise SimulationError(simulation.faults()[0])
            yield movable_positions(robot, simulation.q[0].numpy().astype(np.float64))
    finally:
        simulation.close()
