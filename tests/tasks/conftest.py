"""Fixtures shared by the task tests."""

import pytest


@pytest.fixture
def simulate():
    """Create PyBullet simulations of scenes in this process."""
    pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
    from morphgen.tasks.sim.bullet import BulletSimulation

    simulations = []

    def make(*scenes, contacts=None):
        simulations.append(BulletSimulation(scenes, contacts))
        return simulations[-1]

    yield make
    for simulation in simulations:
        simulation.close()
