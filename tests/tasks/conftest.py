"""Fixtures shared by the task tests."""

import pytest

from morphgen.tasks.sim.bullet import BulletSimulation


@pytest.fixture
def simulate():
    """Create PyBullet simulations of scenes in this process."""
    simulations = []

    def make(*scenes, contacts=None):
        simulations.append(BulletSimulation(scenes, contacts))
        return simulations[-1]

    yield make
    for simulation in simulations:
        simulation.close()
