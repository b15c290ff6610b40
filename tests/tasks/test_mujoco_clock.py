"""MuJoCo's clock is off in the steps of a simulation, and nowhere else."""

from contextlib import closing

import mujoco
import pytest
import torch

from helpers.scenes import reach_scene
from morphgen.tasks.sim.mujoco_clock import unclocked
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

STEP = mujoco.mjtTimer.mjTIMER_STEP


@pytest.fixture
def model():
    return mujoco.MjModel.from_xml_string("<mujoco/>")


def timed(model):
    """Whether MuJoCo takes the time of a step now."""
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    return data.timer[STEP].duration > 0


def test_a_simulation_takes_no_time_and_leaves_the_clock(model):
    with closing(MujocoSimulation([reach_scene()])) as simulation:
        q = torch.tensor([simulation.scenes[0].robot.home])
        simulation.step(q)
        data = simulation._data[0]
        assert data.time > 0
        assert data.timer[STEP].duration == 0
    assert timed(model)


def fail_without_clock(model):
    with unclocked():
        assert not timed(model)
        raise KeyError


def test_the_clock_is_back_after_an_error_and_after_another_thread_had_it(model):
    with pytest.raises(KeyError):
        fail_without_clock(model)
    assert timed(model)
    one, other = unclocked(), unclocked()
    one.__enter__()
    other.__enter__()
    one.__exit__(None, None, None)
    other.__exit__(None, None, None)
    assert timed(model)
