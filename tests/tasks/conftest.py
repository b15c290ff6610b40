"""Fixtures shared by the task tests."""

from dataclasses import replace

import pytest

from helpers.robots import arm
from morphgen.checks.self_collision import survey_collisions


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


@pytest.fixture(scope="session")
def cache(tmp_path_factory):
    """Folder of stored goal sets, which the tests of a process share."""
    return tmp_path_factory.mktemp("goals")


@pytest.fixture(scope="module")
def body():
    """The arm, with the pairs of its links that always touch."""
    return replace(arm(), ignore_pairs=survey_collisions(arm()).ignore_pairs)
