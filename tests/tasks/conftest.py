"""Fixtures shared by the task tests."""

import pytest

from morphgen.tasks.sim.bullet import BulletSimulation


@pytest.fixture
def simulate():
    """Makes simulations of scenes in PyBullet, in this process."""
    made = []

    def make(*scenes, contacts=None):
        made.append(BulletSimulation(scenes, contacts))
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()
