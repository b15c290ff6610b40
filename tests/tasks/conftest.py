"""Fixtures shared by the task tests."""

from dataclasses import replace
from pathlib import Path

import pytest

from helpers.goal_sets import once
from helpers.robots import arm
from morphgen.checks.self_collision import survey_collisions
from morphgen.tasks.scenes.env_specs import load_robot


@pytest.fixture(scope="session", autouse=True)
def named_once():
    """Load a robot that words name for a batch once: composing takes a third of making most."""
    named = once(load_robot, lambda words, library=(): (words, *library))

    def load(source, library=()):
        is_named = isinstance(source, str) and not Path(source).exists()
        return (named if is_named else load_robot)(source, library=library)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("morphgen.tasks.scenes.make.load_robot", load)
        yield


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
