"""Fixtures shared by the task tests."""

from contextlib import ExitStack, closing
from dataclasses import replace

import pytest

from helpers.robots import arm
from morphgen.checks.self_collision import survey_collisions


@pytest.fixture
def opened():
    """Return a function that returns what it is given, which is closed after the test."""
    with ExitStack() as stack:
        yield lambda thing: stack.enter_context(closing(thing))


@pytest.fixture
def simulate(opened):
    """Create PyBullet simulations of scenes in this process."""
    pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
    from morphgen.tasks.sim.bullet import BulletSimulation

    return lambda *scenes, contacts=None: opened(BulletSimulation(scenes, contacts))


@pytest.fixture(scope="module")
def body():
    """The arm, with the pairs of its links that always touch."""
    return replace(arm(), ignore_pairs=survey_collisions(arm()).ignore_pairs)
